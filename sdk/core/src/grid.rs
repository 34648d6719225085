//! The virtual grid of an instance, and where its cells hash to.

use crate::topology::LEVELS;
use bytemuck::{Pod, Zeroable};

/// Most cells along an axis of a grid: a local coordinate in `f32` still tells 1/16 of a cell.
pub const MAX_DIM: u32 = 1 << 20;

/// An instance's grid and hash table, as the shaders read it: 64 bytes, four `vec4`.
///
/// The grid lives in the instance's local space: its *cell units* are
/// `g = (position − origin) · cells_per_unit`. `cells_per_unit` has a factor an axis, so that under
/// a non-uniform scale the cells are cubes in metres and not in local units.
///
/// An instance without points has `bucket_count` 0; all other fields are then ignored.
#[repr(C, align(16))]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct Instance {
    /// The grid's corner, in local units.
    pub origin: [f32; 3],
    /// Interpolation radius r, in cells.
    pub radius: f32,
    /// Local units to cells.
    pub cells_per_unit: [f32; 3],
    /// First bucket of this instance in the bucket buffer.
    pub bucket_first: u32,
    /// Cells along each axis, Dx, Dy, Dz.
    pub dims: [u32; 3],
    /// Buckets of this instance.
    pub bucket_count: u32,
    /// Factors that take a local normal to cell units (before normalising): 1 / `cells_per_unit`,
    /// scaled so that the largest is 1.
    pub normal_scale: [f32; 3],
    /// Profile `residual`: which of its mesh's points the instance has, 0 (all) to
    /// [`crate::topology::LEVELS`] − 1; each level up has half as many. In profile `cells` 0.
    pub level: u32,
}

/// Why an [`Instance`] cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GridError {
    /// A field is not finite, or a radius or scale not above zero.
    NotFinite,
    /// A dimension is 0 or above [`MAX_DIM`].
    Dims,
    /// There is no such level.
    Level,
    /// Its buckets lie outside the bucket buffer.
    OutOfRange,
}

impl Instance {
    /// Checks everything that reading with this instance relies on. `buckets`: the bucket
    /// buffer's length.
    pub fn validate(&self, buckets: u32) -> Result<(), GridError> {
        if self.bucket_count == 0 {
            return Ok(());
        }
        let positive = |v: f32| v > 0.0 && v < f32::INFINITY;
        if !self.origin.iter().all(|v| v.is_finite())
            || !self
                .cells_per_unit
                .iter()
                .chain(&self.normal_scale)
                .all(|&v| positive(v))
            || !positive(self.radius)
        {
            return Err(GridError::NotFinite);
        }
        if self.dims.iter().any(|&dim| dim == 0 || dim > MAX_DIM) {
            return Err(GridError::Dims);
        }
        if self.level >= LEVELS {
            return Err(GridError::Level);
        }
        match self.bucket_first.checked_add(self.bucket_count) {
            Some(end) if end <= buckets => Ok(()),
            _ => Err(GridError::OutOfRange),
        }
    }

    /// A local position in cells from the grid's corner.
    pub fn to_cells(&self, position: [f32; 3]) -> [f32; 3] {
        core::array::from_fn(|axis| {
            (position[axis] - self.origin[axis]) * self.cells_per_unit[axis]
        })
    }

    /// The dense index of a cell, x + y·Dx + z·Dx·Dy: what [`crate::Cell::key`] holds. In a grid
    /// of more than 2³² cells it wraps; cells that share a bucket are far too few to meet again.
    pub fn key(&self, cell: [u32; 3]) -> u32 {
        self.weigh(cell, 1, 1)
    }

    /// The bucket, in the bucket buffer, of a cell.
    ///
    /// Eq. 1: H(p) = px + py·Dx·17 + pz·Dx·Dy·31 in wrapping 32-bit arithmetic, modulo the
    /// instance's buckets.
    pub fn bucket(&self, cell: [u32; 3]) -> u32 {
        let hash = self.weigh(cell, 17, 31);
        self.bucket_first
            .wrapping_add(hash % self.bucket_count.max(1))
    }

