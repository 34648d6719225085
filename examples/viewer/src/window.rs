//! A window, and a camera that flies, circles or walks.

use crate::feed::Feed;
use crate::picture::{Mode, Overlay, Pictures, Shown};
use crate::{Args, path, text};
use glam::Vec3;
use psao_server::camera::{Camera, CameraPath};
use psao_server::gpu::Gpu;
use psao_server::scene::Scene;
use psao_server::server::uplink_camera;
use std::collections::{HashSet, VecDeque};
use std::sync::Arc;
use std::time::Instant;
use winit::application::ApplicationHandler;
use winit::dpi::PhysicalSize;
use winit::event::{DeviceEvent, DeviceId, ElementState, MouseButton, WindowEvent};
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop};
use winit::keyboard::{KeyCode, PhysicalKey};
use winit::window::{Window, WindowId};

/// How the camera moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Moves {
    /// As keys and mouse say.
    Fly,
    /// Around what was in the middle.
    Orbit,
    /// Along the path that recordings walk.
    Walk,
}

/// Seconds that the rate in the corner is of.
const RATE_S: f64 = 1.0;
/// Seconds of one turn around what is in the middle.
const TURN_S: f32 = 20.0;
/// Rays that each picture of the reference adds: few, so that the window answers.
const RAYS: u32 = 4;
/// Radians a pixel of the mouse.
const LOOK: f32 = 0.004;

struct Open {
    window: Arc<Window>,
    surface: wgpu::Surface<'static>,
    config: wgpu::SurfaceConfiguration,
    gpu: Gpu,
    pictures: Option<Pictures>,
}

struct App<'a> {
    args: &'a Args,
    scene: Scene,
    feed: Feed,
    path: CameraPath,
    shown: Option<Open>,
    camera: Camera,
    moves: Moves,
    /// What the camera circles.
    middle: Vec3,
    /// Metres a second.
    speed: f32,
    mode: Mode,
    overlay: Overlay,
    held: HashSet<KeyCode>,
    dragging: bool,
    paused: bool,
    /// Seconds of the recording that have passed.
    elapsed_s: f64,
    before: Instant,
    /// When, and how many bytes had come.
    received: VecDeque<(f64, u64)>,
    start: Instant,
    presented: bool,
    error: Option<String>,
}

/// Runs until the window is closed.
pub fn run(args: &Args, scene: Scene, feed: Feed) -> Result<(), String> {
    let path = path(&scene, args.size.0 as f32 / args.size.1 as f32)?;
    let no_window = |error: &dyn std::fmt::Display| {
        format!("no window: {error}: without a display, use --headless --out FILE.png")
    };
    let events = EventLoop::new().map_err(|error| no_window(&error))?;
    events.set_control_flow(ControlFlow::Poll);
    let mut pose = psao_server::scene::Pose::default();
    scene.pose(0.0, &mut pose);
    let [low, high] = scene.bounds(&pose);
    let mut app = App {
        camera: path.at(0.0),
        middle: (low + high) * 0.5,
        speed: (high - low).length() / 10.0,
        args,
        scene,
        feed,
        path,
        shown: None,
        moves: Moves::Walk,
        mode: args.mode,
        overlay: args.overlay,
        held: HashSet::new(),
        dragging: false,
        paused: false,
        elapsed_s: 0.0,
        before: Instant::now(),
        received: VecDeque::new(),
        start: Instant::now(),
        presented: false,
        error: None,
    };
    events
        .run_app(&mut app)
        .map_err(|error| no_window(&error))?;
    app.error.map_or(Ok(()), Err)
}

