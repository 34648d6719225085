//! Which points are traced now that something moved near them, where there are fewer rays than all
//! of them need.

use super::between::THIN;
use super::{Hull, Slice, World, stretch};
use crate::facing::Faces;
use crate::topology::SLICE_BLOCKS;
use psao_core::residual::BLOCK;
use rayon::prelude::*;

/// An eye within this of a slice sees no more of it, metres.
const NEAREST_M: f32 = 0.5;

/// What choosing and culling the points of a block costs, in rays.
const BLOCK_RAYS: f32 = 16.0;

/// How much a step counts, less than the one after it, for what the next one is foretold to take;
/// and rays that are taken to have been as foretold before the first.
const FORGET: f32 = 0.75;
const FORETOLD_RIGHT: f32 = 4096.0;

/// How fast what points say is taken to change, in 1/255 a step: at the least, as what moves may
/// come nearer; and as long as nobody has looked, or what moves has only now come within reach.
const LEAST_RATE: f32 = 0.3;
const NEW_RATE: f32 = 4.0;

/// How far off a point is that changes as those around it do, as a part of that change.
const LEFT_BETWEEN: f32 = 0.3;

/// What a mover does to points changes over such a part of how far it is away, and this much more,
/// metres, as nothing has edges without end.
const CHANGES_OVER: f32 = 0.5;
const EDGE_M: f32 = 0.08;

/// More than this says no more about what is urgent, 1/255.
const MOST_LAG: f32 = 64.0;

/// Which blocks of a slice are due; the first in the lowest bit.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Turn {
    /// Blocks that may say what was true before something moved.
    pub(super) owed: u64,
    /// Those that movers reach, and those that they reached when they were traced last.
    pub(super) near: u64,
    pub(super) had: u64,
    /// Those of which only points of [`World::finest_levels`] were traced since something moved.
    pub(super) missed: u64,
    /// The step at which the slice was visible last; it was not at the one before.
    pub(super) seen_at: u64,
    /// The step for which something last moved near it.
    pub(super) moved_at: u64,
    pub(super) is_new: bool,
}

/// How urgent some points of a slice are.
#[derive(Clone, Copy, Debug)]
pub(super) struct Block {
    /// The step at which they were traced last.
    pub(super) traced_at: u64,
    /// How fast what they say changed before that, 1/255 a step, root mean square.
    pub(super) rate: f32,
    /// How far off those may be since that were not traced, 1/255.
    off: f32,
    /// Turns that they had: others are traced each time.
    pub(super) number: u8,
}

impl Default for Block {
    /// Nothing is known.
    fn default() -> Block {
        Block {
            traced_at: 0,
            rate: NEW_RATE,
            off: 0.0,
            number: 0,
        }
    }
}

impl Block {
    pub(super) fn age(&self, steps: u64) -> f32 {
        (steps - self.traced_at) as f32
    }

    /// They had their turn, one in [`THIN`] of them or all, which changed what they say by so much.
    pub(super) fn note_turn(&mut self, thin: bool, change: f32) {
        let left = LEFT_BETWEEN * change;
        let kept = self.off * (1.0 - 1.0 / THIN as f32);
        self.off = if thin { left.hypot(kept) } else { 0.0 };
        self.number = self.number.wrapping_add(1);
    }
}

/// What was traced of an instance's blocks of late, to tell what they are going to take.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Cost {
    /// Rays that [`Towards::shares`] foretold, and those that were traced.
    foretold: f32,
    pub(super) traced: f32,
}

impl Cost {
    /// What a ray foretold comes to.
    fn factor(&self) -> f32 {
        (self.traced + FORETOLD_RIGHT) / (self.foretold + FORETOLD_RIGHT)
    }
}

/// What moves, as the blocks of a slice see it.
struct Towards {
    /// Which part of a point's rays may meet it, about: 0 only where none may.
    shares: [f32; SLICE_BLOCKS],
    /// How far it is away at least, metres.
    far_m: [f32; SLICE_BLOCKS],
}

/// What a visible slice owes: see [`Turn`].
struct Owing {
    near: u64,
    towards: Towards,
    owed: u64,
    /// Blocks owed that may show.
    wanted: u64,
    /// What an error shows, relative to others'.
    weight: f32,
}

