//! Server and clients together, over real QUIC on the loopback interface: whatever a client does,
//! it ends with exactly what the server believes it to have, and nobody else notices.
//!
//! Waits end with what they wait for; their limits are only there to fail instead of hanging.

mod one_client;
mod small_scene;

use glam::{Affine3A, DAffine3, DVec3, Quat, Vec3};
use psao::core::mirror::Capacity;
use psao::core::stream::{Frame, Refusal};
use psao::core::uplink::{Camera, Transform};
use psao::core::{Cell, Kernel};
use psao::quic::{Closed, Connect, Connection, Fingerprint, Trust};
use psao::{Client, ClientError, Config, State};
use psao_server::commands::{PlayArgs, play};
use psao_server::encode::{Compression, Scheme, capacity_of};
use psao_server::identity::Identity;
use psao_server::scene::Scene;
use psao_server::server::{FrameReport, Server, Settings};
use psao_server::transport::{ClientId, Transport, TransportConfig};
use psao_server::world::{Options, World};
use small_scene::{FLOOR, POST, STILL, small_scene, still_scene};
use std::time::Duration;

const TOKEN: &str = "open sesame";
const THRESHOLD: u8 = 2;

/// After so long a wait has failed.
const TOO_LONG: Duration = Duration::from_secs(60);

fn world(scene: Scene, density: f64) -> World {
    let options = Options {
        density,
        rays: 16,
        ..Options::of(Kernel::Planar)
    };
    World::new(scene, options, &|_, _, _| ()).unwrap()
}

/// Looks until there is something.
fn wait<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let pause = Duration::from_millis(1);
    for _ in 0..TOO_LONG.as_millis() {
        if let Some(found) = look() {
            return found;
        }
        std::thread::sleep(pause);
    }
    panic!("waited in vain for {what}");
}

/// A server, its frames counted.
struct Served {
    server: Server,
    transport: Transport,
    fingerprint: Fingerprint,
    capacity: Capacity,
    frames: u32,
}

impl Served {
    fn start(scene: Scene, density: f64) -> Served {
        let settings = Settings {
            scheme: Scheme::Cells {
                threshold: THRESHOLD,
                compression: Compression::Fast,
            },
            rate_hz: 30.0,
            margin_rad: 0.1,
        };
        let server = Server::new(world(scene, density), settings);
        let identity = Identity::ephemeral().unwrap();
        let fingerprint = identity.fingerprint();
        let capacity = capacity_of(&server.world);
        let transport = Transport::start(TransportConfig {
            listen: "127.0.0.1:0".parse().unwrap(),
            identity,
            token: TOKEN.into(),
            max_clients: 4,
            scene_hash: server.scene_hash(),
            capacity,
        });
        Served {
            server,
            transport: transport.unwrap(),
            fingerprint,
            capacity,
            frames: 0,
        }
    }

    fn config(&self) -> Config {
        Config {
            capacity: self.capacity,
            scene_hash: self.server.scene_hash(),
        }
    }

