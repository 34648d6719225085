//! Points moved along their surface to places that cost fewer bits: those of a lattice.
//!
//! A place in a patch is exact to 1/32 of a cell, which along the surface is more than a picture
//! needs. What a point says is traced where it lies; so it is moved, before elimination evens out
//! distances, by a fraction of these, to where a coarser place is exact again.

use crate::points::{SurfacePoint, in_hole};
use crate::scene::Mesh;
use crate::truth::Placement;
use glam::{DVec2, DVec3, Vec3};
use psao_core::Instance;
use psao_core::topology::{self, settled};
use std::collections::HashMap;

/// No triangle lies beyond that edge, or not one alone, or it is turned too far.
const NONE: u32 = u32::MAX;

/// How far the normals of two triangles may differ for a point to move from one to the other: the
/// cosine.
const SMOOTH: f64 = 0.8;

/// The lattice has a place each 2^`SHIFT` steps, 4 a cell: 9 for each point, of which elimination
/// finds as even a set as among all places. With 2 a cell it no longer does.
const SHIFT: u32 = 3;

/// The distance of its places, cells.
const LENGTH: f64 = (1 << SHIFT) as f64 / 32.0;

/// How many lengths of the lattice a point may move.
const FARTHEST: f64 = 2.0;

/// Most triangles to pass on the way.
const MOST_PASSED: usize = 12;

/// Where points of a mesh may lie, in the cells of its grid.
pub struct Lattice<'a> {
    cells: Cells<'a>,
    /// Each triangle's neighbours: opposite of its corners.
    beyond: Vec<[u32; 3]>,
}

/// A mesh in its grid's cells.
#[derive(Clone, Copy)]
struct Cells<'a> {
    mesh: &'a Mesh,
    grid: &'a Instance,
}

impl<'a> Lattice<'a> {
    /// The lattice of a mesh in a grid around it.
    pub fn new(mesh: &'a Mesh, grid: &'a Instance) -> Lattice<'a> {
        let cells = Cells { mesh, grid };
        Lattice {
            cells,
            beyond: neighbours(mesh),
        }
    }

    /// The nearest point of the lattice on the smooth surface around one; the same point if there
    /// is none near.
    pub fn settle(&self, point: SurfacePoint) -> SurfacePoint {
        let Some(place) = self.cells.place(&point) else {
            return point;
        };
        let across = topology::across(place.normal);
        let at = self.cells.position(&point);
        let along = flat(at, across);
        // A step's middle stands for all of a place.
        let middle = DVec2::splat((f64::from(settled(0, SHIFT)) + 0.5) / 32.0);
        let near = (along / LENGTH).floor();
        let offset = along - near * LENGTH;
        let beside = DVec2::select(offset.cmplt(middle), DVec2::NEG_ONE, DVec2::ONE);
        let mut targets = [DVec2::ZERO, DVec2::X, DVec2::Y, DVec2::ONE]
            .map(|by| (near + by * beside) * LENGTH + middle);
        targets.sort_by_key(|target| target.distance_squared(along).to_bits());
        let settles = |target: DVec2| {
            let moved = self.walk(&point, target, across)?;
            let place = self.cells.place(&moved)?;
            let stays = self.cells.position(&moved).distance(at) < FARTHEST * LENGTH
                && topology::across(place.normal) == across
                && settle_steps(place.steps(), across) == place.steps()
                && !in_hole(self.cells.mesh, &moved);
            stays.then_some(moved)
        };
        targets.into_iter().find_map(settles).unwrap_or(point)
    }

    /// Goes over smooth edges to the triangle that has a place along the two other axes.
    fn walk(&self, from: &SurfacePoint, target: DVec2, across: usize) -> Option<SurfacePoint> {
        let mut triangle = from.triangle;
        let mut facing = 0.0;
        for _ in 0..MOST_PASSED {
            let corners = self.cells.mesh.triangles[triangle as usize];
            let [a, b, c] = corners.map(|i| {
                flat(self.cells.of(self.cells.mesh.positions[i as usize]), across) - target
            });
            let whole = (b - a).perp_dot(c - a);
            // Seen from the side, or from behind: the surface has folded.
            if whole.abs() < 1e-9 || whole * facing < 0.0 {
                return None;
            }
            facing = whole;
            let weights = [b.perp_dot(c), c.perp_dot(a), a.perp_dot(b)].map(|w| w / whole);
            let least = (0..3).min_by(|i, j| weights[*i].total_cmp(&weights[*j]))?;
            if weights[least] >= 0.0 {
                return Some(SurfacePoint {
                    triangle,
                    u: weights[1] as f32,
                    v: weights[2] as f32,
                    back: from.back,
                });
            }
            triangle = self.beyond[triangle as usize][least];
            if triangle == NONE {
                return None;
            }
        }
        None
    }
}