/// A block that may have its turn.
struct Candidate {
    /// What it is worth.
    gain: f32,
    /// What it is foretold to take, before and after what was learnt.
    foretold: f32,
    rays: f32,
    /// One point in [`THIN`] is enough for now.
    thin: bool,
    /// Into [`World::blocks`].
    block: usize,
}

/// Blocks of a slice that are to be traced.
pub(super) struct Due {
    pub(super) slice: usize,
    /// As many of the rays are to be known.
    pub(super) rays: usize,
    pub(super) blocks: u64,
    /// Those of them of which one point in [`THIN`] is traced.
    pub(super) thin: u64,
}

impl World {
    /// Which blocks of the slices `asked` are traced now: all where rays are gained, and within a
    /// budget of rays those of the others that something moved near. And how many of these wait.
    pub(super) fn take_turns(
        &mut self,
        asked: &[(usize, usize)],
        refresh_rays: u64,
    ) -> (Vec<Due>, u64) {
        let looked: Vec<Owing> = asked
            .par_iter()
            .map(|&(slice, _)| self.owing(slice))
            .collect();
        let mut due = Vec::new();
        let mut candidates = Vec::new();
        for cost in &mut self.costs {
            cost.foretold *= FORGET;
            cost.traced *= FORGET;
        }
        // Between the points that are traced where one in so many is.
        let gap_m = (THIN as f64 / self.options.density).sqrt() as f32;
        for (owing, &(index, rays)) in looked.iter().zip(asked) {
            let slice = &mut self.slices[index];
            let turn = &mut self.turns[index];
            if std::mem::take(&mut slice.stale) {
                turn.moved_at = self.steps;
            }
            let all = if turn.is_new { u64::MAX } else { 0 };
            let unknown = all | owing.near & !turn.near;
            (turn.near, turn.owed) = (owing.near, owing.owed);
            if rays > slice.rays_done {
                due.push(Due {
                    slice: index,
                    rays,
                    blocks: Faces::all_of(slice).any,
                    thin: 0,
                });
            } else if rays > 0 {
                let blocks = (0..SLICE_BLOCKS).filter(|block| owing.wanted >> block & 1 == 1);
                for number in blocks {
                    let at = index * SLICE_BLOCKS + number;
                    let block = &mut self.blocks[at];
                    if unknown >> number & 1 == 1 {
                        block.rate = block.rate.max(NEW_RATE);
                    }
                    let age = block.age(self.steps);
                    let foretold = owing.towards.shares[number] * (rays * BLOCK) as f32;
                    let rays = foretold * self.costs[slice.instance as usize].factor();
                    // If the rate were known, the mean squared error would be least, for so many
                    // rays, where each block is traced when weight · rate² · age³ / rays has grown
                    // to the same value. It is a guess, so that what is dear waits less long than
                    // that; and many rays of one point cost little more time than few.
                    let lag = ((block.rate + LEAST_RATE) * age)
                        .hypot(block.off)
                        .min(MOST_LAG);
                    // When nothing moves any more, all of them are to have their turn.
                    let thin = block.traced_at < turn.moved_at
                        && foretold > 0.0
                        && gap_m < CHANGES_OVER * (owing.towards.far_m[number].max(0.0) + EDGE_M);
                    let (foretold, rays) = match thin {
                        true => (foretold / THIN as f32, rays / THIN as f32),
                        false => (foretold, rays),
                    };
                    candidates.push(Candidate {
                        gain: lag * lag * age * owing.weight / (rays + BLOCK_RAYS).sqrt(),
                        foretold,
                        rays,
                        thin,
                        block: at,
                    });
                }
            }
        }
        candidates.sort_unstable_by(|a, b| {
            let order = b.gain.total_cmp(&a.gain);
            order.then(a.block.cmp(&b.block))
        });
        let mut left = refresh_rays as f32;
        let fits = |candidate: &&Candidate| {
            let fits = left > 0.0;
            left -= candidate.rays + BLOCK_RAYS;
            fits
        };
        let taken = candidates.iter().take_while(fits).count();
        let mut waiting = (candidates.len() - taken) as u64;
        candidates.truncate(taken);
        // What is left is for the rest of their points.
        for candidate in candidates.iter_mut().filter(|candidate| candidate.thin) {
            if left <= 0.0 {
                waiting += 1;
                continue;
            }
            left -= candidate.rays * (THIN - 1) as f32;
            candidate.foretold *= THIN as f32;
            candidate.thin = false;
        }
        candidates.sort_unstable_by_key(|candidate| candidate.block);
        for turn in candidates.chunk_by(|a, b| a.block / SLICE_BLOCKS == b.block / SLICE_BLOCKS) {
            let index = turn[0].block / SLICE_BLOCKS;
            let bit = |own: &Candidate| 1u64 << (own.block % SLICE_BLOCKS);
            let thin = turn.iter().filter(|own| own.thin);
            let cost = &mut self.costs[self.slices[index].instance as usize];
            cost.foretold += turn.iter().map(|own| own.foretold).sum::<f32>();
            due.push(Due {
                slice: index,
                rays: self.slices[index].rays_done,
                blocks: turn.iter().fold(0, |blocks, own| blocks | bit(own)),
                thin: thin.fold(0, |blocks, own| blocks | bit(own)),
            });
        }
        due.retain(|due| due.blocks > 0);
        due.sort_unstable_by_key(|due| due.slice);
        (due, waiting)
    }