impl ApplicationHandler for App<'_> {
    fn resumed(&mut self, events: &ActiveEventLoop) {
        if self.shown.is_none() {
            match self.open(events) {
                Ok(shown) => self.shown = Some(shown),
                Err(error) => self.fail(events, error),
            }
        }
    }

    fn window_event(&mut self, events: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        match event {
            WindowEvent::CloseRequested => events.exit(),
            WindowEvent::Resized(size) => {
                if let Err(error) = self.resize(size) {
                    self.fail(events, error);
                }
            }
            WindowEvent::KeyboardInput { event, .. } => {
                if let PhysicalKey::Code(key) = event.physical_key {
                    match event.state {
                        ElementState::Pressed if event.repeat => {}
                        ElementState::Pressed => {
                            self.held.insert(key);
                            self.pressed(events, key);
                        }
                        ElementState::Released => {
                            self.held.remove(&key);
                        }
                    }
                }
            }
            WindowEvent::MouseInput {
                state,
                button: MouseButton::Left,
                ..
            } => self.dragging = state == ElementState::Pressed,
            WindowEvent::RedrawRequested => {
                if let Err(error) = self.draw() {
                    self.fail(events, error);
                }
            }
            _ => {}
        }
    }

    fn device_event(&mut self, _: &ActiveEventLoop, _: DeviceId, event: DeviceEvent) {
        if let DeviceEvent::MouseMotion { delta } = event
            && self.dragging
        {
            self.moves = Moves::Fly;
            let [right, _, forward] = self.camera.axes();
            let turned = glam::Quat::from_rotation_y(-delta.0 as f32 * LOOK)
                * glam::Quat::from_axis_angle(right, -delta.1 as f32 * LOOK)
                * forward;
            // Not straight up or down, where left and right swap.
            if turned.y.abs() < 0.99 {
                self.camera.forward = turned;
            }
        }
    }

    fn about_to_wait(&mut self, _: &ActiveEventLoop) {
        if let Some(shown) = &self.shown {
            shown.window.request_redraw();
        }
    }
}

