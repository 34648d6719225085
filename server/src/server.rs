//! The server's frame, top to bottom: what clients say, the world's step, a frame a client.

use crate::camera::{Camera, Frustum};
use crate::encode::{Encoder, Eye, FrameStats, Scheme, View};
use crate::transport::{ClientId, Event, OwnedMessage, Room, Transport};
use crate::world::{StepStats, World};
use glam::{Affine3A, DAffine3, DVec3, Vec3};
use psao::memory::Heap;
use psao_core::Mirror;
use psao_core::topology::LEVELS;
use psao_core::uplink::{self, Presence};
use std::collections::BTreeMap;
use std::time::Instant;

/// How frames are made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// How changes are carried.
    pub scheme: Scheme,
    /// Frames a second: what the stream's header says.
    pub rate_hz: f32,
    /// The extended field of view reaches this much farther on every side, radians.
    pub margin_rad: f32,
}

/// How much a server takes on in a frame, so that it keeps its rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pace {
    /// Rays for new surfaces: they converge with what time the frame leaves.
    pub converge_rays: u64,
    /// Rays for points near movers ([`crate::world::Options::refresh_rays`]).
    pub refresh_rays: u64,
}

impl Default for Pace {
    fn default() -> Pace {
        Pace {
            converge_rays: 1 << 20,
            refresh_rays: u64::MAX,
        }
    }
}

impl Pace {
    /// After a frame that took `busy` of its time, 1 for all of it. What moves is the last to wait,
    /// and the first to be up to date again.
    pub fn after(&mut self, busy: f32, step: &StepStats) {
        let [least, most] = [1 << 14, 1 << 30];
        if busy > 0.85 {
            if self.converge_rays == least {
                // At most half less: one slow frame says little.
                let spent = self.refresh_rays.min(step.rays) as f32;
                let fits = (spent * (0.75 / busy).max(0.5)) as u64;
                self.refresh_rays = fits.max(least);
            }
            self.converge_rays = (self.converge_rays / 2).max(least);
        } else if step.waiting > 0 {
            if busy < 0.7 {
                self.refresh_rays = (self.refresh_rays / 8 * 9).min(most);
            }
        } else {
            self.converge_rays = (self.converge_rays / 4 * 5).min(most);
        }
    }
}

/// One client: what it has, and where it looks.
struct Viewer {
    encoder: Encoder,
    /// Everything is seen until a camera has come.
    frustum: Option<Frustum>,
    eye: Option<Eye>,
    acknowledged: u32,
    header_sent: bool,
}

/// What one frame did and cost.
#[derive(Clone, Debug, Default)]
pub struct FrameReport {
    /// The world's step.
    pub step: StepStats,
    /// Milliseconds of the world's step.
    pub step_ms: f64,
    /// Milliseconds of selecting and encoding, all clients together.
    pub encode_ms: f64,
    /// Each client that was sent something, and what. Others were busy, or lacked nothing.
    pub sent: Vec<(ClientId, FrameStats)>,
}

/// The world and its clients.
pub struct Server {
    /// What is traced.
    pub world: World,
    settings: Settings,
    scene_hash: u64,
    viewers: BTreeMap<ClientId, Viewer>,
    time_ns: u64,
    frames: u64,
}

impl Server {
    /// A server without clients.
    pub fn new(world: World, settings: Settings) -> Server {
        let scene_hash = world.scene.hash();
        Server {
            world,
            settings,
            scene_hash,
            viewers: BTreeMap::new(),
            time_ns: 0,
            frames: 0,
        }
    }

    /// One frame at a scene time (seconds, not below 0). `converge_rays` as in [`World::step`].
    pub fn frame(
        &mut self,
        transport: &mut Transport,
        time_s: f64,
        converge_rays: u64,
    ) -> FrameReport {
        self.listen(transport);

        let start = Instant::now();
        let step = self.step(time_s, converge_rays);
        let step_ms = start.elapsed().as_secs_f64() * 1e3;

        let start = Instant::now();
        let frames = self.encode(|id| transport.ready(id));
        let encode_ms = start.elapsed().as_secs_f64() * 1e3;

        let mut report = FrameReport {
            step,
            step_ms,
            encode_ms,
            sent: Vec::new(),
        };
        for (id, stats, bytes) in frames {
            transport.send(id, bytes);
            report.sent.push((id, stats));
        }
        report
    }

    /// Takes in what clients have said since the last frame.
    pub fn listen(&mut self, transport: &mut Transport) {
        for event in transport.events() {
            match event {
                Event::Joined(id, room) => self.join(id, &room),
                Event::Left(id, why) => {
                    tracing::info!("client {id:?} left: {why}");
                    self.viewers.remove(&id);
                }
                Event::Message(id, message) => self.message(id, message),
            }
        }
    }

