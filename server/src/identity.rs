//! Who the server is: its certificate and key.
//!
//! A server makes its own certificate when it first runs and keeps it, so that clients can pin its
//! [`Fingerprint`]; or it takes one that an authority signed.

use psao::quic::Fingerprint;
use rcgen::{CertificateParams, DnType, ExtendedKeyUsagePurpose, KeyPair};
use rustls::crypto::ring::default_provider;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::sign::CertifiedKey;
use std::fs::{self, File, OpenOptions};
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

/// File name of the certificate in an identity's folder.
pub const CERTIFICATE_FILE: &str = "certificate.pem";

/// File name of the key in an identity's folder. Whoever can read it can pose as the server.
pub const KEY_FILE: &str = "key.pem";

/// Largest PEM file: a chain of certificates has some KB.
const MAX_PEM_BYTES: u64 = 1 << 20;

/// Names that a certificate made here is for; a client that pins it does not look at them.
const NAMES: [&str; 4] = ["localhost", "psao", "127.0.0.1", "::1"];

/// A certificate, those that lead to its authority, and its key.
#[derive(Debug)]
pub struct Identity {
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
}

/// Why there is no identity.
#[derive(Debug)]
pub enum IdentityError {
    /// A file or folder cannot be read or written.
    File(PathBuf, std::io::Error),
    /// A text is not PEM of the expected kind (what is wrong).
    Pem(String),
    /// Certificate and key do not belong together, or are of an unknown kind (why).
    Unusable(String),
    /// No key or certificate could be made (why).
    Generate(String),
}

impl std::fmt::Display for IdentityError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            IdentityError::File(path, error) => write!(
                f,
                "{}: {error}: the server keeps its certificate and key there, \
                 make it readable and writable for this user",
                path.display()
            ),
            IdentityError::Pem(what) => write!(
                f,
                "{what}: pass PEM (-----BEGIN ...), or delete {CERTIFICATE_FILE} and {KEY_FILE} \
                 to have new ones made"
            ),
            IdentityError::Unusable(why) => write!(
                f,
                "certificate and key cannot be used together ({why}): pass the pair that belongs \
                 together, or delete {CERTIFICATE_FILE} and {KEY_FILE} to have new ones made"
            ),
            IdentityError::Generate(why) => write!(f, "no certificate could be made: {why}"),
        }
    }
}

impl std::error::Error for IdentityError {}

impl From<rcgen::Error> for IdentityError {
    fn from(error: rcgen::Error) -> IdentityError {
        IdentityError::Generate(error.to_string())
    }
}

impl Identity {
    /// The identity kept in `folder`; made there, with the folder, on the first run. The key file
    /// can be read by this user only.
    ///
    /// Two servers that first run at once come to the same identity, and one that was cut off
    /// between the two files finishes it the next time: a key once there is never replaced.
    ///
    /// # Errors
    /// The folder cannot be read or written, or what is there is no identity.
    pub fn load_or_create(folder: &Path) -> Result<Identity, IdentityError> {
        let (certificate, key) = (folder.join(CERTIFICATE_FILE), folder.join(KEY_FILE));
        fs::create_dir_all(folder).map_err(|error| IdentityError::File(folder.into(), error))?;
        if !exists(&key)? {
            if exists(&certificate)? {
                return Err(IdentityError::Unusable(format!(
                    "{} is missing",
                    key.display()
                )));
            }
            write_new(&key, &KeyPair::generate()?.serialize_pem())?;
        }
        let key = read(&key)?;
        if !exists(&certificate)? {
            let key = std::str::from_utf8(&key)
                .map_err(|error| IdentityError::Pem(format!("{KEY_FILE}: {error}")))?;
            write_new(&certificate, &sign(&KeyPair::from_pem(key)?)?.pem())?;
        }
        Identity::from_pem(&read(&certificate)?, &key)
    }

    /// From PEM texts: the server's certificate first, then those that lead to its authority; and
    /// its private key.
    ///
    /// # Errors
    /// A text is not such PEM, or the key is not the certificate's.
    pub fn from_pem(certificates: &[u8], key: &[u8]) -> Result<Identity, IdentityError> {
        let chain: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(certificates).collect();
        let chain = chain.map_err(|error| IdentityError::Pem(format!("certificate: {error}")))?;
        if chain.is_empty() {
            return Err(IdentityError::Pem("there is no certificate".into()));
        }
        let key = PrivateKeyDer::from_pem_slice(key)
            .map_err(|error| IdentityError::Pem(format!("private key: {error}")))?;
        CertifiedKey::from_der(chain.clone(), key.clone_key(), &default_provider())
            .map_err(|error| IdentityError::Unusable(error.to_string()))?;
        Ok(Identity { chain, key })
    }

    /// A new one that is kept nowhere: for a server and clients in one process.
    ///
    /// # Errors
    /// The system has no random numbers.
    pub fn ephemeral() -> Result<Identity, IdentityError> {
        let key = KeyPair::generate()?;
        let certificate = sign(&key)?;
        Identity::from_pem(certificate.pem().as_bytes(), key.serialize_pem().as_bytes())
    }

    /// What a client pins.
    pub fn fingerprint(&self) -> Fingerprint {
        // Never empty: `from_pem` makes sure.
        Fingerprint::of(&self.chain[0])
    }

    /// The TLS side of a server of this identity.
    pub(crate) fn into_tls(self) -> Result<rustls::ServerConfig, rustls::Error> {
        let builder = rustls::ServerConfig::builder_with_provider(default_provider().into());
        builder
            .with_protocol_versions(&[&rustls::version::TLS13])?
            .with_no_client_auth()
            .with_single_cert(self.chain, self.key)
    }
}