impl App<'_> {
    fn fail(&mut self, events: &ActiveEventLoop, error: String) {
        self.error.get_or_insert(error);
        events.exit();
    }

    fn open(&self, events: &ActiveEventLoop) -> Result<Open, String> {
        let size = PhysicalSize::new(self.args.size.0 as u32, self.args.size.1 as u32);
        let attributes = Window::default_attributes()
            .with_title("PSAO")
            .with_inner_size(size);
        let window = events
            .create_window(attributes)
            .map_err(|error| error.to_string())?;
        let window = Arc::new(window);
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
        let surface = instance.create_surface(Arc::clone(&window));
        let surface = surface.map_err(|error| format!("the window takes no pictures: {error}"))?;
        let (gpu, adapter) = Gpu::of(
            &instance,
            Some(&surface),
            wgpu::ExperimentalFeatures::disabled(),
        )?;
        let size = window.inner_size();
        let mut config = surface
            .get_default_config(&adapter, size.width.max(1), size.height.max(1))
            .ok_or_else(|| format!("{} draws in no such window", gpu.name()))?;
        // What the shader writes is meant to be shown as it is.
        config.format = config.format.remove_srgb_suffix();
        surface.configure(&gpu.device, &config);
        Ok(Open {
            window,
            surface,
            config,
            gpu,
            pictures: None,
        })
    }

    fn resize(&mut self, size: PhysicalSize<u32>) -> Result<(), String> {
        let Some(shown) = &mut self.shown else {
            return Ok(());
        };
        // A window that is put away has no size.
        if size.width == 0 || size.height == 0 {
            return Ok(());
        }
        (shown.config.width, shown.config.height) = (size.width, size.height);
        shown.surface.configure(&shown.gpu.device, &shown.config);
        if let Some(pictures) = &mut shown.pictures {
            pictures.resize(&shown.gpu, [size.width, size.height])?;
        }
        Ok(())
    }

    fn pressed(&mut self, events: &ActiveEventLoop, key: KeyCode) {
        match key {
            KeyCode::Escape => events.exit(),
            KeyCode::Digit1 => self.mode = Mode::Ao,
            KeyCode::Digit2 => self.mode = Mode::Reference,
            KeyCode::Digit3 => self.mode = Mode::Screen,
            KeyCode::Digit4 => self.mode = Mode::Off,
            KeyCode::Tab => {
                self.overlay = match self.overlay {
                    Overlay::None => Overlay::Cells,
                    Overlay::Cells => Overlay::Points,
                    Overlay::Points => Overlay::Dirty,
                    Overlay::Dirty => Overlay::Occupancy,
                    Overlay::Occupancy => Overlay::None,
                }
            }
            KeyCode::KeyO => self.moves = Moves::Orbit,
            KeyCode::KeyP => self.moves = Moves::Walk,
            KeyCode::Space => self.paused = !self.paused,
            _ => {}
        }
    }

    /// Moves the camera by what `seconds` allow.
    fn fly(&mut self, seconds: f32) {
        let axis = |plus, minus| {
            let held = |key| f32::from(u8::from(self.held.contains(&key)));
            held(plus) - held(minus)
        };
        let [right, _, forward] = self.camera.axes();
        let way = right * axis(KeyCode::KeyD, KeyCode::KeyA)
            + Vec3::Y * axis(KeyCode::KeyE, KeyCode::KeyQ)
            + forward * axis(KeyCode::KeyW, KeyCode::KeyS);
        if way != Vec3::ZERO {
            self.moves = Moves::Fly;
        }
        match self.moves {
            Moves::Fly => self.camera.position += way * (self.speed * seconds),
            Moves::Orbit => {
                let turn = glam::Quat::from_rotation_y(seconds / TURN_S * std::f32::consts::TAU);
                let arm = turn * (self.camera.position - self.middle);
                self.camera.position = self.middle + arm;
                let forward = -arm.normalize_or(Vec3::Z);
                if forward.y.abs() < 0.99 {
                    self.camera.forward = forward;
                }
            }
            Moves::Walk => self.camera = self.path.at(self.feed.time_s()),
        }
    }

    fn draw(&mut self) -> Result<(), String> {
        let seconds = self.before.elapsed().as_secs_f64();
        self.before = Instant::now();
        if !self.paused {
            self.elapsed_s += seconds;
        }
        if self.feed.follow(self.elapsed_s)? {
            self.elapsed_s = 0.0;
        }
        self.fly(seconds as f32);
        let mbit = self.rate();
        let Some(shown) = &mut self.shown else {
            return Ok(());
        };
        let size = [shown.config.width, shown.config.height];
        self.camera.aspect = size[0] as f32 / size[1] as f32;
        self.feed
            .tell(&uplink_camera(&self.camera, self.scene.origin, size[1]));
        if self.feed.last.is_none() {
            return Ok(());
        }
        let gpu = &shown.gpu;
        if shown.pictures.is_none() {
            let format = shown.config.format;
            let pictures = Pictures::new(gpu, &self.scene, size, format, &self.feed.client)?;
            shown.pictures = Some(pictures);
        }
        let Some(pictures) = &mut shown.pictures else {
            return Ok(());
        };
        let texture = match shown.surface.get_current_texture() {
            wgpu::CurrentSurfaceTexture::Success(texture)
            | wgpu::CurrentSurfaceTexture::Suboptimal(texture) => texture,
            wgpu::CurrentSurfaceTexture::Outdated | wgpu::CurrentSurfaceTexture::Lost => {
                shown.surface.configure(&gpu.device, &shown.config);
                return Ok(());
            }
            // Nobody sees it.
            _ => return Ok(()),
        };
        let mut lines = text(&self.feed, pictures, self.mode, self.overlay, mbit);
        lines.push(format!("picture    {:.1} ms", seconds * 1e3));
        let what = Shown {
            camera: &self.camera,
            mode: self.mode,
            rays: RAYS,
            overlay: self.overlay,
            text: &lines,
        };
        let view = texture.texture.create_view(&Default::default());
        let time_s = self.feed.time_s();
        pictures.draw(
            gpu,
            &self.scene,
            time_s,
            &mut self.feed.client,
            &what,
            &view,
        )?;
        gpu.queue.present(texture);
        if !self.presented {
            self.presented = true;
            println!("first picture");
        }
        Ok(())
    }

    /// Megabits that came in the last second.
    fn rate(&mut self) -> f64 {
        let now = self.start.elapsed().as_secs_f64();
        self.received
            .push_back((now, self.feed.client.stats().bytes));
        while self.received.len() > 2 && now - self.received[1].0 > RATE_S {
            self.received.pop_front();
        }
        let (Some(first), Some(last)) = (self.received.front(), self.received.back()) else {
            return 0.0;
        };
        let seconds = (last.0 - first.0).max(1e-3);
        last.1.saturating_sub(first.1) as f64 * 8e-6 / seconds
    }
}
