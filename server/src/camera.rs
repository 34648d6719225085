//! The camera, what it may see, and paths for it through scenes nobody has described.
//!
//! Metres, Y is up. Directions need not be of unit length unless said.

use glam::Vec3;
use rayon::prelude::*;

/// A perspective camera: what a client sends with each frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// The eye.
    pub position: Vec3,
    /// Where it looks; any length above 0.
    pub forward: Vec3,
    /// What is up in the picture; not parallel to `forward`.
    pub up: Vec3,
    /// Full vertical angle of view in radians, above 0 and below π.
    pub fov_y_rad: f32,
    /// Width of the picture over its height, above 0.
    pub aspect: f32,
    /// Nothing nearer along `forward` is drawn; above 0.
    pub near: f32,
    /// Nothing farther along `forward` is drawn; above `near`, may be infinite.
    pub far: f32,
}

impl Camera {
    /// Whether every field is in the range it documents.
    ///
    /// # Errors
    /// Names the field that is not.
    pub fn check(&self) -> Result<(), String> {
        let bad = |what: &str| Err(format!("the camera's {what}"));
        if !self.position.is_finite() {
            return bad("position is not finite");
        }
        if self.forward.try_normalize().is_none() {
            return bad("forward direction is zero or not finite");
        }
        if self.up.try_normalize().is_none() {
            return bad("up direction is zero or not finite");
        }
        if self.forward.normalize().cross(self.up.normalize()).length() < 1e-4 {
            return bad("up direction is parallel to where it looks");
        }
        if !(self.fov_y_rad > 0.0 && self.fov_y_rad < std::f32::consts::PI) {
            return bad("vertical angle of view is not between 0 and 180 degrees");
        }
        if !(self.aspect > 0.0 && self.aspect.is_finite()) {
            return bad("aspect is not above 0");
        }
        if !(self.near > 0.0 && self.far > self.near) {
            return bad("near and far planes are not 0 < near < far");
        }
        Ok(())
    }

    /// Unit vectors to the right, up and forward in the picture. Of a camera that passes
    /// [`Self::check`].
    pub fn axes(&self) -> [Vec3; 3] {
        let forward = self.forward.normalize();
        let right = forward.cross(self.up.normalize()).normalize();
        [right, right.cross(forward), forward]
    }

    /// The ray (origin, unit direction) through the centre of a pixel, counted from the top left,
    /// of a picture of `width` by `height`. Of a camera that passes [`Self::check`]; from any
    /// other the direction may be NaN.
    pub fn ray(&self, x: u32, y: u32, width: u32, height: u32) -> (Vec3, Vec3) {
        self.ray_at(x as f32 + 0.5, y as f32 + 0.5, width, height)
    }

    /// As [`Self::ray`], through any place in the picture: (0, 0) is its top left corner,
    /// (`width`, `height`) its bottom right, pixel centres are at halves.
    pub fn ray_at(&self, x: f32, y: f32, width: u32, height: u32) -> (Vec3, Vec3) {
        let [right, up, forward] = self.axes();
        let tan = (self.fov_y_rad * 0.5).tan();
        let across = (2.0 * x / width as f32 - 1.0) * tan * self.aspect;
        let upward = (1.0 - 2.0 * y / height as f32) * tan;
        (
            self.position,
            (forward + right * across + up * upward).normalize(),
        )
    }
}

/// The extended field of view: what a client may see before the server hears of its next camera.
///
/// The near plane does not bound it, since the camera may step back. What it says not to see is
/// surely outside; what it says to see may be a little outside. It sees what is NaN.
#[derive(Clone, Debug)]
pub struct Frustum {
    apex: Vec3,
    /// Inward normals of the planes through the apex; none if all directions are seen.
    sides: Vec<Vec3>,
    /// Distance from the apex to the far plane's corners: no turn of the camera sees farther.
    reach: f32,
}

impl Frustum {
    /// Each half angle of view is widened by `margin_rad`, 0 or more. A camera that does not pass
    /// [`Camera::check`] sees everything: a client that sends nonsense still gets its points. One
    /// widened to 180 degrees or more sees all directions.
    pub fn new(camera: &Camera, margin_rad: f32) -> Self {
        let mut out = Self {
            apex: camera.position,
            sides: Vec::new(),
            reach: f32::INFINITY,
        };
        if camera.check().is_err() {
            return out;
        }
        let tan_y = (camera.fov_y_rad * 0.5).tan();
        let tan_x = tan_y * camera.aspect;
        out.reach = camera.far * (1.0 + tan_x * tan_x + tan_y * tan_y).sqrt();
        let [right, up, forward] = camera.axes();
        let halves = [
            (right, tan_x.atan() + margin_rad),
            (up, tan_y.atan() + margin_rad),
        ];
        let narrow = |(_, half): &(Vec3, f32)| *half < std::f32::consts::FRAC_PI_2;
        if halves.iter().all(narrow) {
            // Follows from the four, but rules out boxes right behind that straddle each of them.
            out.sides.push(forward);
            for (axis, half) in halves {
                for side in [axis, -axis] {
                    out.sides.push(forward * half.sin() + side * half.cos());
                }
            }
        }
        out
    }

