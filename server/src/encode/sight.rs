//! Which slices a client has had in sight: what is behind walls waits.

use super::{Eye, View};
use crate::render::{Fragment, first_visible};
use crate::world::{Slice, World};
use rayon::prelude::*;
use std::ops::RangeBounds;

/// Points of a slice that are looked for from the camera, each time that it is its turn; and after
/// how many without one in sight it is no longer new. What is behind walls so waits, and what is
/// about to come out is found before it shows.
const LOOKS: usize = 16;
const NEW_LOOKS: u8 = 64;

/// Rays that a frame spends so on slices that came into view a short while ago, and on the others:
/// however many there are, all have their turn. (A slice is the smaller the denser points are: as
/// many rays then find as much.) What has come with this very frame is looked for at once, all of
/// it, so that a new view is whole in its first frame.
const NEW_RAYS: usize = 3072;
const RAYS: usize = 768;

/// As many, where nobody knows which slices face away (profile `cells`), with the looks at those:
/// they cast no ray.
fn with_away(world: &World, rays: usize) -> usize {
    if world.options.rest_space {
        rays
    } else {
        rays + rays / 3
    }
}

/// Rays through the picture that a frame casts, across and down, as long as slices in view have
/// not been in sight: what shows between two columns is found the sooner the more of the
/// picture it fills.
const PICTURE_LOOKS: [u32; 2] = [24, 14];

/// So many times as many, across and down, where more has come with the frame than
/// [`NEW_RAYS`] look for.
const NEW_PICTURE: u32 = 6;

/// What has been in a client's view so far.
///
/// A slice is in view while it is in the frustum, its instance in the scene, and not all of its
/// points face away from the eye and from wherever it may be soon.
pub struct Sight {
    frames: u64,
    /// The frame in which each slice was last in view.
    seen: Vec<u64>,
    /// Slices of which something was in sight, not only in view.
    sighted: Vec<bool>,
    /// Points of each slice that were looked for since it came into view.
    looked: Vec<u8>,
    /// Slices in view that had not been in sight when the last frame began.
    hidden: Vec<u32>,
    /// Slices in view that have been in sight, in order.
    needed: Vec<u32>,
}

impl Sight {
    pub fn new(slices: usize) -> Sight {
        Sight {
            // So that no slice was seen in the frame before the first.
            frames: 1,
            seen: vec![0; slices],
            sighted: vec![false; slices],
            looked: vec![0; slices],
            hidden: Vec::new(),
            needed: Vec::new(),
        }
    }

    /// Another frame.
    pub fn look(&mut self, world: &World, view: &View<'_>) {
        self.frames += 1;
        let frames = self.frames;
        let eyes = view.eye.map(|eye| world.local_eyes(eye.camera.position));
        let may_face = |slice: &Slice| {
            let eyes = eyes.as_ref();
            eyes.is_none_or(|eyes| world.may_be_seen(slice, eyes))
        };
        let marks = self.seen.par_iter_mut().zip(&mut self.looked);
        let slices = world.slices.par_iter().zip(marks);
        slices.for_each(|(slice, (seen, looked))| {
            let present = world.is_present(slice.instance);
            if present && (view.sees)(slice.bounds) && may_face(slice) {
                if *seen + 1 < frames {
                    *looked = 0;
                }
                *seen = frames;
            }
        });
        self.hidden.clear();
        for (index, (seen, sighted)) in self.seen.iter().zip(&self.sighted).enumerate() {
            if *seen == frames && !sighted {
                self.hidden.push(index as u32);
            }
        }
        if let (Some(eye), false) = (&view.eye, self.hidden.is_empty()) {
            self.look_through_picture(world, eye);
        }
        self.find(world, view);
        let seen = self.seen.iter().zip(&self.sighted).zip(0..);
        let needed = seen.filter(|((seen, sighted), _)| **seen == frames && **sighted);
        self.needed.clear();
        self.needed.extend(needed.map(|(_, index)| index));
    }

    /// Looks for slices in view that have not been in sight.
    fn find(&mut self, world: &World, view: &View<'_>) {
        let Some(eye) = view.eye else {
            for slice in self.hidden.drain(..) {
                self.sighted[slice as usize] = true;
            }
            return;
        };
        let (new, others) = (
            self.hidden_after(1..NEW_LOOKS),
            self.hidden_after(NEW_LOOKS..),
        );
        // One in so many has its turn.
        let new_turn = (new * LOOKS).div_ceil(with_away(world, NEW_RAYS)) as u64;
        let turn = (others * LOOKS).div_ceil(with_away(world, RAYS)) as u64;
        let frames = self.frames;
        let looked_for = |slice: u32| {
            let turn = match self.looked[slice as usize] {
                0 => 1,
                1..NEW_LOOKS => new_turn,
                _ => turn,
            };
            (frames + u64::from(slice)).is_multiple_of(turn)
        };
        let found = |&slice: &u32| {
            let seed = (frames as u32).wrapping_mul(0x9e37_79b9) ^ slice;
            let (slice, from) = (&world.slices[slice as usize], eye.camera.position);
            world.is_seen(slice, from, LOOKS as u32, seed)
        };
        let turns = self.hidden.iter().copied();
        let turns: Vec<u32> = turns.filter(|slice| looked_for(*slice)).collect();
        let turns = turns.par_iter();
        let found: Vec<(u32, bool)> = turns.map(|slice| (*slice, found(slice))).collect();
        for (slice, found) in found {
            let looked = &mut self.looked[slice as usize];
            *looked = looked.saturating_add(LOOKS as u8);
            self.sighted[slice as usize] |= found;
        }
    }

    /// How many slices in view have not been in sight after so many looks.
    fn hidden_after(&self, looks: impl RangeBounds<u8>) -> usize {
        let looked = self.hidden.iter().map(|slice| self.looked[*slice as usize]);
        looked.filter(|looked| looks.contains(looked)).count()
    }

    /// Marks slices that the picture shows.
    fn look_through_picture(&mut self, world: &World, eye: &Eye) {
        let much = self.hidden_after(..1) * LOOKS > with_away(world, NEW_RAYS);
        let finer = if much { NEW_PICTURE } else { 1 };
        let [width, height] = PICTURE_LOOKS.map(|looks| looks * finer);
        let frame = self.frames as u32;
        let shown: Vec<u32> = (0..width * height)
            .into_par_iter()
            .flat_map_iter(|look| {
                // Somewhere in its part of the picture, evenly over the frames.
                let own = look.wrapping_mul(0x9e37_79b9);
                let place = |own: u32, step: u32| {
                    own.wrapping_add(frame.wrapping_mul(step)) as f32 * 0.5f32.powi(32)
                };
                let x = (look % width) as f32 + place(own, 3_242_174_889);
                let y = (look / width) as f32 + place(own << 16, 2_447_445_414);
                let (origin, direction) = eye.camera.ray_at(x, y, width, height);
                let usable = direction.is_finite() && origin.is_finite();
                let hit = usable.then(|| first_visible(world, origin, direction));
                let slices = |hit: Fragment| world.slices_near(hit.instance, hit.position);
                hit.flatten().map(slices).into_iter().flatten()
            })
            .collect();
        for slice in shown {
            self.sighted[slice as usize] = true;
        }
        let sighted = &self.sighted;
        self.hidden.retain(|slice| !sighted[*slice as usize]);
    }

    /// Frames so far, and 1.
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// The frame in which a slice was last in view.
    pub fn last_seen(&self, slice: u32) -> u64 {
        self.seen[slice as usize]
    }

    /// The slices in view that have been in sight, in order.
    pub fn needed(&self) -> &[u32] {
        &self.needed
    }
}