    /// A client has come; it has nothing yet, but perhaps all patches.
    fn join(&mut self, id: ClientId, room: &Room) {
        tracing::info!("client {id:?} joined");
        let mut scheme = self.settings.scheme;
        if let Scheme::Residual(_, limits) = &mut scheme {
            limits.fit(&room.capacity);
        }
        let encoder = Encoder::new(&self.world, scheme, room.topology_hash);
        let viewer = Viewer {
            encoder,
            frustum: None,
            eye: None,
            acknowledged: 0,
            header_sent: false,
        };
        self.viewers.insert(id, viewer);
    }

    fn message(&mut self, id: ClientId, message: OwnedMessage) {
        let Some(viewer) = self.viewers.get_mut(&id) else {
            return;
        };
        let driven = match message {
            OwnedMessage::Camera(camera) => {
                let height_px = camera.height_px;
                let camera = view_of(&camera, self.world.scene.origin);
                viewer.eye = Some(Eye::of(&camera, height_px));
                viewer.frustum = Some(Frustum::new(&camera, self.settings.margin_rad));
                Ok(())
            }
            OwnedMessage::Ack(frame) => {
                viewer.acknowledged = frame;
                Ok(())
            }
            OwnedMessage::Resync => {
                viewer.encoder.resync();
                Ok(())
            }
            OwnedMessage::Transform(transform) => {
                let [x, y, z] = transform.world_from_local.map(glam::DVec4::from_array);
                let rows = glam::DMat3::from_cols(x.truncate(), y.truncate(), z.truncate());
                let world =
                    DAffine3::from_mat3_translation(rows.transpose(), DVec3::new(x.w, y.w, z.w));
                self.world.drive(transform.instance, world)
            }
            OwnedMessage::Presence(Presence { instance, present }) => {
                self.world.set_present(instance, present)
            }
            OwnedMessage::Joints { instance, matrices } => {
                let joints = matrices.iter().map(|[x, y, z]| {
                    let rows = [x, y, z].map(|row| glam::Vec4::from_array(*row));
                    let [x, y, z] = rows;
                    let matrix = glam::Mat3::from_cols(x.truncate(), y.truncate(), z.truncate());
                    let translation = Vec3::new(x.w, y.w, z.w);
                    Affine3A::from_mat3_translation(matrix.transpose(), translation)
                });
                self.world.drive_joints(instance, joints.collect())
            }
        };
        if let Err(error) = driven {
            tracing::warn!("client {id:?}: {error}");
        }
    }

    /// Advances the world for the union of all views, and notes what changed for each client.
    fn step(&mut self, time_s: f64, converge_rays: u64) -> StepStats {
        let viewers = &self.viewers;
        let visible = |bounds: [Vec3; 2]| viewers.values().any(|viewer| viewer.sees(bounds));
        // Who has not said where it looks from may look at anything.
        let eyes = viewers.values().map(|viewer| viewer.eye);
        let eyes = eyes.map(|eye| eye.map(|eye| eye.camera.position));
        self.world.eyes = eyes.collect::<Option<_>>().unwrap_or_default();
        let finest = &mut self.world.finest_levels;
        finest.clear();
        finest.resize(self.world.scene.instances.len(), LEVELS);
        for viewer in viewers.values() {
            viewer.encoder.want_levels(finest);
        }
        let stats = self.world.step(time_s, &visible, converge_rays);
        self.time_ns = (time_s * 1e9) as u64;
        self.frames += 1;
        for viewer in self.viewers.values_mut() {
            viewer.encoder.merge(&self.world);
        }
        self.world.clear_changes();
        stats
    }

    /// A frame for each client that can take one. Twice a second also one without changes, so that
    /// the client knows that it is up to date.
    fn encode(&mut self, ready: impl Fn(ClientId) -> bool) -> Vec<(ClientId, FrameStats, Vec<u8>)> {
        let every = (f64::from(self.settings.rate_hz) / 2.0).max(1.0) as u64;
        let beat = self.frames.is_multiple_of(every);
        let mut frames = Vec::new();
        for (&id, viewer) in &mut self.viewers {
            // A busy client loses nothing: the next frame holds what this one would have.
            if !ready(id) {
                continue;
            }
            let mut bytes = Vec::new();
            if !viewer.header_sent {
                let rate_hz = self.settings.rate_hz;
                bytes = viewer.encoder.header(&self.world, self.scene_hash, rate_hz);
                viewer.header_sent = true;
            }
            let frustum = viewer.frustum.clone();
            let view = View {
                sees: &|bounds| sees(&frustum, bounds),
                eye: viewer.eye,
            };
            let always = beat || !bytes.is_empty();
            let encoder = &mut viewer.encoder;
            let stats = encoder.frame(&self.world, self.time_ns, &view, always, &mut bytes);
            if !bytes.is_empty() {
                frames.push((id, stats, bytes));
            }
        }
        frames
    }

    /// How many clients there are.
    pub fn clients(&self) -> usize {
        self.viewers.len()
    }