impl Cells<'_> {
    /// The place of a point as it is.
    fn place(&self, point: &SurfacePoint) -> Option<Placement> {
        let Mesh {
            triangles,
            positions,
            normals,
            ..
        } = self.mesh;
        let normal = point.normal(triangles, positions, normals);
        Placement::of(self.grid, point.position(triangles, positions), normal)
    }

    fn position(&self, point: &SurfacePoint) -> DVec3 {
        self.of(point.position(&self.mesh.triangles, &self.mesh.positions))
    }

    fn of(&self, local: Vec3) -> DVec3 {
        let origin = Vec3::from(self.grid.origin).as_dvec3();
        (local.as_dvec3() - origin) * Vec3::from(self.grid.cells_per_unit).as_dvec3()
    }
}

/// The place on the lattice that a client has for a point: where it lies, if [`Lattice::settle`]
/// found that; else one beside it, in the plane of its triangle. `None` outside the grid.
pub fn place(mesh: &Mesh, grid: &Instance, point: &SurfacePoint) -> Option<Placement> {
    let cells = Cells { mesh, grid };
    let as_it_is = cells.place(point)?;
    let across = topology::across(as_it_is.normal);
    let mut steps = settle_steps(as_it_is.steps(), across);
    if steps != as_it_is.steps() {
        let normal = point.geometric_normal(&mesh.triangles, &mesh.positions);
        let normal = (normal * Vec3::from(grid.normal_scale)).as_dvec3();
        let at = cells.position(point);
        let to = DVec3::from(steps.map(|s| (f64::from(s) + 0.5) / 32.0));
        let (by, slope) = (flat(to - at, across), flat(normal, across));
        let rise = -by.dot(slope) / normal[across];
        // A triangle on edge says nothing.
        let rise = if rise.abs() < FARTHEST * LENGTH {
            rise
        } else {
            0.0
        };
        let last = f64::from(grid.dims[across]) * 32.0 - 1.0;
        steps[across] = ((at[across] + rise) * 32.0).floor().clamp(0.0, last) as u32;
    }
    Some(Placement::at(steps, as_it_is.normal))
}

/// The steps of the lattice's place around a place.
fn settle_steps(mut steps: [u32; 3], across: usize) -> [u32; 3] {
    for axis in (0..3).filter(|axis| *axis != across) {
        steps[axis] = settled(steps[axis], SHIFT);
    }
    steps
}

/// What is left without an axis.
fn flat(v: DVec3, without: usize) -> DVec2 {
    match without {
        0 => DVec2::new(v.y, v.z),
        1 => DVec2::new(v.x, v.z),
        _ => DVec2::new(v.x, v.y),
    }
}

