//! Triangles under a tree, in one space.

use std::collections::HashMap;

use glam::{Affine3A, Vec3, Vec3A, Vec3Swizzles};
use obvhs::{
    BvhBuildParams,
    aabb::Aabb,
    bvh2::{Bvh2, leaf_collapser::collapse, node::Bvh2Node, reinsertion::ReinsertionOptimizer},
    faststack::FastStack,
    ploc::PlocBuilder,
    ray::{Ray, RayHit},
};

use super::fan::Rays;
use super::lanes::Lanes;

/// For trees that are built once and traced often. On Sponza, dearer builds than this trace no
/// faster.
pub(super) const STATIC: BvhBuildParams = BvhBuildParams::fast_build();
/// For the tree over movers, built every frame.
pub(super) const TOP: BvhBuildParams = BvhBuildParams::fastest_build();

/// Levels of a binary tree from PLOC beyond which it is a chain rather than a tree.
const MAX_DEPTH: usize = 96;
/// Coordinates beyond this would overflow in products.
const MAX_COORDINATE: f32 = 1e15;

/// A triangle, laid out so that its three edges are tested at once.
#[derive(Clone, Copy)]
pub(super) struct Corners {
    x: Vec3A,
    y: Vec3A,
    z: Vec3A,
    /// Not of unit length.
    normal: Vec3A,
}

impl Corners {
    /// A corner that is not finite, or absurdly far out, makes a triangle that is never hit.
    pub(super) fn new(corners: [Vec3; 3]) -> Corners {
        let sane = |p: &Vec3| p.abs().cmple(Vec3::splat(MAX_COORDINATE)).all();
        let [a, b, c] = if corners.iter().all(sane) {
            corners
        } else {
            [Vec3::ZERO; 3]
        };
        Corners {
            x: Vec3A::new(a.x, b.x, c.x),
            y: Vec3A::new(a.y, b.y, c.y),
            z: Vec3A::new(a.z, b.z, c.z),
            normal: Vec3A::from((b - a).cross(c - a)),
        }
    }

    fn bounds(&self) -> Aabb {
        Aabb::new(
            Vec3A::new(
                self.x.min_element(),
                self.y.min_element(),
                self.z.min_element(),
            ),
            Vec3A::new(
                self.x.max_element(),
                self.y.max_element(),
                self.z.max_element(),
            ),
        )
    }

    /// The triangle as rays from a place see it.
    #[inline(always)]
    fn seen(&self, o: Vec3A) -> Seen {
        let (x, y, z) = (self.x - o.x, self.y - o.y, self.z - o.z);
        let ex = x.zxy() - x.yzx();
        let ey = y.zxy() - y.yzx();
        let ez = z.zxy() - z.yzx();
        let sx = x.zxy() + x.yzx();
        let sy = y.zxy() + y.yzx();
        let sz = z.zxy() + z.yzx();
        Seen {
            edges: [ey * sz - ez * sy, ez * sx - ex * sz, ex * sy - ey * sx],
            normal: self.normal,
            along_normal: self.normal.dot(Vec3A::new(x.x, y.x, z.x)),
        }
    }

    /// The same, unless it is wholly `behind` the plane through `o`.
    #[inline(always)]
    pub(super) fn seen_from(&self, o: Vec3A, plane: Vec3A, behind: f32) -> Option<Seen> {
        let (x, y, z) = (self.x - o.x, self.y - o.y, self.z - o.z);
        let ahead = x * plane.x + y * plane.y + z * plane.z;
        (ahead.max_element() >= behind).then(|| self.seen(o))
    }

    /// t, and the weights of vertices 1 and 2, of a hit within 0 < t < `ray.tmax`.
    #[inline(always)]
    fn hit(&self, ray: &Ray) -> Option<(f32, f32, f32)> {
        let (seen, d) = (self.seen(ray.origin), ray.direction);
        let [x, y, z] = seen.edges;
        let sides = x * d.x + y * d.y + z * d.z;
        if !(sides.cmpge(Vec3A::ZERO).all() || sides.cmple(Vec3A::ZERO).all()) {
            return None;
        }
        let sum = sides.x + sides.y + sides.z;
        let t = seen.along_normal / seen.normal.dot(d);
        // A ray within the plane divides by zero: t is infinite or NaN, and not in range.
        (t > 0.0 && t < ray.tmax && sum != 0.0).then(|| (t, sides.y / sum, sides.z / sum))
    }
}

/// A triangle as rays from one place see it.
///
/// The side of each edge that a ray passes on is computed from the edge's ends alone, the same for
/// both triangles that share it, up to an exact change of sign: no ray slips through between them.
/// (Plücker coordinates, as in Embree's robust mode.)
pub(super) struct Seen {
    /// Normals of the planes through that place and each edge: x of all three, y, z.
    edges: [Vec3A; 3],
    normal: Vec3A,
    /// How far the triangle's plane is, along `normal`.
    along_normal: f32,
}