    /// Whether any of a ball may be seen.
    pub fn sees_sphere(&self, center: Vec3, radius: f32) -> bool {
        let to = center - self.apex;
        // Comparisons with NaN are false: unknown is seen.
        let beyond = to.length() - radius > self.reach;
        !beyond && !self.sides.iter().any(|side| side.dot(to) < -radius)
    }

    /// Whether any of an axis-aligned box may be seen.
    pub fn sees_box(&self, min: Vec3, max: Vec3) -> bool {
        let (min, max) = (min - self.apex, max - self.apex);
        let nearest = Vec3::ZERO.max(min).min(max);
        let beyond = nearest.length() > self.reach;
        let outside = |side: &Vec3| {
            // The corner farthest along the normal.
            let corner = Vec3::select(side.cmpgt(Vec3::ZERO), max, min);
            side.dot(corner) < 0.0
        };
        !beyond && !self.sides.iter().any(outside)
    }
}

/// A ray cast: from an origin along a unit direction to the nearest surface, its distance and its
/// unit normal.
pub type Closest<'a> = &'a (dyn Fn(Vec3, Vec3) -> Option<(f32, Vec3)> + Sync);

/// A smooth closed path, walked around and around.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraPath {
    /// Evenly spaced in time; position and unit forward direction.
    keys: Vec<(Vec3, Vec3)>,
    /// Everything but position and forward.
    lens: Camera,
    period_s: f64,
}

const KEYS: usize = 64;
/// Vertical angle of view of paths.
const FOV_Y_RAD: f32 = 55.0 * std::f32::consts::PI / 180.0;
/// How near to a surface a walk comes, as a part of the height of the eyes (0.5 m for a person).
const CLEARANCE: f32 = 0.3;
/// Columns an axis in which a place to walk is looked for.
const COLUMNS: usize = 24;

impl CameraPath {
    /// Chooses a path through any scene, from its bounds and ray casts (up to some two million)
    /// alone.
    ///
    /// Where most places to stand are walled in, it walks an ellipse at eye height, where there is
    /// room and much to see. Eyes are 1.6 m above the floor, but within 10 to 65 % of the scene's
    /// height, for scenes in other units. It keeps 0.3 times that from every surface and looks
    /// along the longer free ways, the middle preferred, slightly down. Anything else it circles,
    /// looking at the middle from above.
    ///
    /// Even and odd `which` differ in place, size and sense: tune on one, report the other. The
    /// same scene always gives the same path. `aspect` is the picture's width over its height.
    ///
    /// # Errors
    /// If the bounds are empty or not finite, or `aspect` is not above 0.
    pub fn find(
        bounds: [Vec3; 2],
        which: u32,
        aspect: f32,
        closest: Closest<'_>,
    ) -> Result<Self, String> {
        let size = bounds[1] - bounds[0];
        let usable = bounds.iter().all(|b| b.is_finite()) && size.is_finite();
        if !usable || size.min_element() < 0.0 || size.max_element() <= 0.0 {
            return Err(format!(
                "the scene's bounds {} to {} are empty or not finite: it needs a triangle",
                bounds[0], bounds[1]
            ));
        }
        if !(aspect > 0.0 && aspect.is_finite()) {
            return Err(format!("the aspect {aspect} is not above 0"));
        }
        let odd = which % 2 == 1;
        let walk = Walk::new(bounds, closest).and_then(|walk| walk.path(odd, aspect));
        Ok(walk.unwrap_or_else(|| Self::orbit(bounds, odd, aspect)))
    }

    /// Seconds for one round.
    pub fn period_s(&self) -> f64 {
        self.period_s
    }

    /// The camera at a time. Any time will do: the path repeats; what is not finite is time 0.
    pub fn at(&self, time_s: f64) -> Camera {
        let along = (time_s / self.period_s).rem_euclid(1.0) * KEYS as f64;
        let along = if along.is_finite() { along } else { 0.0 };
        let (key, t) = (along as usize, along.fract() as f32);
        let at = |i: usize| self.keys[(key + KEYS - 1 + i) % KEYS];
        let [a, b, c, d] = [at(0), at(1), at(2), at(3)];
        Camera {
            position: catmull_rom(a.0, b.0, c.0, d.0, t),
            forward: catmull_rom(a.1, b.1, c.1, d.1, t).normalize_or(b.1),
            ..self.lens
        }
    }

