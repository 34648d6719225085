//! Arithmetic on eight numbers at once, with the widest vectors that the processor has. The
//! results are the same with any: no operation rounds otherwise, or more than once.

/// Eight numbers.
pub(super) const LANES: usize = 8;

/// Operations on [`LANES`] numbers.
pub(super) trait Lanes: Copy {
    /// Numbers.
    type F: Copy;
    /// Yes or no, for each.
    type M: Copy;
    fn load(self, from: &[f32; LANES]) -> Self::F;
    fn store(self, from: Self::F) -> [f32; LANES];
    fn splat(self, value: f32) -> Self::F;
    fn add(self, a: Self::F, b: Self::F) -> Self::F;
    fn sub(self, a: Self::F, b: Self::F) -> Self::F;
    fn mul(self, a: Self::F, b: Self::F) -> Self::F;
    fn div(self, a: Self::F, b: Self::F) -> Self::F;
    fn min(self, a: Self::F, b: Self::F) -> Self::F;
    fn max(self, a: Self::F, b: Self::F) -> Self::F;
    /// a >= b, which is false for what is not a number.
    fn ge(self, a: Self::F, b: Self::F) -> Self::M;
    /// a > b.
    fn gt(self, a: Self::F, b: Self::F) -> Self::M;
    fn and(self, a: Self::M, b: Self::M) -> Self::M;
    fn or(self, a: Self::M, b: Self::M) -> Self::M;
    fn select(self, yes: Self::M, a: Self::F, b: Self::F) -> Self::F;
    /// A bit for each, the first the lowest.
    fn bits(self, yes: Self::M) -> u32;

    #[inline(always)]
    fn splat3(self, [a, b, c]: [f32; 3]) -> [Self::F; 3] {
        [self.splat(a), self.splat(b), self.splat(c)]
    }

    /// a·x + b·y + c·z.
    #[inline(always)]
    fn dot(self, [a, b, c]: [Self::F; 3], [x, y, z]: [Self::F; 3]) -> Self::F {
        self.add(self.add(self.mul(a, x), self.mul(b, y)), self.mul(c, z))
    }
}

/// For processors without wider vectors that we know.
#[derive(Clone, Copy)]
pub(super) struct Plain;

#[inline(always)]
fn zip(a: [f32; LANES], b: [f32; LANES], by: impl Fn(f32, f32) -> f32) -> [f32; LANES] {
    std::array::from_fn(|lane| by(a[lane], b[lane]))
}

#[inline(always)]
fn compare(a: [f32; LANES], b: [f32; LANES], by: impl Fn(f32, f32) -> bool) -> u32 {
    (0..LANES).fold(0, |bits, lane| {
        bits | u32::from(by(a[lane], b[lane])) << lane
    })
}

impl Lanes for Plain {
    type F = [f32; LANES];
    type M = u32;

    #[inline(always)]
    fn load(self, from: &[f32; LANES]) -> Self::F {
        *from
    }
    #[inline(always)]
    fn store(self, from: Self::F) -> [f32; LANES] {
        from
    }
    #[inline(always)]
    fn splat(self, value: f32) -> Self::F {
        [value; LANES]
    }
    #[inline(always)]
    fn add(self, a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| a + b)
    }
    #[inline(always)]
    fn sub(self, a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| a - b)
    }
    #[inline(always)]
    fn mul(self, a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| a * b)
    }
    #[inline(always)]
    fn div(self, a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| a / b)
    }
    #[inline(always)]
    fn min(self, a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    fn max(self, a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn ge(self, a: Self::F, b: Self::F) -> u32 {
        compare(a, b, |a, b| a >= b)
    }
    #[inline(always)]
    fn gt(self, a: Self::F, b: Self::F) -> u32 {
        compare(a, b, |a, b| a > b)
    }
    #[inline(always)]
    fn and(self, a: u32, b: u32) -> u32 {
        a & b
    }
    #[inline(always)]
    fn or(self, a: u32, b: u32) -> u32 {
        a | b
    }
    #[inline(always)]
    fn select(self, yes: u32, a: Self::F, b: Self::F) -> Self::F {
        std::array::from_fn(|lane| {
            if yes >> lane & 1 == 1 {
                a[lane]
            } else {
                b[lane]
            }
        })
    }
    #[inline(always)]
    fn bits(self, yes: u32) -> u32 {
        yes
    }
}

/// AVX.
#[cfg(target_arch = "x86_64")]
impl Lanes for pulp::x86::V3 {
    type F = std::arch::x86_64::__m256;
    type M = std::arch::x86_64::__m256;

    #[inline(always)]
    fn load(self, from: &[f32; LANES]) -> Self::F {
        bytemuck::cast(*from)
    }
    #[inline(always)]
    fn store(self, from: Self::F) -> [f32; LANES] {
        bytemuck::cast(from)
    }
    #[inline(always)]
    fn splat(self, value: f32) -> Self::F {
        self.avx._mm256_set1_ps(value)
    }
    #[inline(always)]
    fn add(self, a: Self::F, b: Self::F) -> Self::F {
        self.avx._mm256_add_ps(a, b)
    }
    #[inline(always)]
    fn sub(self, a: Self::F, b: Self::F) -> Self::F {
        self.avx._mm256_sub_ps(a, b)
    }
    #[inline(always)]
    fn mul(self, a: Self::F, b: Self::F) -> Self::F {
        self.avx._mm256_mul_ps(a, b)
    }
    #[inline(always)]
    fn div(self, a: Self::F, b: Self::F) -> Self::F {
        self.avx._mm256_div_ps(a, b)
    }
    #[inline(always)]
    fn min(self, a: Self::F, b: Self::F) -> Self::F {
        self.avx._mm256_min_ps(a, b)
    }
    #[inline(always)]
    fn max(self, a: Self::F, b: Self::F) -> Self::F {
        self.avx._mm256_max_ps(a, b)
    }
    #[inline(always)]
    fn ge(self, a: Self::F, b: Self::F) -> Self::M {
        self.avx
            ._mm256_cmp_ps::<{ std::arch::x86_64::_CMP_GE_OQ }>(a, b)
    }
    #[inline(always)]
    fn gt(self, a: Self::F, b: Self::F) -> Self::M {
        self.avx
            ._mm256_cmp_ps::<{ std::arch::x86_64::_CMP_GT_OQ }>(a, b)
    }
    #[inline(always)]
    fn and(self, a: Self::M, b: Self::M) -> Self::M {
        self.avx._mm256_and_ps(a, b)
    }
    #[inline(always)]
    fn or(self, a: Self::M, b: Self::M) -> Self::M {
        self.avx._mm256_or_ps(a, b)
    }
    #[inline(always)]
    fn select(self, yes: Self::M, a: Self::F, b: Self::F) -> Self::F {
        self.avx._mm256_blendv_ps(b, a, yes)
    }
    #[inline(always)]
    fn bits(self, yes: Self::M) -> u32 {
        self.avx._mm256_movemask_ps(yes) as u32
    }
}