    /// All clients, in the order in which they came.
    pub fn ids(&self) -> impl Iterator<Item = ClientId> + '_ {
        self.viewers.keys().copied()
    }

    /// Whether a client's extended view shows any of a box (of the world, relative to the scene's
    /// origin); all of it until the client has said where it looks. `None`: no such client.
    pub fn sees(&self, id: ClientId, bounds: [Vec3; 2]) -> Option<bool> {
        self.viewers.get(&id).map(|viewer| viewer.sees(bounds))
    }

    /// Content hash of the scene, which clients must share.
    pub fn scene_hash(&self) -> u64 {
        self.scene_hash
    }

    /// The first client that has said where it looks.
    pub fn first_with_camera(&self) -> Option<ClientId> {
        self.viewers
            .iter()
            .find(|(_, viewer)| viewer.frustum.is_some())
            .map(|(id, _)| *id)
    }

    /// The newest frame that a client has acknowledged, and the newest sent to it.
    pub fn progress_of(&self, id: ClientId) -> Option<(u32, u32)> {
        let viewer = self.viewers.get(&id)?;
        Some((viewer.acknowledged, viewer.encoder.frame_id()))
    }

    /// What the server believes a client to have.
    pub fn mirror_of(&self, id: ClientId) -> Option<&Mirror<Heap>> {
        self.viewers.get(&id).map(|viewer| viewer.encoder.mirror())
    }

    /// [`Encoder::cells`] of a client.
    pub fn cells_of(&self, id: ClientId) -> Option<[usize; 2]> {
        self.viewers.get(&id)?.encoder.cells(&self.world)
    }

    /// [`Encoder::point_rmse`] of what a client has, over what that client sees.
    pub fn point_rmse(&mut self, id: ClientId, client: &psao::Client) -> Option<f64> {
        let viewer = self.viewers.get_mut(&id)?;
        let residual = matches!(self.settings.scheme, Scheme::Residual(..));
        let slices = residual.then(|| client.slices());
        let frustum = viewer.frustum.clone();
        let view = View {
            sees: &|bounds| sees(&frustum, bounds),
            eye: viewer.eye,
        };
        let encoder = &mut viewer.encoder;
        Some(encoder.point_rmse(&self.world, client.mirror(), slices, &view))
    }
}

impl Viewer {
    fn sees(&self, bounds: [Vec3; 2]) -> bool {
        sees(&self.frustum, bounds)
    }
}

fn sees(frustum: &Option<Frustum>, [min, max]: [Vec3; 2]) -> bool {
    frustum
        .as_ref()
        .is_none_or(|frustum| frustum.sees_box(min, max))
}

/// A client's camera relative to the scene's origin.
fn view_of(camera: &uplink::Camera, origin: DVec3) -> Camera {
    Camera {
        position: (DVec3::from(camera.position_m) - origin).as_vec3(),
        forward: Vec3::from(camera.forward),
        up: Vec3::from(camera.up),
        fov_y_rad: camera.fov_y_rad,
        aspect: camera.aspect,
        // Occlusion is sent for whatever the view's sides enclose, at any depth.
        near: 1e-3,
        far: f32::MAX,
    }
}

/// A camera as a client tells it, whose picture has so many rows.
pub fn uplink_camera(camera: &Camera, origin: DVec3, height_px: u32) -> uplink::Camera {
    uplink::Camera {
        position_m: (camera.position.as_dvec3() + origin).to_array(),
        forward: camera.forward.to_array(),
        up: camera.up.to_array(),
        fov_y_rad: camera.fov_y_rad,
        aspect: camera.aspect,
        height_px,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rays that movers need.
    const NEEDED: u64 = 4_000_000;

    /// Frames of a scene where new surfaces take `new` a ray and movers `moving`, until the pace
    /// settles.
    fn settle(pace: &mut Pace, new: f32, moving: f32) -> f32 {
        let mut busy = 0.0;
        for _ in 0..200 {
            let rays = pace.refresh_rays.min(NEEDED);
            busy = pace.converge_rays as f32 * new + moving * rays as f32 / NEEDED as f32;
            let step = StepStats {
                rays,
                waiting: u64::from(rays < NEEDED),
                ..StepStats::default()
            };
            pace.after(busy, &step);
        }
        busy
    }

    #[test]
    fn a_server_under_load_keeps_its_rate_and_takes_up_what_it_left_when_there_is_time() {
        let mut pace = Pace::default();
        let busy = settle(&mut pace, 0.0, 3.0);
        assert!((0.7..=0.85).contains(&busy), "{busy} {pace:?}");
        assert!(pace.refresh_rays < NEEDED / 3);
        settle(&mut pace, 0.0, 0.1);
        assert!(pace.refresh_rays >= NEEDED);
        // New surfaces alone make no mover wait.
        settle(&mut pace, 1e-6, 0.1);
        assert!(pace.refresh_rays >= NEEDED);
        // More than the server can do: all that can wait waits.
        settle(&mut pace, 1.0, 100.0);
        assert_eq!(
            pace,
            Pace {
                converge_rays: 1 << 14,
                refresh_rays: 1 << 14
            }
        );
    }
}