    fn orbit([min, max]: [Vec3; 2], odd: bool, aspect: f32) -> Self {
        let center = (min + max) * 0.5;
        let radius = (max - min).length() * 0.5;
        let half = (FOV_Y_RAD * 0.5)
            .tan()
            .min((FOV_Y_RAD * 0.5).tan() * aspect)
            .atan();
        // The ball around the bounds is larger than what is in it: let it be cut a little.
        let distance = (0.85 * radius / half.sin()).max(1.1 * radius);
        let height = if odd { 38f32 } else { 22f32 }.to_radians();
        let keys = round(odd).map(|angle| {
            let level = Vec3::new(angle.cos(), 0.0, angle.sin()) * height.cos();
            let out = level + Vec3::Y * height.sin();
            (center + out * distance, -out)
        });
        Self {
            keys: keys.collect(),
            lens: lens(aspect, 0.02 * radius, distance + 2.0 * radius),
            period_s: 30.0,
        }
    }
}

fn lens(aspect: f32, near: f32, far: f32) -> Camera {
    Camera {
        position: Vec3::ZERO,
        forward: Vec3::NEG_Z,
        up: Vec3::Y,
        fov_y_rad: FOV_Y_RAD,
        aspect,
        near,
        far,
    }
}

/// Angles of the keys, once around: one way, or the other from a quarter on.
fn round(odd: bool) -> impl Iterator<Item = f32> {
    let turn = std::f32::consts::TAU / KEYS as f32;
    (0..KEYS).map(move |i| {
        if odd {
            0.25 * std::f32::consts::TAU - i as f32 * turn
        } else {
            i as f32 * turn
        }
    })
}

fn catmull_rom(a: Vec3, b: Vec3, c: Vec3, d: Vec3, t: f32) -> Vec3 {
    let cubic = (b - c) * 3.0 + d - a;
    let square = a * 2.0 - b * 5.0 + c * 4.0 - d;
    b + (c - a + (square + cubic * t) * t) * (0.5 * t)
}

fn level(angle: f32) -> Vec3 {
    Vec3::new(angle.cos(), 0.0, angle.sin())
}

/// Looks for somewhere to walk.
struct Walk<'a> {
    closest: Closest<'a>,
    bounds: [Vec3; 2],
    /// Height of the eyes over the floor.
    eye: f32,
    /// Directions in which clearance is probed.
    probes: Vec<Vec3>,
    /// Where one can stand and turn, walled in: the eyes' place.
    places: Vec<Vec3>,
}

/// A round to walk.
struct Ellipse {
    center: Vec3,
    /// Half axes, at right angles and level.
    axes: [Vec3; 2],
}

impl<'a> Walk<'a> {
    /// `None` if most places are in the open.
    fn new(bounds: [Vec3; 2], closest: Closest<'a>) -> Option<Self> {
        let height = bounds[1].y - bounds[0].y;
        let around = (0..24).map(|i| level(std::f32::consts::TAU * i as f32 / 24.0));
        let ball = (0..96).map(|i| {
            // A Fibonacci spiral: evenly over the sphere.
            let y = 1.0 - (2.0 * i as f32 + 1.0) / 96.0;
            level(i as f32 * 2.399_963) * (1.0 - y * y).sqrt() + Vec3::Y * y
        });
        let mut walk = Self {
            closest,
            bounds,
            eye: 1.6f32.clamp(0.1 * height, 0.65 * height),
            probes: around.chain(ball).collect(),
            places: Vec::new(),
        };
        if walk.eye <= 0.0 {
            return None;
        }
        let columns = (0..COLUMNS * COLUMNS).into_par_iter();
        let standing: Vec<Vec3> = columns.flat_map_iter(|i| walk.standing(i)).collect();
        let inside: Vec<Vec3> = standing
            .par_iter()
            .copied()
            .filter(|p| walk.walled_in(*p))
            .collect();
        if inside.len() * 10 < standing.len() * 3 {
            return None;
        }
        walk.places = inside
            .into_par_iter()
            .filter(|p| walk.is_clear(*p))
            .collect();
        (!walk.places.is_empty()).then_some(walk)
    }

    /// Distance to the nearest surface, at most the scene's diagonal.
    fn free(&self, from: Vec3, direction: Vec3) -> f32 {
        let far = (self.bounds[1] - self.bounds[0]).length();
        (self.closest)(from, direction).map_or(far, |(distance, _)| distance.min(far))
    }

    /// The eyes' places over every floor of a column that one can stand upright on.
    fn standing(&self, column: usize) -> Vec<Vec3> {
        let [min, max] = self.bounds;
        let part = Vec3::new((column % COLUMNS) as f32, 0.0, (column / COLUMNS) as f32) + 0.5;
        let step = (max.y - min.y) * 1e-3;
        let mut from = min + (max - min) * part / COLUMNS as f32;
        from.y = max.y + step;
        let mut places = Vec::new();
        // More storeys than this are the same again; it also ends on a scene that never does.
        for _ in 0..16 {
            let Some((distance, normal)) = (self.closest)(from, Vec3::NEG_Y) else {
                break;
            };
            from.y -= distance;
            if normal.y > 0.7 {
                let headroom = self.free(from + Vec3::Y * step, Vec3::Y);
                if headroom > self.eye * (1.0 + CLEARANCE) {
                    places.push(from + Vec3::Y * self.eye);
                }
            }
            from.y -= step;
        }
        places
    }