    fn open(&self, change: impl FnOnce(&mut Connect<'_>)) -> Connection {
        let address = self.transport.local_addr().to_string();
        let mut connect = Connect {
            address: &address,
            server_name: None,
            token: TOKEN,
            trust: Trust::Fingerprint(self.fingerprint),
            scene_hash: self.server.scene_hash(),
            capacity: self.capacity,
            topology_hash: 0,
        };
        change(&mut connect);
        Connection::open(connect).unwrap()
    }

    fn join(&mut self) -> Link {
        let client = Client::new(self.config());
        self.join_with(client)
    }

    /// A client joins, and has been sent nothing yet.
    fn join_with(&mut self, client: Client) -> Link {
        let known: Vec<ClientId> = self.server.ids().collect();
        let connection = self.open(|_| ());
        let id = wait("the client to join", || {
            self.server.listen(&mut self.transport);
            self.server.ids().find(|id| !known.contains(id))
        });
        Link {
            connection,
            client,
            id,
            last: Frame::default(),
        }
    }

    fn leave(&mut self, link: Link) -> Client {
        let (id, client) = (link.id, link.client);
        link.connection.close();
        wait("the client to leave", || {
            self.server.listen(&mut self.transport);
            self.server.ids().all(|other| other != id).then_some(())
        });
        client
    }

    /// One server frame at a time of the scene.
    fn frame_at(&mut self, time_s: f64) -> FrameReport {
        self.frames += 1;
        self.server.frame(&mut self.transport, time_s, u64::MAX)
    }

    /// The next frame of the moving scene; all these clients can take one, and follow it.
    fn frame(&mut self, links: &mut [&mut Link]) -> FrameReport {
        self.frame_with(f64::from(self.frames) * 0.05, links)
    }

    fn frame_with(&mut self, time_s: f64, links: &mut [&mut Link]) -> FrameReport {
        for link in links.iter() {
            let ready = || self.transport.ready(link.id).then_some(());
            wait("a client to be ready", ready);
        }
        let report = self.frame_at(time_s);
        for link in links {
            link.follow(self);
        }
        report
    }

    fn look(&mut self, link: &Link, camera: &Camera, sees: [Vec3; 2], expected: bool) {
        wait("the camera to arrive", || {
            // A datagram: it may be lost.
            link.connection.camera(camera).unwrap();
            self.server.listen(&mut self.transport);
            (self.server.sees(link.id, sees) == Some(expected)).then_some(())
        });
    }
}

/// A client and its connection.
struct Link {
    connection: Connection,
    client: Client,
    id: ClientId,
    last: Frame,
}

impl Link {
    /// Takes what has come, or waits for something; looks at every completed frame.
    fn receive(&mut self, wait: Duration, look: &mut dyn FnMut(&Client)) -> usize {
        let mut bytes = Vec::new();
        let count = self.connection.receive_timeout(&mut bytes, wait).unwrap();
        let mut rest = &bytes[..];
        while !rest.is_empty() {
            let pushed = self.client.push(rest).unwrap();
            rest = &rest[pushed.consumed..];
            if let Some(frame) = pushed.frame {
                self.last = frame;
                look(&self.client);
            }
        }
        count
    }

    /// Receives until it is where the server is, and has exactly what the server believes.
    fn follow(&mut self, served: &Served) {
        let (_, newest) = served.server.progress_of(self.id).unwrap();
        while self.last.id != newest {
            let came = self.receive(TOO_LONG, &mut |_| ());
            assert!(came > 0, "frame {newest} does not come");
        }
        assert_eq!(self.client.state(), State::Live);
        assert_eq!(self.client.stats().mismatches, 0);
        let (mine, theirs) = (
            self.client.mirror(),
            served.server.mirror_of(self.id).unwrap(),
        );
        assert!(mine.hash() == theirs.hash() && mine.hash() == mine.recompute_hash());
        assert!(mine.instances() == theirs.instances());
        assert!(mine.buckets() == theirs.buckets());
        assert!(mine.cells() == theirs.cells());
    }