    /// The buckets, in the bucket buffer, of a cell and of the next along x, whose hash is one
    /// more: one division for both. x may be −1, as the largest number.
    #[inline(always)]
    pub fn bucket_pair(&self, cell: [u32; 3]) -> [u32; 2] {
        let hash = self.weigh(cell, 17, 31);
        let count = self.bucket_count.max(1);
        let lower = hash % count;
        let wraps = hash == u32::MAX || lower + 1 == count;
        let upper = if wraps { 0 } else { lower + 1 };
        [
            self.bucket_first.wrapping_add(lower),
            self.bucket_first.wrapping_add(upper),
        ]
    }

    fn weigh(&self, [x, y, z]: [u32; 3], weight_y: u32, weight_z: u32) -> u32 {
        let row = self.dims[0];
        let layer = row.wrapping_mul(self.dims[1]);
        x.wrapping_add(y.wrapping_mul(row).wrapping_mul(weight_y))
            .wrapping_add(z.wrapping_mul(layer).wrapping_mul(weight_z))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn instance(dims: [u32; 3], bucket_count: u32) -> Instance {
        Instance {
            radius: 0.8,
            cells_per_unit: [20.0; 3],
            dims,
            bucket_count,
            normal_scale: [1.0; 3],
            ..Instance::default()
        }
    }

    #[test]
    fn the_bucket_is_equation_1() {
        for (dims, buckets) in [([7, 5, 3], 11), ([700, 300, 400], 90_001), ([1, 1, 1], 1)] {
            let grid = instance(dims, buckets);
            grid.validate(buckets).unwrap();
            let [dx, dy, dz] = dims.map(u128::from);
            for [px, py, pz] in [[0, 0, 0], [dx - 1, dy - 1, dz - 1], [0, 0, dz / 2]] {
                let h = px + py * dx * 17 + pz * dx * dy * 31;
                let wrapped = h % (1 << 32) % u128::from(buckets);
                let cell = [px, py, pz].map(|v| v as u32);
                assert_eq!(u128::from(grid.bucket(cell)), wrapped);
                assert_eq!(u128::from(grid.key(cell)), px + py * dx + pz * dx * dy);
            }
        }
    }

    #[test]
    fn a_pair_of_buckets_is_what_each_cell_has_alone() {
        for (dims, count) in [([7, 5, 3], 11), ([1 << 20; 3], 90_001), ([1, 1, 1], 1)] {
            let grid = Instance {
                bucket_first: 5,
                ..instance(dims, count)
            };
            // With y 0, x alone takes the hash round.
            for y in [0, 4, dims[1] / 2] {
                for x in [u32::MAX - 1, u32::MAX, 0, 1, 9, 10, 11, dims[0] - 1] {
                    let alone = [x, x.wrapping_add(1)].map(|x| grid.bucket([x, y, 0]));
                    assert_eq!(grid.bucket_pair([x, y, 0]), alone, "{dims:?} {x} {y}");
                }
            }
        }
    }

    #[test]
    fn unusable_grids_are_refused() {
        let good = instance([8, 8, 8], 64);
        let check = |grid: Instance| grid.validate(64);
        assert_eq!(good.validate(63), Err(GridError::OutOfRange));
        assert_eq!(
            check(Instance {
                dims: [8, 0, 8],
                ..good
            }),
            Err(GridError::Dims)
        );
        assert_eq!(
            check(Instance {
                dims: [8, 8, u32::MAX],
                ..good
            }),
            Err(GridError::Dims)
        );
        assert_eq!(
            check(Instance {
                level: LEVELS,
                ..good
            }),
            Err(GridError::Level)
        );
        assert_eq!(
            check(Instance {
                radius: f32::NAN,
                ..good
            }),
            Err(GridError::NotFinite)
        );
        assert_eq!(
            check(Instance {
                bucket_first: u32::MAX,
                ..good
            }),
            Err(GridError::OutOfRange)
        );
        assert_eq!(
            check(Instance {
                bucket_count: 0,
                radius: f32::NAN,
                ..good
            }),
            Ok(())
        );
    }
}