impl Seen {
    /// Bits of the directions that pass all edges on the same side, and what tells the sides.
    #[inline(always)]
    pub(super) fn sides<L: Lanes>(&self, l: L, directions: [L::F; 3]) -> (u32, [L::F; 3]) {
        let [x, y, z] = self.edges;
        let a = l.dot(l.splat3([x.x, y.x, z.x]), directions);
        let b = l.dot(l.splat3([x.y, y.y, z.y]), directions);
        let c = l.dot(l.splat3([x.z, y.z, z.z]), directions);
        let zero = l.splat(0.0);
        let left = l.and(l.and(l.ge(a, zero), l.ge(b, zero)), l.ge(c, zero));
        let right = l.and(l.and(l.ge(zero, a), l.ge(zero, b)), l.ge(zero, c));
        (l.bits(l.or(left, right)), [a, b, c])
    }

    /// Bits of the directions that meet the triangle's plane within 0 < t < `t_max`.
    #[inline(always)]
    pub(super) fn in_range<L: Lanes>(&self, l: L, directions: [L::F; 3], t_max: f32) -> u32 {
        let normal = l.splat3(self.normal.to_array());
        let t = l.div(l.splat(self.along_normal), l.dot(normal, directions));
        l.bits(l.and(l.gt(t, l.splat(0.0)), l.gt(l.splat(t_max), t)))
    }
}

/// Triangles under a tree, in one space.
pub(super) struct Body {
    /// In the tree's order.
    corners: Vec<Corners>,
    /// What each was in the order given.
    ids: Vec<u32>,
    tree: Bvh2,
    /// Of all triangles, a little enlarged; not [`Aabb::valid`] where there are none.
    pub(super) bounds: Aabb,
    pub(super) core: Option<Core>,
}

/// A ball that no ray from outside of a larger one gets into without a hit.
#[derive(Clone, Copy)]
pub(super) struct Core {
    pub(super) center: Vec3A,
    pub(super) radius: f32,
    /// Of the larger one, which everything is within.
    pub(super) outer_radius: f32,
}

/// How far boxes are enlarged, so that rounding in the test of a ray against a box never hides
/// what is in it.
fn padding(corners: &[Corners]) -> f32 {
    let bounds = corners
        .iter()
        .fold(Aabb::empty(), |all, c| all.union(&c.bounds()));
    bounds.min.abs().max(bounds.max.abs()).max_element() / (1 << 22) as f32
}

fn padded(bounds: Aabb, by: Vec3A) -> Aabb {
    Aabb::new(bounds.min - by, bounds.max + by)
}

/// Boxes of triangles, enlarged for rounding. Corners that make no triangle become zero.
#[cfg(feature = "gpu")]
pub(super) fn sane_boxes(triangles: &mut [[Vec3; 3]]) -> Vec<Aabb> {
    let corners: Vec<Corners> = triangles.iter().map(|t| Corners::new(*t)).collect();
    for (triangle, sane) in triangles.iter_mut().zip(&corners) {
        *triangle = std::array::from_fn(|i| Vec3::new(sane.x[i], sane.y[i], sane.z[i]));
    }
    let pad = Vec3A::splat(padding(&corners));
    corners.iter().map(|c| padded(c.bounds(), pad)).collect()
}

/// A number that looks random, for 32 bits that don't.
fn scatter(x: u32) -> u32 {
    let x = (x ^ (x >> 16)).wrapping_mul(0x7feb_352d);
    let x = (x ^ (x >> 15)).wrapping_mul(0x846c_a68b);
    x ^ (x >> 16)
}