    /// Surfaces all around, and seen from their front: not inside a solid thing.
    fn walled_in(&self, place: Vec3) -> bool {
        let (mut hits, mut backs, mut rays) = (0, 0, 0);
        for direction in self.probes.iter().filter(|d| (-0.3..0.5).contains(&d.y)) {
            rays += 1;
            if let Some((_, normal)) = (self.closest)(place, *direction) {
                hits += 1;
                backs += usize::from(normal.dot(*direction) > 0.0);
            }
        }
        hits * 10 >= rays * 9 && backs * 4 <= hits
    }

    /// No surface within the clearance. A quarter is added for what lies between the probes.
    fn is_clear(&self, place: Vec3) -> bool {
        let clearance = CLEARANCE * self.eye * 1.25;
        self.probes
            .iter()
            .all(|direction| self.free(place, *direction) >= clearance)
    }

    fn path(&self, odd: bool, aspect: f32) -> Option<CameraPath> {
        let ellipse = self.ellipse(odd)?;
        let places = round(odd).map(|angle| ellipse.at(angle));
        let places: Vec<Vec3> = places.collect();
        let looks = self.looks(&places, ellipse.center);
        let length: f32 = (0..KEYS)
            .map(|i| places[i].distance(places[(i + 1) % KEYS]))
            .sum();
        let diagonal = (self.bounds[1] - self.bounds[0]).length();
        Some(CameraPath {
            keys: places.into_iter().zip(looks).collect(),
            lens: lens(aspect, 0.03 * self.eye, 2.0 * diagonal),
            // A stroll, and not so short a round that one gets dizzy.
            period_s: f64::from(length / (0.8 * self.eye)).max(24.0),
        })
    }

    /// The best round: roomy, with much to see.
    fn ellipse(&self, odd: bool) -> Option<Ellipse> {
        let score = |e: &Ellipse, detail: f32| (e.area().sqrt() + 0.1 * self.eye) * (detail + 0.02);
        // At every place, the free ways from it give the half axes that may fit.
        let longest = 12.0 * self.eye;
        let fits = |center: Vec3| {
            [0.0, 0.125, 0.25, 0.375].map(|part| {
                let angle = std::f32::consts::PI * part;
                let axes = [level(angle), level(angle + std::f32::consts::FRAC_PI_2)].map(|axis| {
                    let free = self.free(center, axis).min(self.free(center, -axis));
                    axis * free.min(longest)
                });
                Ellipse { center, axes }
            })
        };
        let rate = |&place: &Vec3| {
            let (fits, detail) = (fits(place), self.detail(place));
            let best = fits.iter().map(|e| score(e, detail)).fold(0.0, f32::max);
            (best, detail, fits)
        };
        let mut rounds: Vec<_> = self.places.par_iter().map(rate).collect();
        rounds.sort_by(|a, b| b.0.total_cmp(&a.0));
        // The best few that are not all in one spot.
        let apart = 0.05 * (self.bounds[1] - self.bounds[0]).length();
        let mut few: Vec<(f32, Ellipse)> = Vec::new();
        for (_, detail, fits) in rounds {
            let far = |(_, e): &(f32, Ellipse)| e.center.distance(fits[0].center) > apart;
            if few.len() < 64 && few.iter().all(far) {
                few.extend(fits.map(|e| (detail, e)));
            }
        }
        // Then both axes shrink, each for itself, until one can walk there; at worst stand.
        let parts: &[f32] = if odd {
            &[0.6, 0.4, 0.2]
        } else {
            &[0.8, 0.6, 0.4, 0.2]
        };
        let mut scales: Vec<[f32; 2]> = parts
            .iter()
            .flat_map(|a| parts.iter().map(|b| [*a, *b]))
            .chain([[0.0; 2]])
            .collect();
        scales.sort_by(|a, b| (b[0] * b[1]).total_cmp(&(a[0] * a[1])));
        let walkable = few.par_iter().filter_map(|(detail, ellipse)| {
            let mut smaller = scales.iter().map(|s| ellipse.scaled(*s));
            smaller
                .find(|e| self.is_walkable(e))
                .map(|e| (score(&e, *detail), e))
        });
        let walkable: Vec<(f32, Ellipse)> = walkable.collect();
        walkable
            .into_iter()
            .reduce(|a, b| if b.0 > a.0 { b } else { a })
            .map(|(_, e)| e)
    }

