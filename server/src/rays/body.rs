//! Triangles under a tree, in one space.

use glam::{Affine3A, UVec2, Vec3, Vec3A, Vec3Swizzles};
use obvhs::{
    BvhBuildParams,
    aabb::Aabb,
    bvh2::{Bvh2, leaf_collapser::collapse, node::Bvh2Node, reinsertion::ReinsertionOptimizer},
    cwbvh::{CwBvh, bvh2_to_cwbvh::bvh2_to_cwbvh},
    ploc::PlocBuilder,
    ray::{Ray, RayHit},
    traverse,
};

/// For trees that are built once and traced often. On Sponza, dearer builds than this trace no
/// faster.
const STATIC: BvhBuildParams = BvhBuildParams::fast_build();
/// For the tree over movers, built every frame.
pub(super) const TOP: BvhBuildParams = BvhBuildParams::fastest_build();

/// Levels of a wide tree that the traversal's stack of 32 can hold.
const MAX_WIDE_DEPTH: usize = 30;
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

    /// t, and the weights of vertices 1 and 2, of a hit within 0 < t < `ray.tmax`.
    ///
    /// The side of each edge that the ray passes on is computed from the edge's ends alone, the
    /// same for both triangles that share it, up to an exact change of sign: no ray slips through
    /// between them. (Plücker coordinates, as in Embree's robust mode.)
    #[inline(always)]
    fn hit(&self, ray: &Ray) -> Option<(f32, f32, f32)> {
        let (o, d) = (ray.origin, ray.direction);
        let (x, y, z) = (self.x - o.x, self.y - o.y, self.z - o.z);
        let ex = x.zxy() - x.yzx();
        let ey = y.zxy() - y.yzx();
        let ez = z.zxy() - z.yzx();
        let sx = x.zxy() + x.yzx();
        let sy = y.zxy() + y.yzx();
        let sz = z.zxy() + z.yzx();
        let sides =
            (ey * sz - ez * sy) * d.x + (ez * sx - ex * sz) * d.y + (ex * sy - ey * sx) * d.z;
        if !(sides.cmpge(Vec3A::ZERO).all() || sides.cmple(Vec3A::ZERO).all()) {
            return None;
        }
        let sum = sides.x + sides.y + sides.z;
        let t = self.normal.dot(Vec3A::new(x.x, y.x, z.x)) / self.normal.dot(d);
        // A ray within the plane divides by zero: t is infinite or NaN, and not in range.
        (t > 0.0 && t < ray.tmax && sum != 0.0).then(|| (t, sides.y / sum, sides.z / sum))
    }
}

enum Tree {
    Wide(CwBvh),
    Narrow(Bvh2),
}

/// Triangles under a tree, in one space.
pub(super) struct Body {
    /// In the tree's order.
    corners: Vec<Corners>,
    /// What each was in the order given.
    ids: Vec<u32>,
    tree: Tree,
    /// Of all triangles, a little enlarged; not [`Aabb::valid`] where there are none.
    pub(super) bounds: Aabb,
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

/// A number that looks random, for 32 bits that don't.
fn scatter(x: u32) -> u32 {
    let x = (x ^ (x >> 16)).wrapping_mul(0x7feb_352d);
    let x = (x ^ (x >> 15)).wrapping_mul(0x846c_a68b);
    x ^ (x >> 16)
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

fn wide_depth(tree: &CwBvh) -> usize {
    let mut deepest = 0;
    let mut stack = vec![(0, 1)];
    while let Some((node, depth)) = stack.pop() {
        deepest = deepest.max(depth);
        let Some(node) = tree.nodes.get(node as usize) else {
            continue;
        };
        let inner = (0..8).filter(|child| node.imask >> child & 1 == 1);
        stack.extend(inner.map(|child| (node.child_node_index(child), depth + 1)));
    }
    deepest
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
    /// The fastest to trace.
    pub(super) fn rigid(corners: &[Corners]) -> Body {
        let pad = Vec3A::splat(padding(corners));
        let mut boxes: Vec<Aabb> = corners.iter().map(|c| padded(c.bounds(), pad)).collect();
        let wide = |tree: &Bvh2| bvh2_to_cwbvh(tree, STATIC.max_prims_per_leaf.min(3), true, false);
        let mut tree = wide(&tree(&mut boxes, &STATIC));
        if wide_depth(&tree) > MAX_WIDE_DEPTH {
            tree = wide(&balanced(&boxes));
        }
        let ids = std::mem::take(&mut tree.primitive_indices);
        Body {
            corners: ids.iter().map(|id| corners[*id as usize]).collect(),
            ids,
            bounds: if corners.is_empty() {
                Aabb::empty()
            } else {
                tree.total_aabb
            },
            tree: Tree::Wide(tree),
        }
    }

    /// Can be refitted.
    pub(super) fn deforming(corners: &[Corners]) -> Body {
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
            tree: Tree::Narrow(tree),
            bounds: Aabb::empty(),
        };
        body.refit(corners);
        body
    }

    /// Moves the triangles, given in their original order, of a deforming body.
    pub(super) fn refit(&mut self, corners: &[Corners]) {
        let Tree::Narrow(tree) = &mut self.tree else {
            return;
        };
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

    #[inline(always)]
    fn along(&self, mut ray: Ray, mut visit: impl FnMut(&mut Ray, usize) -> bool) {
        match &self.tree {
            Tree::Narrow(tree) => along(tree, ray, visit),
            Tree::Wide(tree) => {
                let mut state = tree.new_traversal(ray.direction);
                let mut node;
                'done: {
                    traverse!(
                        tree,
                        node,
                        state,
                        node.intersect_ray(&ray, state.oct_inv4),
                        {
                            if !visit(&mut ray, state.primitive_id as usize) {
                                break 'done;
                            }
                        }
                    );
                }
            }
        }
    }

    /// Anything that `solid` (given the id and the weights of vertices 1 and 2) does not let
    /// through is in the ray's way.
    #[inline]
    pub(super) fn any(&self, ray: Ray, solid: impl Fn(u32, f32, f32) -> bool) -> bool {
        let mut found = false;
        self.along(ray, |ray, slot| {
            let hit = self.corners[slot].hit(ray);
            found = hit.is_some_and(|(_, u, v)| solid(self.ids[slot], u, v));
            !found
        });
        found
    }

    /// Id, t, and weights of vertices 1 and 2, of the nearest hit that is `solid`.
    pub(super) fn nearest(
        &self,
        ray: Ray,
        solid: impl Fn(u32, f32, f32) -> bool,
    ) -> Option<(u32, f32, f32, f32)> {
        let mut nearest = None;
        self.along(ray, |ray, slot| {
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
