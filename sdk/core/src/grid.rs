//! The virtual grid of an instance, and where its cells hash to.

use bytemuck::{Pod, Zeroable};

/// An instance's grid and hash table, as the shaders read it: 80 bytes, five `vec4`.
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
    /// 17·Dx mod `bucket_count`, from Eq. 1.
    pub stride_y: u32,
    /// 31·Dx·Dy mod `bucket_count`, from Eq. 1.
    pub stride_z: u32,
    /// Zero.
    pub reserved: [u32; 3],
}

/// Why an [`Instance`] cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GridError {
    /// A field is not finite, or a radius or scale not above zero.
    NotFinite,
    /// A dimension is 0, or the cells don't number below 2³², or a hash could pass 2³².
    TooLarge,
    /// A stride is not what Eq. 1 gives, or a reserved field is not 0.
    Inconsistent,
    /// Its buckets lie outside the bucket buffer.
    OutOfRange,
}

impl Instance {
    /// Sets the strides of Eq. 1 from `dims` and `bucket_count`.
    pub fn set_strides(&mut self) {
        let [dx, dy, _] = self.dims.map(u64::from);
        let buckets = u64::from(self.bucket_count.max(1));
        self.stride_y = (17 * dx % buckets) as u32;
        // dx·dy is below 2³² for every valid grid, so 31 times it fits.
        self.stride_z = (31 * (dx * dy % buckets) % buckets) as u32;
    }

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
        let [dx, dy, dz] = self.dims.map(u64::from);
        let (max, empty) = (u64::from(u32::MAX), self.dims.contains(&0));
        if empty || (dx * dy).saturating_mul(dz) > max {
            return Err(GridError::TooLarge);
        }
        let hash_max = ((dy - 1) * u64::from(self.stride_y))
            .saturating_add((dz - 1) * u64::from(self.stride_z))
            .saturating_add(dx - 1);
        if hash_max > max {
            return Err(GridError::TooLarge);
        }
        let mut expected = *self;
        expected.set_strides();
        if (expected.stride_y, expected.stride_z) != (self.stride_y, self.stride_z)
            || self.reserved != [0; 3]
        {
            return Err(GridError::Inconsistent);
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

    /// The dense index of a cell inside the grid: what [`crate::Cell::key`] holds.
    pub fn key(&self, cell: [u32; 3]) -> u32 {
        let [x, y, z] = cell;
        x.wrapping_add(y.wrapping_mul(self.dims[0]))
            .wrapping_add(z.wrapping_mul(self.dims[0].wrapping_mul(self.dims[1])))
    }

    /// The bucket, in the bucket buffer, of a cell inside the grid.
    ///
    /// Eq. 1: H(p) = px + py·Dx·17 + pz·Dx·Dy·31, modulo the instance's buckets; the strides are
    /// reduced beforehand, so nothing overflows 32 bits. Call only on a validated instance.
    pub fn bucket(&self, cell: [u32; 3]) -> u32 {
        let [x, y, z] = cell;
        let hash = x
            .wrapping_add(y.wrapping_mul(self.stride_y))
            .wrapping_add(z.wrapping_mul(self.stride_z));
        self.bucket_first
            .wrapping_add(hash % self.bucket_count.max(1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn instance(dims: [u32; 3], bucket_count: u32) -> Instance {
        let mut instance = Instance {
            radius: 0.8,
            cells_per_unit: [20.0; 3],
            dims,
            bucket_count,
            normal_scale: [1.0; 3],
            ..Instance::default()
        };
        instance.set_strides();
        instance
    }

    #[test]
    fn the_bucket_is_equation_1() {
        for (dims, buckets) in [([7, 5, 3], 11), ([700, 300, 400], 90_001), ([1, 1, 1], 1)] {
            let grid = instance(dims, buckets);
            grid.validate(buckets).unwrap();
            let [dx, dy, _] = dims.map(u128::from);
            for (x, y, z) in [
                (0, 0, 0),
                (dims[0] - 1, dims[1] - 1, dims[2] - 1),
                (0, 0, dims[2] / 2),
            ] {
                let [px, py, pz] = [x, y, z].map(u128::from);
                let h = px + py * dx * 17 + pz * dx * dy * 31;
                assert_eq!(u128::from(grid.bucket([x, y, z])), h % u128::from(buckets));
            }
        }
    }

    #[test]
    fn unusable_grids_are_refused() {
        let good = instance([8, 8, 8], 64);
        assert_eq!(good.validate(63), Err(GridError::OutOfRange));
        assert_eq!(
            Instance {
                dims: [8, 0, 8],
                ..good
            }
            .validate(64),
            Err(GridError::TooLarge)
        );
        assert_eq!(
            Instance {
                dims: [u32::MAX; 3],
                ..good
            }
            .validate(64),
            Err(GridError::TooLarge)
        );
        assert_eq!(
            Instance {
                stride_y: 1,
                ..good
            }
            .validate(64),
            Err(GridError::Inconsistent)
        );
        assert_eq!(
            Instance {
                reserved: [0, 1, 0],
                ..good
            }
            .validate(64),
            Err(GridError::Inconsistent)
        );
        assert_eq!(
            Instance {
                radius: f32::NAN,
                ..good
            }
            .validate(64),
            Err(GridError::NotFinite)
        );
        assert_eq!(
            Instance {
                bucket_first: u32::MAX,
                ..good
            }
            .validate(u32::MAX),
            Err(GridError::OutOfRange)
        );
        assert_eq!(
            Instance {
                bucket_count: 0,
                radius: f32::NAN,
                ..good
            }
            .validate(0),
            Ok(())
        );
    }
}