/// The balls around a place within a closed surface that touch no triangle, and that hold all;
/// nothing where the surface is open, or the place outside.
///
/// Whatever else such a surface does, a ray between the one and outside of the other crosses it.
fn core(corners: &[Corners], center: Vec3A) -> Option<Core> {
    let mut edges: HashMap<[[u32; 3]; 2], u32> = HashMap::new();
    let (mut least, mut farthest) = (f32::INFINITY, 0.0f32);
    for c in corners {
        let at = |i: usize| Vec3A::new(c.x[i], c.y[i], c.z[i]);
        // Plus zero: -0 is the same place.
        let bits = |i: usize| (at(i) + Vec3A::ZERO).to_array().map(f32::to_bits);
        let (mut longest, mut nearest) = (0.0f32, f32::INFINITY);
        for i in 0..3 {
            let j = (i + 1) % 3;
            let mut edge = [bits(i), bits(j)];
            edge.sort_unstable();
            *edges.entry(edge).or_default() += 1;
            longest = longest.max(at(i).distance(at(j)));
            nearest = nearest.min(at(i).distance(center));
            farthest = farthest.max(at(i).distance(center));
        }
        // Its plane is no farther than a triangle; and no place on it is farther from all corners
        // than the middle of an equilateral one.
        let plane = c.normal.dot(at(0) - center).abs() / c.normal.length().max(f32::MIN_POSITIVE);
        least = least.min(plane.max(nearest - longest * 0.578));
    }
    let ways = [
        Vec3A::new(0.31, 0.87, 0.38),
        Vec3A::new(-0.74, 0.11, 0.66),
        Vec3A::new(0.52, -0.43, -0.74),
    ];
    let is_inside = |way: &Vec3A| {
        let crossings = corners.iter().filter(|c| {
            let ray = Ray::new_inf(center, *way);
            c.hit(&ray).is_some()
        });
        crossings.count() % 2 == 1
    };
    // A little smaller, for rounding.
    let radius = least * 0.999;
    let closed = !corners.is_empty() && edges.values().all(|uses| uses % 2 == 0);
    let usable = closed && radius > 0.0 && farthest.is_finite();
    (usable && ways.iter().all(is_inside)).then_some(Core {
        center,
        radius,
        outer_radius: farthest * 1.001,
    })
}

/// Builds a binary tree with one box a leaf. Boxes are enlarged a little, each by another amount:
/// among equal boxes PLOC merges one pair a pass, and takes forever.
pub(super) fn tree(boxes: &mut [Aabb], params: &BvhBuildParams) -> Bvh2 {
    let extent = boxes.iter().fold(0.0f32, |extent, b| {
        extent.max(b.min.abs().max(b.max.abs()).max_element())
    });
    let step = extent / (1 << 24) as f32;
    for (i, b) in boxes.iter_mut().enumerate() {
        let bits = scatter(i as u32);
        let by = Vec3A::new(
            (bits & 31) as f32,
            (bits >> 5 & 31) as f32,
            (bits >> 10 & 31) as f32,
        );
        *b = padded(*b, by * step);
    }
    let indices = (0..boxes.len() as u32).collect();
    let mut tree = PlocBuilder::with_capacity(boxes.len()).build(
        params.ploc_search_distance,
        boxes,
        indices,
        params.sort_precision,
        params.search_depth_threshold,
    );
    if tree.max_depth > MAX_DEPTH {
        return balanced(boxes);
    }
    ReinsertionOptimizer::default().run(&mut tree, params.reinsertion_batch_ratio, None);
    tree
}

/// A tree of the least depth, for boxes so nested that a good one would be too deep to traverse.
fn balanced(boxes: &[Aabb]) -> Bvh2 {
    let mut order: Vec<u32> = (0..boxes.len() as u32).collect();
    let mut nodes = vec![Bvh2Node::default()];
    let mut stack = vec![(0, 0..order.len())];
    while let Some((node, range)) = stack.pop() {
        let part = &mut order[range.clone()];
        let bounds = |i: &u32| boxes[*i as usize];
        let all = part
            .iter()
            .fold(Aabb::empty(), |all, i| all.union(&bounds(i)));
        if range.len() == 1 {
            nodes[node] = Bvh2Node::new(all, 1, range.start as u32);
            continue;
        }
        let axis = all.largest_axis();
        part.sort_by(|a, b| bounds(a).center()[axis].total_cmp(&bounds(b).center()[axis]));
        let middle = range.start + range.len() / 2;
        let first = nodes.len();
        nodes.extend([Bvh2Node::default(); 2]);
        nodes[node] = Bvh2Node::new(all, 0, first as u32);
        stack.push((first, range.start..middle));
        stack.push((first + 1, middle..range.end));
    }
    Bvh2 {
        nodes,
        primitive_indices: order,
        ..Bvh2::default()
    }
}

/// Bounds of a box placed by a matrix.
pub(super) fn placed(bounds: &Aabb, by: &Affine3A) -> Aabb {
    let centre = by.transform_point3a(bounds.center());
    let half = bounds.diagonal() * 0.5;
    let m = by.matrix3;
    let half = m.x_axis.abs() * half.x + m.y_axis.abs() * half.y + m.z_axis.abs() * half.z;
    let rounding = Vec3A::splat((centre.abs() + half).max_element() / (1 << 20) as f32);
    padded(Aabb::new(centre - half, centre + half), rounding)
}

/// Calls `visit` with each slot of [`Bvh2::primitive_indices`] whose box is along the ray, which
/// it may shorten; until it returns false.
#[inline(always)]
pub(super) fn along(tree: &Bvh2, ray: Ray, mut visit: impl FnMut(&mut Ray, usize) -> bool) {
    let leaf = |node: &Bvh2Node, ray: &mut Ray, _: &mut RayHit| {
        let first = node.first_index as usize;
        (first..first + node.prim_count as usize).all(|slot| visit(ray, slot))
    };
    obvhs::fast_stack!(u32, (96, 192), tree.max_depth, stack, {
        tree.ray_traverse_dynamic(&mut stack, ray, &mut RayHit::none(), leaf)
    });
}