    /// How much there is to see from a place: the share of neighbouring rays that do not end on
    /// one plane. 0 in the open, little between bare walls.
    fn detail(&self, place: Vec3) -> f32 {
        const AROUND: usize = 32;
        let (mut edges, mut pairs) = (0, 0);
        for height in [-0.5, -0.25, 0.0, 0.25, 0.5] {
            let ends: Vec<Option<(Vec3, Vec3)>> = (0..AROUND)
                .map(|i| {
                    let way = level(std::f32::consts::TAU * i as f32 / AROUND as f32);
                    let way = (way + Vec3::Y * height).normalize();
                    (self.closest)(place, way).map(|(t, normal)| (place + way * t, normal))
                })
                .collect();
            for i in 0..AROUND {
                pairs += 1;
                edges += match (ends[i], ends[(i + 1) % AROUND]) {
                    (Some((a, normal)), Some((b, _))) => {
                        usize::from(normal.dot(b - a).abs() > 0.05 * a.distance(b))
                    }
                    (None, None) => 0,
                    _ => 1,
                };
            }
        }
        edges as f32 / pairs as f32
    }

    /// Clear, with a floor below, and nothing between one step and the next.
    fn is_walkable(&self, ellipse: &Ellipse) -> bool {
        let places: Vec<Vec3> = round(false).map(|angle| ellipse.at(angle)).collect();
        (0..KEYS).all(|i| {
            let step = places[(i + 1) % KEYS] - places[i];
            let length = step.length();
            let floor = self.free(places[i], Vec3::NEG_Y) / self.eye;
            (0.6..1.5).contains(&floor)
                && self.is_clear(places[i])
                && (length == 0.0 || self.free(places[i], step / length) > length)
        })
    }

    /// Unit directions along the longer free ways, turned evenly from key to key.
    fn looks(&self, places: &[Vec3], middle: Vec3) -> Vec<Vec3> {
        let longest = 12.0 * self.eye;
        let look = |place: &Vec3| {
            let inward = (middle - *place).normalize_or_zero();
            let ways = (0..32).map(|i| level(std::f32::consts::TAU * i as f32 / 32.0));
            let weighed = ways.map(|way| {
                let free = self
                    .free(*place, (way - Vec3::Y * 0.1).normalize())
                    .min(longest);
                way * free * free * (1.3 + way.dot(inward))
            });
            weighed
                .sum::<Vec3>()
                .try_normalize()
                .unwrap_or(if inward == Vec3::ZERO {
                    Vec3::X
                } else {
                    inward
                })
        };
        let mut looks: Vec<Vec3> = places.par_iter().map(look).collect();
        for _ in 0..16 {
            let at = |i: usize| looks[i % KEYS];
            let smooth = |i| (at(i + KEYS - 1) + at(i) * 2.0 + at(i + 1)).normalize_or(at(i));
            looks = (0..KEYS).map(smooth).collect();
        }
        // 11 degrees down: the floor and what moves on it, not the ceiling.
        looks
            .iter()
            .map(|look| (look - Vec3::Y * 0.2).normalize())
            .collect()
    }
}

impl Ellipse {
    fn at(&self, angle: f32) -> Vec3 {
        self.center + self.axes[0] * angle.cos() + self.axes[1] * angle.sin()
    }

    fn area(&self) -> f32 {
        self.axes[0].length() * self.axes[1].length()
    }