/// Which triangle lies beyond each edge: vertices in one place are one.
fn neighbours(mesh: &Mesh) -> Vec<[u32; 3]> {
    let mut places: HashMap<[u32; 3], u32> = HashMap::new();
    let welded: Vec<u32> = mesh
        .positions
        .iter()
        .map(|p| {
            let next = places.len() as u32;
            *places
                .entry((*p + 0.0).to_array().map(f32::to_bits))
                .or_insert(next)
        })
        .collect();
    let normals: Vec<DVec3> = mesh
        .triangles
        .iter()
        .map(|t| {
            let [a, b, c] = t.map(|i| mesh.positions[i as usize].as_dvec3());
            (b - a).cross(c - a).normalize_or_zero()
        })
        .collect();
    // From each edge's direction, the triangle and its corner on the other side.
    let mut edges: HashMap<[u32; 2], Option<(u32, u8)>> = HashMap::new();
    let sides = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|i| welded[i as usize]);
        [[b, c], [c, a], [a, b]]
    };
    for (number, triangle) in mesh.triangles.iter().enumerate() {
        for (corner, side) in sides(triangle).into_iter().enumerate() {
            edges
                .entry(side)
                .and_modify(|has| *has = None)
                .or_insert(Some((number as u32, corner as u8)));
        }
    }
    let beyond = |(number, triangle): (usize, &[u32; 3])| {
        sides(triangle).map(|[from, to]| {
            let other = edges.get(&[to, from]).copied().flatten();
            let smooth =
                |(other, _): &(u32, u8)| normals[number].dot(normals[*other as usize]) > SMOOTH;
            other.filter(smooth).map_or(NONE, |(other, _)| other)
        })
    };
    mesh.triangles.iter().enumerate().map(beyond).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::points::{generate_with, largest_radius};
    use crate::truth::fit;

    /// A wavy sheet of 3 units, two triangles a quad, and a grid of cells of `cell` units.
    fn sheet(quads: u32, cell: f32) -> (Mesh, Instance) {
        let mut mesh = Mesh::default();
        for i in 0..=quads {
            for j in 0..=quads {
                let [x, y] = [i, j].map(|k| 3.0 * k as f32 / quads as f32);
                let height = 0.2 * (2.0 * x).sin() * (1.5 * y).cos();
                let slope = [
                    0.4 * (2.0 * x).cos() * (1.5 * y).cos(),
                    -0.3 * (2.0 * x).sin() * (1.5 * y).sin(),
                ];
                mesh.positions.push(Vec3::new(x, y, height));
                mesh.normals
                    .push(Vec3::new(-slope[0], -slope[1], 1.0).normalize());
            }
        }
        for i in 0..quads {
            for j in 0..quads {
                let [a, b] = [i * (quads + 1) + j, (i + 1) * (quads + 1) + j];
                mesh.triangles.extend([[a, b, b + 1], [a, b + 1, a + 1]]);
            }
        }
        let bounds = [Vec3::new(0.0, 0.0, -0.2), Vec3::new(3.0, 3.0, 0.2)];
        let grid = fit(bounds, Vec3::ONE, cell, 0.8).unwrap();
        (mesh, grid)
    }

    fn points(mesh: &Mesh) -> impl Iterator<Item = SurfacePoint> {
        (0..mesh.triangles.len() as u32).map(|triangle| SurfacePoint {
            triangle,
            u: 0.2,
            v: 0.3,
            back: false,
        })
    }

    #[test]
    fn points_of_a_smooth_surface_lie_where_a_client_has_them() {
        for quads in [3, 80] {
            let (mesh, grid) = sheet(quads, 0.1);
            let lattice = Lattice::new(&mesh, &grid);
            let (mut exact, mut all) = (0, 0);
            for point in points(&mesh) {
                let cells = lattice.cells;
                let moved = lattice.settle(point);
                let by = cells.position(&moved) - cells.position(&point);
                assert!(by.length() < FARTHEST * LENGTH);
                let again = lattice.settle(moved);
                let by = cells.position(&again) - cells.position(&moved);
                assert!(by.length() < 1e-3, "it is settled");
                let has = place(&mesh, &grid, &moved).unwrap();
                let across = topology::across(has.normal);
                assert_eq!(settle_steps(has.steps(), across), has.steps());
                all += 1;
                exact += usize::from(cells.place(&moved) == Some(has));
            }
            assert!(exact * 100 >= all * 95, "{exact} of {all}");
        }
    }

    #[test]
    fn points_on_the_lattice_are_spread_as_evenly_as_anywhere() {
        let density = 512.0;
        let radius = 2.0 * largest_radius(density) as f32;
        let (mesh, grid) = sheet(40, 1.25 * radius);
        let lattice = Lattice::new(&mesh, &grid);
        let (fine, _) = sheet(120, 1.0);
        // How far it is from anywhere to the nearest point, the root of the mean square.
        let gap = |lattice: Option<&Lattice<'_>>| {
            let set = generate_with(&mesh, Vec3::ONE, density, None, lattice, 1).unwrap();
            let at = |p: &SurfacePoint| p.position(&mesh.triangles, &mesh.positions);
            let points: Vec<Vec3> = set.points.iter().map(at).collect();
            let nearest = |place: SurfacePoint| {
                let place = place.position(&fine.triangles, &fine.positions);
                let far = points.iter().map(|p| p.distance_squared(place));
                f64::from(far.fold(f32::INFINITY, f32::min))
            };
            let squares: f64 = self::points(&fine).map(nearest).sum();
            (squares / fine.triangles.len() as f64).sqrt()
        };
        let [free, bound] = [gap(None), gap(Some(&lattice))];
        assert!(bound < 1.01 * free, "{bound} instead of {free}");
    }

    #[test]
    fn a_point_of_a_surface_without_a_place_of_the_lattice_stays_and_gets_one_beside_it() {
        // Cells so large that hardly any triangle holds a place; each is a surface of its own.
        let (mut mesh, grid) = sheet(20, 3.0);
        let corners: Vec<u32> = mesh.triangles.iter().flatten().copied().collect();
        mesh.positions = corners
            .iter()
            .map(|i| mesh.positions[*i as usize])
            .collect();
        mesh.normals = corners.iter().map(|i| mesh.normals[*i as usize]).collect();
        for (position, number) in mesh.positions.iter_mut().zip(0..) {
            position.z += (number / 3) as f32 * 1e-6;
        }
        let numbers = (0..corners.len() as u32 / 3).map(|i| 3 * i);
        mesh.triangles = numbers.map(|i| [i, i + 1, i + 2]).collect();
        let lattice = Lattice::new(&mesh, &grid);
        let mut stayed = 0;
        for point in points(&mesh) {
            let moved = lattice.settle(point);
            let has = place(&mesh, &grid, &moved).unwrap();
            let across = topology::across(has.normal);
            assert_eq!(settle_steps(has.steps(), across), has.steps());
            let to = DVec3::from(has.steps().map(|s| (f64::from(s) + 0.5) / 32.0));
            assert!(to.distance(lattice.cells.position(&point)) < 2.0 * FARTHEST * LENGTH);
            stayed += usize::from(moved == point);
        }
        assert!(stayed * 10 > mesh.triangles.len() * 9, "{stayed}");
    }
}