impl Body {
    pub(super) fn new(corners: &[Corners]) -> Body {
        let mut boxes: Vec<Aabb> = corners.iter().map(Corners::bounds).collect();
        let mut tree = tree(&mut boxes, &STATIC);
        collapse(
            &mut tree,
            STATIC.max_prims_per_leaf,
            STATIC.collapse_traversal_cost,
        );
        tree.reorder_in_stack_traversal_order();
        tree.max_depth = if tree.nodes.is_empty() {
            0
        } else {
            tree.depth(0) + 1
        };
        let ids = std::mem::take(&mut tree.primitive_indices);
        let mut body = Body {
            corners: Vec::new(),
            ids,
            tree,
            bounds: Aabb::empty(),
            core: None,
        };
        body.refit(corners);
        body
    }

    /// Looks for a core. Only bodies that are not refitted keep it.
    pub(super) fn with_core(mut self) -> Body {
        self.core = core(&self.corners, self.bounds.center());
        self
    }

    /// Moves the triangles, given in their original order.
    pub(super) fn refit(&mut self, corners: &[Corners]) {
        self.core = None;
        let tree = &mut self.tree;
        let pad = Vec3A::splat(padding(corners));
        self.corners.clear();
        self.corners
            .extend(self.ids.iter().map(|id| corners[*id as usize]));
        for node in tree.nodes.iter_mut().filter(|node| node.is_leaf()) {
            let first = node.first_index as usize;
            let held = &self.corners[first..first + node.prim_count as usize];
            let bounds = held
                .iter()
                .fold(Aabb::empty(), |all, c| all.union(&c.bounds()));
            node.set_aabb(padded(bounds, pad));
        }
        tree.refit_all();
        self.bounds = tree
            .nodes
            .first()
            .map_or(Aabb::empty(), |root| *root.aabb());
    }

    /// Anything that `solid` (given the id and the weights of vertices 1 and 2) does not let
    /// through is in the ray's way.
    #[inline]
    pub(super) fn any(&self, ray: Ray, solid: impl Fn(u32, f32, f32) -> bool) -> bool {
        let mut found = false;
        along(&self.tree, ray, |ray, slot| {
            let hit = self.corners[slot].hit(ray);
            found = hit.is_some_and(|(_, u, v)| solid(self.ids[slot], u, v));
            !found
        });
        found
    }

    /// The same for many rays from one origin, together.
    #[inline(always)]
    pub(super) fn any_of<L: Lanes>(
        &self,
        rays: &mut Rays<'_, L>,
        solid: impl Fn(u32, f32, f32) -> bool,
    ) {
        let nodes = &self.tree.nodes;
        let Some(root) = nodes.first() else { return };
        if rays.done() || rays.distance(root.aabb()) == f32::INFINITY {
            return;
        }
        if let Some(core) = &self.core {
            rays.enter(core);
        }
        obvhs::fast_stack!(u32, (96, 192), self.tree.max_depth, stack, {
            let mut node = root;
            loop {
                if node.is_leaf() {
                    let first = node.first_index as usize;
                    let slots = first..first + node.prim_count as usize;
                    let triangles = slots.map(|slot| (&self.corners[slot], self.ids[slot]));
                    rays.leaf(node.aabb(), triangles, &solid);
                    if rays.done() {
                        return;
                    }
                } else {
                    // The nearer one first: what it hides need not be tested again.
                    let first = node.first_index;
                    let (left, right) = (&nodes[first as usize], &nodes[first as usize + 1]);
                    let to_left = rays.distance(left.aabb());
                    let to_right = rays.distance(right.aabb());
                    let near = u32::from(to_right < to_left);
                    if to_left.max(to_right) < f32::INFINITY {
                        stack.push(first + 1 - near);
                    }
                    if to_left.min(to_right) < f32::INFINITY {
                        node = &nodes[(first + near) as usize];
                        continue;
                    }
                }
                match stack.pop() {
                    Some(next) => node = &nodes[next as usize],
                    None => return,
                }
            }
        });
    }

    /// Id, t, and weights of vertices 1 and 2, of the nearest hit that is `solid`.
    pub(super) fn nearest(
        &self,
        ray: Ray,
        solid: impl Fn(u32, f32, f32) -> bool,
    ) -> Option<(u32, f32, f32, f32)> {
        let mut nearest = None;
        along(&self.tree, ray, |ray, slot| {
            let id = self.ids[slot];
            if let Some((t, u, v)) = self.corners[slot].hit(ray)
                && solid(id, u, v)
            {
                ray.tmax = t;
                nearest = Some((id, t, u, v));
            }
            true
        });
        nearest
    }
}
