//! Only for tests, behind the feature `provoke`: what must never happen.

use crate::client::{guarded, psao_client, with};
use crate::result::psao_result;

/// A panic in a client's function, or without a client in another one.
///
/// # Safety
/// `client` is NULL or a live client.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn psao_provoke(client: *const psao_client) -> psao_result {
    if client.is_null() {
        return guarded(|| panic!("provoked"));
    }
    // SAFETY: the caller's word.
    unsafe { with(client, |_| panic!("provoked")) }
}
