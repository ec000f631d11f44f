//! Two-dimensional real transforms of zero-padded stamps, column by column.

use std::sync::Arc;

use shearq_fourier::{Complex32, ComplexToReal, Plan32, Planner32, RealToComplex};

/// Transforms of n×n stamps padded with zeros to `size`×`size`. A half spectrum is kept column by
/// column: `size` values along y for each of `size/2 + 1` frequencies along x.
#[derive(Clone)]
pub struct StampFft {
    pub(crate) size: usize,
    forward: Arc<dyn RealToComplex<f32>>,
    backward: Arc<dyn ComplexToReal<f32>>,
    column: Plan32,
    column_back: Plan32,
}

impl std::fmt::Debug for StampFft {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("StampFft").finish_non_exhaustive()
    }
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub struct FftScratch {
    line: Vec<f32>,
    half: Vec<Complex32>,
    fft: Vec<Complex32>,
}

impl StampFft {
    /// Plans for a side of at least `least`: the next even length with no prime factor above 5.
    pub fn new(least: usize) -> Self {
        let size = transform_size(least);
        let mut planner = Planner32::new();
        StampFft {
            size,
            forward: planner.real_forward(size),
            backward: planner.real_inverse(size),
            column: planner.forward(size),
            column_back: planner.inverse(size),
        }
    }

    /// Buffers that fit this plan.
    pub fn scratch(&self) -> FftScratch {
        let zero = Complex32::ZERO;
        let fft = [
            self.forward.get_scratch_len(),
            self.backward.get_scratch_len(),
            self.column.get_inplace_scratch_len(),
            self.column_back.get_inplace_scratch_len(),
        ];
        FftScratch {
            line: vec![0.0; self.size],
            half: vec![zero; self.size / 2 + 1],
            fft: vec![zero; fft.into_iter().max().unwrap_or(0)],
        }
    }

    /// Number of frequencies along x.
    fn half(&self) -> usize {
        self.size / 2 + 1
    }

    /// A half spectrum of zeros.
    pub fn spectrum(&self) -> Vec<Complex32> {
        vec![Complex32::ZERO; self.spectrum_len()]
    }

    /// Number of values in a half spectrum.
    pub(crate) fn spectrum_len(&self) -> usize {
        self.half() * self.size
    }

    /// Transforms the rows along x; [`StampFft::columns`] does the rest.
    pub fn rows<'a>(
        &self,
        rows: impl Iterator<Item = impl Iterator<Item = f32> + 'a>,
        scratch: &mut FftScratch,
        spectrum: &mut [Complex32],
    ) {
        let size = self.size;
        let FftScratch { line, half, fft } = scratch;
        let mut count = 0;
        for (y, row) in rows.enumerate() {
            let mut width = 0;
            for (value, pixel) in line.iter_mut().zip(row) {
                *value = pixel;
                width += 1;
            }
            line[width..].fill(0.0);
            // Lengths are the plan's own, which is all that these calls can object to.
            let done = self.forward.process_with_scratch(line, half, fft);
            debug_assert!(done.is_ok());
            for (k, value) in half.iter().enumerate() {
                spectrum[k * size + y] = *value;
            }
            count += 1;
        }
        for column in spectrum.chunks_exact_mut(size) {
            column[count..].fill(Complex32::ZERO);
        }
    }

    /// Transforms the columns along y.
    pub fn columns(&self, scratch: &mut FftScratch, spectrum: &mut [Complex32]) {
        self.column.process_with_scratch(spectrum, &mut scratch.fft);
    }

    /// Transforms the columns back along y.
    pub fn columns_back(&self, scratch: &mut FftScratch, spectrum: &mut [Complex32]) {
        self.column_back
            .process_with_scratch(spectrum, &mut scratch.fft);
    }

    /// Row `y` of an image whose columns were transformed back; `size²` times too large.
    pub fn row_back<'a>(
        &self,
        spectrum: &[Complex32],
        y: usize,
        scratch: &'a mut FftScratch,
    ) -> &'a [f32] {
        let FftScratch { line, half, fft } = scratch;
        for (k, value) in half.iter_mut().enumerate() {
            *value = spectrum[k * self.size + y];
        }
        // The first and, for even sizes, the last value are real but for rounding.
        half[0].im = 0.0;
        if let Some(last) = half.last_mut() {
            last.im = 0.0;
        }
        let done = self.backward.process_with_scratch(half, line, fft);
        debug_assert!(done.is_ok());
        line
    }
}

/// The smallest even length of at least `least` with no prime factor above 5.
pub(crate) fn transform_size(least: usize) -> usize {
    (least..)
        .find(|&size| {
            let mut rest = size;
            for prime in [2, 3, 5] {
                while rest % prime == 0 {
                    rest /= prime;
                }
            }
            rest == 1 && size % 2 == 0
        })
        .unwrap_or(least)
}