fn sign(key: &KeyPair) -> Result<rcgen::Certificate, IdentityError> {
    let mut params = CertificateParams::new(NAMES.map(String::from))?;
    params
        .distinguished_name
        .push(DnType::CommonName, "PSAO server");
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
    Ok(params.self_signed(key)?)
}

fn exists(path: &Path) -> Result<bool, IdentityError> {
    path.try_exists()
        .map_err(|error| IdentityError::File(path.into(), error))
}

fn read(path: &Path) -> Result<Vec<u8>, IdentityError> {
    let failed = |error| IdentityError::File(path.into(), error);
    let mut pem = Vec::new();
    let file = File::open(path).map_err(failed)?;
    file.take(MAX_PEM_BYTES)
        .read_to_end(&mut pem)
        .map_err(failed)?;
    Ok(pem)
}

/// Writes a file that only this user can read, whole or not at all; one already there stays.
fn write_new(path: &Path, text: &str) -> Result<(), IdentityError> {
    let failed = |error| IdentityError::File(path.into(), error);
    let draft = path.with_extension(format!("{}.new", std::process::id()));
    let mut options = OpenOptions::new();
    options.write(true).create(true).truncate(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let written = options.open(&draft).and_then(|mut file| {
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        // A link, not a rename: it does not replace what another server has put there.
        match fs::hard_link(&draft, path) {
            Err(error) if error.kind() == ErrorKind::AlreadyExists => Ok(()),
            linked => linked,
        }
    });
    let removed = fs::remove_file(&draft);
    written.and(removed).map_err(failed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_identity_stays_the_same_once_made_and_two_are_never_alike() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("not/yet/there");
        let first = Identity::load_or_create(&path).unwrap();
        let again = Identity::load_or_create(&path).unwrap();
        assert_eq!(first.fingerprint(), again.fingerprint());
        let other = Identity::load_or_create(folder.path()).unwrap();
        assert_ne!(first.fingerprint(), other.fingerprint());
        let ephemeral = Identity::ephemeral().unwrap();
        assert_ne!(ephemeral.fingerprint(), first.fingerprint());
    }

    #[cfg(unix)]
    #[test]
    fn only_the_user_can_read_the_key_and_no_draft_is_left() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        Identity::load_or_create(folder.path()).unwrap();
        let key = fs::metadata(folder.path().join(KEY_FILE)).unwrap();
        assert_eq!(key.permissions().mode() & 0o777, 0o600);
        let mut names: Vec<_> = fs::read_dir(folder.path())
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        assert_eq!(names, [CERTIFICATE_FILE, KEY_FILE]);
    }

    #[test]
    fn a_first_run_that_was_cut_off_is_finished_by_the_next() {
        let folder = tempfile::tempdir().unwrap();
        Identity::load_or_create(folder.path()).unwrap();
        let key = fs::read(folder.path().join(KEY_FILE)).unwrap();
        fs::remove_file(folder.path().join(CERTIFICATE_FILE)).unwrap();
        Identity::load_or_create(folder.path()).unwrap();
        assert_eq!(fs::read(folder.path().join(KEY_FILE)).unwrap(), key);
    }

    #[test]
    fn two_first_runs_at_once_come_to_the_same_identity() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path();
        // The steps of two servers, interleaved at the worst place: both found nothing.
        let key = KeyPair::generate().unwrap().serialize_pem();
        write_new(&path.join(KEY_FILE), &key).unwrap();
        let late = KeyPair::generate().unwrap().serialize_pem();
        write_new(&path.join(KEY_FILE), &late).unwrap();
        assert_eq!(fs::read_to_string(path.join(KEY_FILE)).unwrap(), key);
        let identity = Identity::load_or_create(path).unwrap();
        let certificate = sign(&KeyPair::from_pem(&key).unwrap()).unwrap();
        write_new(&path.join(CERTIFICATE_FILE), &certificate.pem()).unwrap();
        let again = Identity::load_or_create(path).unwrap();
        assert_eq!(identity.fingerprint(), again.fingerprint());
    }

    #[test]
    fn what_is_no_identity_is_refused_and_told_apart() {
        let folder = tempfile::tempdir().unwrap();
        let (a, b) = (folder.path().join("a"), folder.path().join("b"));
        for path in [&a, &b] {
            Identity::load_or_create(path).unwrap();
        }
        let of = |path: &Path, name| fs::read(path.join(name)).unwrap();
        let (certificate, key) = (of(&a, CERTIFICATE_FILE), of(&a, KEY_FILE));
        assert!(Identity::from_pem(&certificate, &key).is_ok());
        let stranger = Identity::from_pem(&certificate, &of(&b, KEY_FILE));
        assert!(matches!(stranger, Err(IdentityError::Unusable(_))));
        for (certificate, key) in [
            (&b""[..], &key[..]),
            (&certificate, b""),
            (&key, &certificate),
            (&certificate[..certificate.len() / 2], &key),
            (&[0xff; 100], &key),
        ] {
            let error = Identity::from_pem(certificate, key).unwrap_err();
            assert!(matches!(error, IdentityError::Pem(_)), "{error}");
        }
        fs::remove_file(b.join(KEY_FILE)).unwrap();
        let error = Identity::load_or_create(&b).unwrap_err().to_string();
        assert!(error.contains("key.pem is missing"), "{error}");
        let error = Identity::load_or_create(&a.join(KEY_FILE)).unwrap_err();
        assert!(matches!(error, IdentityError::File(..)), "{error}");
    }
}