    /// What a visible slice owes in the present pose.
    fn owing(&self, index: usize) -> Owing {
        let (slice, turn) = (&self.slices[index], &self.turns[index]);
        let owed = if slice.stale { u64::MAX } else { turn.owed };
        let towards = self.towards_movers(slice);
        let near = towards.shares.iter().rev();
        let near = near.fold(0, |blocks, share| blocks << 1 | u64::from(*share > 0.0));
        // What no mover reaches, and none did, says what it said.
        let owed = owed & (near | turn.had) & Faces::all_of(slice).any;
        let mut owing = Owing {
            near,
            towards,
            owed,
            wanted: owed,
            weight: 1.0,
        };
        if !self.eyes.is_empty() && owed > 0 {
            let [min, max] = slice.bounds;
            let eyes = self.eyes.iter();
            let far = eyes.map(|eye| eye.distance(eye.clamp(min, max)));
            let nearest = far.fold(f32::INFINITY, f32::min).max(NEAREST_M);
            // Less than its part of the picture, which is as the square of this: near slices are
            // seen at a slant, and none far away is to wait for ever.
            owing.weight = 1.0 / nearest;
            let eyes = self.eyes.iter();
            owing.wanted &= eyes.fold(0, |faces, eye| faces | self.facing(slice, *eye).any);
        }
        owing
    }

    /// What the blocks of a slice have to do with what moves. On what moves itself, all.
    fn towards_movers(&self, slice: &Slice) -> Towards {
        let instance = slice.instance as usize;
        let Some(cones) = self.cones_at(slice).filter(|_| !self.moves[instance]) else {
            return Towards {
                shares: [1.0; SLICE_BLOCKS],
                far_m: [0.0; SLICE_BLOCKS],
            };
        };
        let mut towards = Towards {
            shares: [0.0; SLICE_BLOCKS],
            far_m: [f32::INFINITY; SLICE_BLOCKS],
        };
        let reach = self.options.ao_distance_m;
        let movers = (0..self.moves.len()).filter(|&mover| self.moves[mover]);
        let movers = movers.map(|mover| &self.swept[mover][0]);
        let movers: Vec<&Hull> = movers
            .filter(|mover| mover.is_near(slice.bounds, reach))
            .collect();
        if movers.is_empty() {
            return towards;
        }
        let pose = &self.pose.instances[instance];
        let stretch = stretch(&pose.world_from_local);
        let blocks = towards.shares.iter_mut().zip(&mut towards.far_m);
        for ((share, far_m), cone) in blocks.zip(cones) {
            let (center, radius) = cone.ball();
            let center = pose.world_from_local.transform_point3(center);
            // A little more, for rounding.
            let around = radius * stretch * 1.001 + center.abs().max_element() * 1e-5;
            let bounds = [center - around, center + around];
            let normal = pose.world_normal(cone.axis());
            for mover in movers.iter().filter(|mover| mover.is_near(bounds, reach)) {
                *share = (*share + mover.share(center, normal)).min(1.0);
                *far_m = far_m.min(mover.distance(center) - around);
            }
        }
        towards
    }
}