    fn scaled(&self, by: [f32; 2]) -> Self {
        Self {
            center: self.center,
            axes: [self.axes[0] * by[0], self.axes[1] * by[1]],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn camera() -> Camera {
        Camera {
            position: Vec3::new(1.0, 2.0, 3.0),
            ..lens(1.5, 0.1, 50.0)
        }
    }

    #[test]
    fn rays_go_through_the_pixels() {
        let c = camera();
        let (origin, middle) = c.ray_at(3.0, 2.0, 6, 4);
        assert_eq!(origin, c.position);
        assert!(middle.distance(Vec3::NEG_Z) < 1e-6);
        let (_, corner) = c.ray_at(6.0, 0.0, 6, 4);
        let tan = (FOV_Y_RAD / 2.0).tan();
        assert!(corner.distance(Vec3::new(1.5 * tan, tan, -1.0).normalize()) < 1e-6);
        assert_eq!(c.ray(2, 1, 6, 4), c.ray_at(2.5, 1.5, 6, 4));
    }

    #[test]
    fn a_camera_that_cannot_see_is_named_and_its_frustum_sees_all() {
        let good = camera();
        assert_eq!(good.check(), Ok(()));
        let nan = f32::NAN;
        for (camera, what) in [
            (
                Camera {
                    position: Vec3::splat(nan),
                    ..good
                },
                "position",
            ),
            (
                Camera {
                    forward: Vec3::ZERO,
                    ..good
                },
                "forward",
            ),
            (
                Camera {
                    forward: Vec3::splat(nan),
                    ..good
                },
                "forward",
            ),
            (
                Camera {
                    up: Vec3::ZERO,
                    ..good
                },
                "up direction is zero",
            ),
            (
                Camera {
                    up: good.forward * -3.0,
                    ..good
                },
                "parallel",
            ),
            (
                Camera {
                    fov_y_rad: nan,
                    ..good
                },
                "angle",
            ),
            (
                Camera {
                    fov_y_rad: 3.2,
                    ..good
                },
                "angle",
            ),
            (
                Camera {
                    aspect: 0.0,
                    ..good
                },
                "aspect",
            ),
            (Camera { near: 0.0, ..good }, "near"),
            (Camera { far: nan, ..good }, "near and far"),
        ] {
            assert!(camera.check().unwrap_err().contains(what), "{what}");
            let frustum = Frustum::new(&camera, 0.0);
            assert!(frustum.sees_sphere(Vec3::splat(1e6), 0.0));
            assert!(frustum.sees_box(Vec3::splat(-1e6), Vec3::splat(-1e5)));
        }
    }

    #[test]
    fn the_frustum_sees_what_is_ahead_and_around_and_skips_the_rest() {
        let c = Camera {
            position: Vec3::ZERO,
            ..camera()
        };
        let f = Frustum::new(&c, 5f32.to_radians());
        assert!(f.sees_sphere(Vec3::new(0.0, 0.0, -10.0), 0.0));
        assert!(f.sees_sphere(Vec3::ZERO, 0.0), "at the eye");
        assert!(
            f.sees_sphere(Vec3::new(0.0, 0.0, 3.0), 20.0),
            "the camera is inside it"
        );
        assert!(!f.sees_sphere(Vec3::new(0.0, 0.0, 10.0), 1.0), "behind");
        assert!(
            !f.sees_sphere(Vec3::new(0.0, 0.0, -200.0), 1.0),
            "beyond the far plane"
        );
        let up = |degrees: f32| Vec3::new(0.0, degrees.to_radians().tan(), -1.0) * 10.0;
        assert!(f.sees_sphere(up(27.5 + 4.9), 0.0), "within the margin");
        assert!(!f.sees_sphere(up(27.5 + 5.1), 0.0), "outside the margin");
        assert!(
            f.sees_box(Vec3::splat(-1.0), Vec3::splat(1.0)),
            "the camera is inside it"
        );
        assert!(
            f.sees_box(Vec3::new(-1e3, -1e3, -11.0), Vec3::new(1e3, 1e3, -10.0)),
            "a wall"
        );
        assert!(
            !f.sees_box(Vec3::new(-1.0, -1.0, 1.0), Vec3::new(1.0, 1.0, 2.0)),
            "behind"
        );
        assert!(!f.sees_box(Vec3::new(-1.0, -1.0, -300.0), Vec3::new(1.0, 1.0, -200.0)));
        assert!(f.sees_sphere(Vec3::splat(f32::NAN), 1.0), "unknown is seen");
        assert!(
            f.sees_box(Vec3::splat(f32::NAN), Vec3::splat(f32::NAN)),
            "unknown is seen"
        );
        let wide = Frustum::new(&c, 80f32.to_radians());
        assert!(
            wide.sees_sphere(Vec3::new(0.0, 0.0, 10.0), 0.0),
            "all directions"
        );
        let endless = Frustum::new(
            &Camera {
                far: f32::INFINITY,
                ..c
            },
            0.0,
        );
        assert!(endless.sees_sphere(Vec3::new(0.0, 0.0, -1e9), 0.0));
    }

    fn unit() -> impl Strategy<Value = Vec3> {
        [-1.0f32..1.0, -1.0..1.0, -1.0..1.0]
            .prop_map(Vec3::from)
            .prop_filter("a direction", |v| v.length() > 0.1)
    }

    proptest! {
        #[test]
        fn nothing_in_the_picture_is_skipped(
            position in unit(), forward in unit(), up in unit(),
            x in 0.0f32..64.0, y in 0.0f32..36.0, depth in 0.1f32..49.0,
            offset in unit(), radius in 0.0f32..5.0, margin in 0.0f32..1.0,
        ) {
            let c = Camera { position: position * 10.0, forward, up, ..camera() };
            prop_assume!(c.check().is_ok());
            let (origin, direction) = c.ray_at(x, y, 64, 36);
            let seen = origin + direction * depth;
            let f = Frustum::new(&c, margin);
            // A ball and a box that hold the point, barely.
            let center = seen + offset.normalize() * radius * 0.999;
            prop_assert!(f.sees_sphere(center, radius + 1e-3));
            let other = seen + offset * radius;
            let slack = Vec3::splat(1e-3);
            prop_assert!(f.sees_box(seen.min(other) - slack, seen.max(other) + slack));
        }
    }

    /// A box; `room` if its front is the inside.
    #[derive(Clone, Copy)]
    struct Block {
        min: Vec3,
        max: Vec3,
        room: bool,
    }

    fn block(min: [f32; 3], max: [f32; 3], room: bool) -> Block {
        Block {
            min: min.into(),
            max: max.into(),
            room,
        }
    }

    fn cast(blocks: &[Block], from: Vec3, direction: Vec3) -> Option<(f32, Vec3)> {
        let mut best: Option<(f32, Vec3)> = None;
        for b in blocks {
            for axis in 0..3 {
                for (plane, out) in [(b.min, -1.0), (b.max, 1.0)] {
                    let t = (plane[axis] - from[axis]) / direction[axis];
                    let hit = from + direction * t;
                    let within =
                        (0..3).all(|i| i == axis || (hit[i] >= b.min[i] && hit[i] <= b.max[i]));
                    if t > 0.0 && within && best.is_none_or(|(nearest, _)| t < nearest) {
                        let mut normal = Vec3::ZERO;
                        normal[axis] = if b.room { -out } else { out };
                        best = Some((t, normal));
                    }
                }
            }
        }
        best
    }

    /// To the nearest surface of a block.
    fn distance(b: &Block, p: Vec3) -> f32 {
        if p.cmpge(b.min).all() && p.cmple(b.max).all() {
            (p - b.min).min(b.max - p).min_element()
        } else {
            p.distance(p.clamp(b.min, b.max))
        }
    }

    fn find(blocks: &[Block], which: u32) -> CameraPath {
        let min = blocks.iter().map(|b| b.min).reduce(Vec3::min).unwrap();
        let max = blocks.iter().map(|b| b.max).reduce(Vec3::max).unwrap();
        CameraPath::find([min, max], which, 16.0 / 9.0, &|o, d| cast(blocks, o, d)).unwrap()
    }

    /// The cameras of a round.
    fn views(path: &CameraPath) -> Vec<Camera> {
        (0..300)
            .map(|i| path.at(path.period_s() * f64::from(i) / 300.0))
            .collect()
    }

    /// How far the rays of a view go.
    fn sight(blocks: &[Block], camera: &Camera) -> Vec<Option<f32>> {
        let pixels = (0..9).flat_map(|y| (0..16).map(move |x| (x, y)));
        let rays = pixels.map(|(x, y)| camera.ray(x, y, 16, 9));
        rays.map(|(o, d)| cast(blocks, o, d).map(|(t, _)| t))
            .collect()
    }

    fn rooms() -> Vec<(&'static str, f32, Vec<Block>)> {
        let room = block([-5.0, 0.0, -4.0], [5.0, 3.0, 4.0], true);
        let hall = block([-20.0, 0.0, -6.0], [20.0, 12.0, 6.0], true);
        let pillars = |n: i32, r: f32| {
            (-n..=n).flat_map(move |i| {
                [-3.0, 3.0].map(|z| {
                    let x = 4.0 * i as f32;
                    block([x - r, 0.0, z - r], [x + r, 11.0, z + r], false)
                })
            })
        };
        let scaled = |blocks: &[Block], s: f32| {
            let scaled = |b: &Block| Block {
                min: b.min * s,
                max: b.max * s,
                ..*b
            };
            blocks.iter().map(scaled).collect::<Vec<_>>()
        };
        let pillar = [room, block([-0.4, 0.0, -0.4], [0.4, 3.0, 0.4], false)];
        vec![
            ("empty room", 1.6, vec![room]),
            ("room with a pillar", 1.6, pillar.to_vec()),
            (
                "model of that room",
                0.033 * 0.65 * 3.0,
                scaled(&pillar, 0.033),
            ),
            ("that room in centimetres", 30.0, scaled(&pillar, 100.0)),
            (
                "hall of pillars",
                1.6,
                [hall].into_iter().chain(pillars(4, 0.3)).collect(),
            ),
            (
                "corridor",
                1.6,
                vec![block([0.0, 0.0, 0.0], [30.0, 2.6, 1.8], true)],
            ),
            (
                "two storeys",
                1.6,
                vec![
                    block([0.0, 0.0, 0.0], [12.0, 3.0, 9.0], true),
                    block([0.0, 3.3, 0.0], [12.0, 6.3, 9.0], true),
                ],
            ),
        ]
    }

    #[test]
    fn walks_keep_clear_of_every_surface_at_eye_height_and_see_the_room() {
        for (name, eye, blocks) in rooms() {
            for which in 0..2 {
                let path = find(&blocks, which);
                for camera in views(&path) {
                    assert_eq!(camera.check(), Ok(()));
                    let p = camera.position;
                    let inside = |b: &&Block| p.cmpgt(b.min).all() && p.cmplt(b.max).all();
                    let floor = blocks.iter().filter(|b| b.room).find(inside);
                    let floor = floor.unwrap_or_else(|| panic!("{name}: out at {p}")).min.y;
                    assert!(
                        (p.y - floor - eye).abs() < 0.02 * eye,
                        "{name}: {}",
                        p.y - floor
                    );
                    for b in &blocks {
                        assert!(b.room || !inside(&b), "{name}: in a pillar at {p}");
                        let near = distance(b, p);
                        assert!(
                            near >= CLEARANCE * eye * 0.99,
                            "{name} {which}: {near} at {p}"
                        );
                    }
                    let mut sight = sight(&blocks, &camera);
                    sight.sort_by(|a, b| a.partial_cmp(b).unwrap());
                    assert!(sight.iter().all(Option::is_some), "{name}: sees out at {p}");
                    let median = sight[sight.len() / 2].unwrap();
                    assert!(
                        median > 0.75 * eye,
                        "{name} {which}: stares at {median} at {p}"
                    );
                }
            }
        }
    }

    #[test]
    fn an_open_court_is_walked_like_a_room() {
        let walls = [
            block([-10.0, 0.0, -10.0], [10.0, 6.0, -9.5], false),
            block([-10.0, 0.0, 9.5], [10.0, 6.0, 10.0], false),
            block([-10.0, 0.0, -9.5], [-9.5, 6.0, 9.5], false),
            block([9.5, 0.0, -9.5], [10.0, 6.0, 9.5], false),
            block([-10.0, -0.5, -10.0], [10.0, 0.0, 10.0], false),
        ];
        for camera in views(&find(&walls, 0)) {
            assert!((camera.position.y - 1.6).abs() < 0.01);
            assert!(camera.position.abs().max_element() < 9.5);
            let sight = sight(&walls, &camera);
            assert!(sight.iter().flatten().count() * 4 > sight.len() * 3);
        }
    }

    #[test]
    fn objects_and_open_land_are_circled_from_outside() {
        let statue = vec![block([-0.3, 0.0, -0.3], [0.3, 1.9, 0.3], false)];
        let sheet = vec![block([-5.0, 0.0, -5.0], [5.0, 0.0, 5.0], false)];
        let house = vec![
            block([-30.0, -1.0, -30.0], [30.0, 0.0, 30.0], false),
            block([-4.0, 0.0, -3.0], [4.0, 3.0, 3.0], true),
            block([-4.2, 0.0, -3.2], [4.2, 3.2, 3.2], false),
        ];
        for (name, blocks) in [("statue", statue), ("sheet", sheet), ("house", house)] {
            for which in 0..2 {
                let path = find(&blocks, which);
                for camera in views(&path) {
                    assert_eq!(camera.check(), Ok(()));
                    for b in &blocks {
                        let p = camera.position;
                        let inside = p.cmpge(b.min).all() && p.cmple(b.max).all();
                        assert!(!inside && p.y > (b.min.y + b.max.y) / 2.0, "{name}: {p}");
                    }
                    let seen = sight(&blocks, &camera).iter().flatten().count();
                    assert!(seen >= 12, "{name} {which}: {seen} of 144 rays hit");
                }
            }
        }
    }

    #[test]
    fn paths_repeat_are_smooth_and_the_same_each_time() {
        for (name, eye, blocks) in rooms() {
            let path = find(&blocks, 0);
            assert_eq!(path, find(&blocks, 0), "{name}");
            assert_eq!(path, find(&blocks, 2), "{name}");
            let period = path.period_s();
            let near = |a: Camera, b: Camera| {
                a.position.distance(b.position) < 0.01 * eye && a.forward.distance(b.forward) < 0.01
            };
            assert!(near(path.at(1.0), path.at(1.0 + period)));
            assert!(near(path.at(-1.0), path.at(period - 1.0)));
            assert_eq!(path.at(f64::NAN), path.at(0.0));
            // At 60 frames a second, no step above 3 m/s at eye height 1.6, no turn above 90
            // degrees a second.
            let mut last = path.at(0.0);
            for frame in 1..=(period * 60.0) as u32 {
                let camera = path.at(f64::from(frame) / 60.0);
                let step = camera.position.distance(last.position) / eye;
                let turn = camera.forward.angle_between(last.forward).to_degrees();
                assert!(
                    step < 3.0 / 1.6 / 60.0 && turn < 1.5,
                    "{name} at {frame}: {step} {turn}"
                );
                last = camera;
            }
        }
    }

    #[test]
    fn the_path_for_tuning_is_not_the_path_for_figures() {
        for (name, eye, blocks) in rooms() {
            let (tuning, figures) = (find(&blocks, 0), find(&blocks, 1));
            let apart = |i: u32| {
                let (a, b) = (tuning.at(f64::from(i)), figures.at(f64::from(i)));
                a.position.distance(b.position) / eye + a.forward.distance(b.forward)
            };
            let mean = (0..24).map(apart).sum::<f32>() / 24.0;
            assert!(mean > 0.3, "{name}: {mean}");
        }
    }

    #[test]
    fn bounds_of_nothing_are_refused() {
        let find = |min: f32, max: f32, aspect| {
            CameraPath::find([Vec3::splat(min), Vec3::splat(max)], 0, aspect, &|_, _| {
                None
            })
        };
        for (min, max) in [
            (1.0, -1.0),
            (0.0, 0.0),
            (f32::NAN, 1.0),
            (0.0, f32::INFINITY),
        ] {
            assert!(find(min, max, 1.0).unwrap_err().contains("bounds"));
        }
        assert!(find(f32::MIN, f32::MAX, 1.0).is_err());
        assert!(find(0.0, 1.0, 0.0).unwrap_err().contains("aspect"));
        assert!(
            find(0.0, 1.0, 1.0).is_ok(),
            "a scene that no ray hits is circled"
        );
    }
}