    /// How far off the points in view are, in 1/255, as a root mean square.
    fn rmse(&self, served: &mut Served) -> f64 {
        served.server.point_rmse(self.id, &self.client).unwrap()
    }
}

/// Points in cells, and how many of them are at least a little occluded.
fn counts(cells: &[Cell]) -> (usize, usize) {
    let points = cells.iter().flat_map(|cell| cell.points);
    let points: Vec<_> = points.filter(|point| point.is_allocated()).collect();
    let occluded = points.iter().filter(|point| point.occlusion() < 200);
    (points.len(), occluded.count())
}

/// In the middle of the scene, 0.7 m above the floor.
fn camera(forward: [f32; 3]) -> Camera {
    Camera {
        position_m: [50.0, 0.7, 0.0],
        forward,
        up: [0.0, 1.0, 0.0],
        fov_y_rad: 1.0,
        aspect: 1.0,
        height_px: 0,
    }
}

/// A small box this far from the scene's middle, at the floor.
fn spot(x: f32, z: f32) -> [Vec3; 2] {
    let at = Vec3::new(x, -0.3, z);
    [at - 0.01, at + 0.01]
}

#[test]
fn a_client_that_joins_late_gets_a_snapshot_and_follows() {
    let mut served = Served::start(small_scene(), 256.0);
    let mut early = served.join();
    for _ in 0..5 {
        served.frame(&mut [&mut early]);
    }
    let mut late = served.join();
    for _ in 0..5 {
        served.frame(&mut [&mut early, &mut late]);
        assert!(late.rmse(&mut served) <= f64::from(THRESHOLD));
        assert!(early.rmse(&mut served) <= f64::from(THRESHOLD));
    }
    let (points, occluded) = counts(late.client.mirror().cells());
    assert!(points > 2500 && occluded > 100, "{occluded} of {points}");
    assert_eq!(late.client.stats().snapshots, 1);
    assert_eq!(late.client.stats().frames, 5);
    assert_eq!(early.client.stats().snapshots, 1);
    assert_eq!(early.last.time_ns, late.last.time_ns);
}

#[test]
fn a_client_that_reconnects_keeps_its_picture_until_it_has_the_next() {
    let mut served = Served::start(small_scene(), 256.0);
    let mut link = served.join();
    for _ in 0..5 {
        served.frame(&mut [&mut link]);
    }
    let before = link.client.mirror().cells().to_vec();
    let (points, occluded) = counts(&before);
    let mut client = served.leave(link);
    for _ in 0..5 {
        served.frame(&mut []);
    }
    client.restart();
    assert_eq!(client.state(), State::Connecting);
    let mut link = served.join_with(client);
    assert!(
        link.client.mirror().cells() == before,
        "it lost its picture"
    );
    served.frame_at(0.6);
    let mut pictures = 0;
    let mut look = |client: &Client| {
        pictures += 1;
        let now = counts(client.mirror().cells());
        assert!(now.0 * 10 > points * 9 && now.1 * 2 > occluded, "{now:?}");
    };
    while link.last.id != 1 {
        link.receive(TOO_LONG, &mut look);
    }
    assert_eq!(pictures, 1);
    link.follow(&served);
    assert!(link.client.mirror().cells() != before, "it is where it was");
    assert!(link.rmse(&mut served) <= f64::from(THRESHOLD));
    served.frame(&mut [&mut link]);
    assert_eq!(link.client.stats().snapshots, 2);
}

#[test]
fn who_has_another_token_or_scene_is_told_so_and_the_others_go_on() {
    let mut served = Served::start(small_scene(), 64.0);
    let mut link = served.join();
    served.frame(&mut [&mut link]);
    type Change = fn(&mut Connect<'_>);
    let cases: [(Change, Refusal); 2] = [
        (|c| c.token = "open", Refusal::Token),
        (|c| c.scene_hash ^= 1, Refusal::Scene),
    ];
    for (change, expected) in cases {
        let mut stranger = served.open(change);
        let mut bytes = Vec::new();
        let closed = loop {
            match stranger.receive_timeout(&mut bytes, TOO_LONG) {
                Ok(came) => assert!(came > 0, "it is not told"),
                Err(closed) => break closed,
            }
        };
        assert_eq!(closed, Closed::Ended);
        let mut client = Client::new(served.config());
        match client.push(&bytes) {
            Err(ClientError::Refused(Some(refusal), _)) => assert_eq!(refusal, expected),
            other => panic!("{other:?} instead of a refusal"),
        }
        assert_eq!(client.state(), State::Failed);
        served.frame(&mut [&mut link]);
        assert_eq!(served.server.clients(), 1);
    }
}

#[test]
fn clients_that_look_elsewhere_get_other_points_and_each_its_own() {
    let mut served = Served::start(small_scene(), 1024.0);
    let (mut left, mut right) = (served.join(), served.join());
    served.look(&left, &camera([-1.0, -0.5, 0.0]), spot(1.4, 0.0), false);
    served.look(&right, &camera([1.0, -0.5, 0.0]), spot(-1.4, 0.0), false);
    for _ in 0..6 {
        served.frame(&mut [&mut left, &mut right]);
        assert!(left.rmse(&mut served) <= f64::from(THRESHOLD));
        assert!(right.rmse(&mut served) <= f64::from(THRESHOLD));
    }
    let has = |link: &Link| -> Vec<bool> {
        let cells = link.client.mirror().cells().iter();
        cells.map(|cell| !cell.is_empty()).collect()
    };
    let (a, b) = (has(&left), has(&right));
    let only = |a: &[bool], b: &[bool]| a.iter().zip(b).filter(|(a, b)| **a && !**b).count();
    assert!(only(&a, &b) > 300, "left has {} of its own", only(&a, &b));
    assert!(only(&b, &a) > 300, "right has {} of its own", only(&b, &a));
}

#[test]
fn a_client_that_stops_reading_holds_up_nobody_and_is_up_to_date_at_once_afterwards() {
    let mut served = Served::start(small_scene(), 3000.0);
    let (mut stalled, mut other) = (served.join(), served.join());
    served.frame(&mut [&mut stalled, &mut other]);
    let (mut frames, mut bytes, mut largest, mut missed) = (0, 0, 0, 0);
    for _ in 0..300 {
        // Of the other one only: the stalled client's state is whatever it is.
        let report = served.frame(&mut [&mut other]);
        match report.sent.iter().find(|(id, _)| *id == stalled.id) {
            Some((_, stats)) => {
                frames += 1;
                bytes += stats.bytes;
                largest = largest.max(stats.bytes);
                missed = 0;
            }
            None => missed += 1,
        }
    }
    assert!(other.rmse(&mut served) <= f64::from(THRESHOLD));
    // What may be on its way: the client's buffer and window, the server's window, and a frame.
    assert!(
        bytes <= (1 << 20) + (2 << 20) + (4 << 20) + 2 * largest,
        "{bytes} bytes"
    );
    assert!(
        missed > 50,
        "it never stalled: {frames} frames, {bytes} bytes"
    );

    let id = stalled.id;
    wait("the stalled client to be ready again", || {
        stalled.receive(Duration::from_millis(1), &mut |_| ());
        served.transport.ready(id).then_some(())
    });
    served.frame(&mut [&mut stalled, &mut other]);
    assert_eq!(stalled.last.time_ns, other.last.time_ns);
    assert!(stalled.rmse(&mut served) <= f64::from(THRESHOLD));
    assert_eq!(stalled.client.stats().frames, frames + 2);
}

#[test]
fn a_client_that_asks_for_a_snapshot_gets_one() {
    let mut served = Served::start(small_scene(), 128.0);
    let (mut asking, mut other) = (served.join(), served.join());
    served.frame(&mut [&mut asking, &mut other]);
    asking.connection.resync().unwrap();
    wait("the snapshot", || {
        served.frame(&mut [&mut asking, &mut other]);
        (asking.client.stats().snapshots == 2).then_some(())
    });
    served.frame(&mut [&mut asking, &mut other]);
    assert_eq!(asking.client.stats().snapshots, 2);
    assert_eq!(other.client.stats().snapshots, 1);
    assert!(asking.rmse(&mut served) <= f64::from(THRESHOLD));
}

/// Frames at time 0 until the world is as `there` says and has converged.
fn settle(served: &mut Served, link: &mut Link, there: impl Fn(&World) -> bool) {
    wait("the client's message to take effect", || {
        let report = served.frame_with(0.0, &mut [link]);
        (there(&served.server.world) && report.step.converging == 0).then_some(())
    });
}

/// The largest difference of what a client has on the floor from what another world says, 1/255.
fn floor_difference(link: &Link, world: &World) -> u8 {
    let slices = world.slices.iter().filter(|slice| slice.instance == FLOOR);
    let cells = slices.flat_map(|slice| slice.cells.clone());
    let mirror = link.client.mirror();
    assert!(mirror.instances()[FLOOR as usize] == world.truth.instances[FLOOR as usize]);
    let points = cells.flat_map(|cell| {
        let (want, have) = (
            world.truth.cells[cell as usize],
            mirror.cells()[cell as usize],
        );
        assert_eq!(want.key, have.key);
        want.points.into_iter().zip(have.points)
    });
    points
        .map(|(a, b)| a.occlusion().abs_diff(b.occlusion()))
        .max()
        .unwrap()
}

#[test]
fn what_a_client_moves_takes_its_shadow_along_for_all_clients() {
    let density = 512.0;
    let mut served = Served::start(still_scene(), density);
    let (mut mover, mut other) = (served.join(), served.join());
    let mut here = world(still_scene(), density);
    here.converge(&|_| true, usize::MAX, &|_, _| ());
    settle(&mut served, &mut mover, |_| true);
    assert!(floor_difference(&mover, &here) <= THRESHOLD);

    let to = DVec3::new(50.9, 0.2, -0.7);
    let rows = [
        [1.0, 0.0, 0.0, to.x],
        [0.0, 1.0, 0.0, to.y],
        [0.0, 0.0, 1.0, to.z],
    ];
    let transform = Transform {
        instance: STILL,
        world_from_local: rows,
    };
    // One that is not there is not heard, and does no harm.
    let nobody = Transform {
        instance: 1000,
        ..transform
    };
    mover.connection.transform(&nobody).unwrap();
    mover.connection.transform(&transform).unwrap();
    let at = (to - served.server.world.scene.origin).as_vec3a();
    settle(&mut served, &mut mover, |world| {
        let pose = &world.pose.instances[STILL as usize];
        pose.world_from_local.translation.distance(at) < 1e-4
    });
    let mut there = world(still_scene(), density);
    there.drive(STILL, DAffine3::from_translation(to)).unwrap();
    there.step(0.0, &|_| true, 0);
    there.converge(&|_| true, usize::MAX, &|_, _| ());
    assert!(floor_difference(&mover, &here) > 100, "the shadow stays");
    assert!(floor_difference(&mover, &there) <= THRESHOLD);
    served.frame_with(0.0, &mut [&mut other]);
    assert!(floor_difference(&other, &there) <= THRESHOLD);
}

#[test]
fn the_joints_that_a_client_sends_bend_the_instance() {
    let density = 512.0;
    let mut served = Served::start(small_scene(), density);
    let mut link = served.join();
    settle(&mut served, &mut link, |_| true);
    let mut here = world(small_scene(), density);
    here.converge(&|_| true, usize::MAX, &|_, _| ());
    assert!(floor_difference(&link, &here) <= THRESHOLD);

    // It lies down on the floor.
    let down =
        Affine3A::from_rotation_translation(Quat::from_rotation_z(1.5), Vec3::new(0.3, -0.25, 0.0));
    let [x, y, z] = [0, 1, 2].map(|row| {
        let (m, t) = (down.matrix3.row(row), down.translation[row]);
        [m.x, m.y, m.z, t]
    });
    link.connection.joints(POST, &[[x, y, z]; 3]).unwrap();
    link.connection.joints(POST, &[[x, y, z]; 2]).unwrap();
    settle(&mut served, &mut link, |world| {
        let joint = &world.pose.instances[POST as usize].joints[0];
        joint.abs_diff_eq(down, 1e-5)
    });
    let mut there = world(small_scene(), density);
    there.drive_joints(POST, vec![down; 2]).unwrap();
    there.step(0.0, &|_| true, 0);
    there.converge(&|_| true, usize::MAX, &|_, _| ());
    assert!(floor_difference(&link, &here) > 100, "the shadow stays");
    assert!(floor_difference(&link, &there) <= THRESHOLD);
    assert!(link.rmse(&mut served) <= f64::from(THRESHOLD));
}

#[test]
fn nothing_is_sent_of_what_is_out_of_view_and_it_comes_when_it_is_seen() {
    let mut served = Served::start(small_scene(), 512.0);
    let mut link = served.join();
    let (up, down) = (camera([0.1, 1.0, 0.0]), camera([0.1, -1.0, 0.0]));
    served.look(&link, &up, spot(0.0, 0.0), false);
    let moving = |served: &mut Served, link: &mut Link| {
        let mut sent = 0;
        for _ in 0..10 {
            let report = served.frame(&mut [link]);
            let ours = report.sent.iter().find(|(id, _)| *id == link.id);
            sent += ours.map_or(0, |(_, stats)| stats.cells);
        }
        sent
    };
    assert_eq!(moving(&mut served, &mut link), 0);
    assert_eq!(counts(link.client.mirror().cells()).0, 0);

    served.look(&link, &down, spot(0.0, 0.0), true);
    assert!(moving(&mut served, &mut link) > 0);
    assert!(counts(link.client.mirror().cells()).0 > 1000);
    assert!(link.rmse(&mut served) <= f64::from(THRESHOLD));

    served.look(&link, &up, spot(0.0, 0.0), false);
    let before = link.client.mirror().cells().to_vec();
    assert_eq!(moving(&mut served, &mut link), 0);
    assert!(link.client.mirror().cells() == before);

    served.look(&link, &down, spot(0.0, 0.0), true);
    served.frame(&mut [&mut link]);
    assert!(
        link.client.mirror().cells() != before,
        "nothing moved meanwhile"
    );
    assert!(link.rmse(&mut served) <= f64::from(THRESHOLD));
}

#[test]
fn a_player_says_that_its_server_shut_down_and_takes_that_for_no_failure() {
    #[derive(clap::Parser)]
    struct Words {
        #[command(flatten)]
        args: PlayArgs,
    }
    let cut = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/conformance/streams/cut-off.psao"
    );
    let told = || {
        // A stream without an end, as a live one.
        let server = one_client::OneClient::start(std::fs::read(cut).unwrap());
        let (address, fingerprint) = (server.address.clone(), server.fingerprint.clone());
        let player = std::thread::spawn(move || {
            let words = ["play", &address, "--token", one_client::TOKEN];
            let words = words.into_iter().chain(["--fingerprint", &fingerprint]);
            play(&<Words as clap::Parser>::parse_from(words).args)
        });
        server.until(1, || player.is_finished().then_some(()));
        player.join().unwrap()
    };
    let row = ("end".to_string(), "the server shut down".to_string());
    // The one datagram that says so may be lost.
    assert!((0..3).any(|_| told().is_ok_and(|table| table.contains(&row))));
}
