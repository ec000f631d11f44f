//! Blocks of pixels along the edges of a stamp, without their polynomials, and the products of what remains.

use multiversion::multiversion;

/// Side of a block of border pixels. See docs/constants.md.
pub(super) const BLOCK: usize = 8;
pub(super) const PIXELS: usize = BLOCK * BLOCK;
/// Polynomials of up to second degree that are removed from a block. See docs/constants.md.
pub(super) const POLYNOMIALS: usize = 6;

/// First pixels (y, x) of blocks side by side from the edges of a stamp inwards, once around its frame.
pub(super) fn frame(full: usize) -> Vec<(usize, usize)> {
    let count = full / BLOCK;
    let start = |at: usize| {
        if 2 * at < count {
            at * BLOCK
        } else {
            full - (count - at) * BLOCK
        }
    };
    let last = count - 1;
    let top = (0..last).map(|at| (0, at));
    let right = (0..last).map(|at| (at, last));
    let bottom = (1..=last).rev().map(|at| (last, at));
    let left = (1..=last).rev().map(|at| (at, 0));
    let ring = top.chain(right).chain(bottom).chain(left);
    ring.map(|(y, x)| (start(y), start(x))).collect()
}

/// 1, x, y, x², xy and y² on a block, made orthonormal (Gram and Schmidt).
pub(super) fn polynomials() -> [[f64; PIXELS]; POLYNOMIALS] {
    let mut out = [[0.0; PIXELS]; POLYNOMIALS];
    let powers = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)];
    for (k, (px, py)) in powers.into_iter().enumerate() {
        let middle = (BLOCK as f64 - 1.0) / 2.0;
        let (done, rest) = out.split_at_mut(k);
        let own = &mut rest[0];
        for (at, value) in own.iter_mut().enumerate() {
            let (y, x) = ((at / BLOCK) as f64 - middle, (at % BLOCK) as f64 - middle);
            *value = x.powi(px) * y.powi(py);
        }
        take_out(done, own);
        let norm = own.iter().map(|value| value * value).sum::<f64>().sqrt();
        own.iter_mut().for_each(|value| *value /= norm);
    }
    out
}

/// Takes orthonormal `polynomials` out of a block, and writes the sum of products of what is left at each of `lags`.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn look_at(
    polynomials: &[[f64; PIXELS]],
    lags: &[(i32, i32)],
    block: &mut [f64],
    products: &mut [f32],
) {
    take_out(polynomials, block);
    let rows = beside_zeros(block);
    for (out, &(dx, dy)) in products.iter_mut().zip(lags) {
        *out = product(&rows, dx, dy) as f32;
    }
}

/// Takes orthonormal `polynomials` out of a block.
#[inline(always)]
pub(super) fn take_out(polynomials: &[[f64; PIXELS]], block: &mut [f64]) {
    for polynomial in polynomials {
        // Columns side by side, each of which would wait for the one before.
        let mut columns = [0.0; BLOCK];
        let rows = polynomial.chunks_exact(BLOCK);
        for (p, row) in rows.zip(block.chunks_exact(BLOCK)) {
            for (sum, (p, value)) in columns.iter_mut().zip(p.iter().zip(row)) {
                *sum += p * value;
            }
        }
        let share: f64 = columns.iter().sum();
        for (value, p) in block.iter_mut().zip(polynomial) {
            *value -= share * p;
        }
    }
}

/// The rows of a block with zeros on either side, so that all lags are sums over rows of one length.
#[inline(always)]
fn beside_zeros(block: &[f64]) -> [[f64; 3 * BLOCK]; BLOCK] {
    let mut rows = [[0.0; 3 * BLOCK]; BLOCK];
    for (row, from) in rows.iter_mut().zip(block.chunks_exact(BLOCK)) {
        row[BLOCK..2 * BLOCK].copy_from_slice(from);
    }
    rows
}

/// Sum of products of the block's pixels (dx, dy) apart.
#[inline(always)]
fn product(rows: &[[f64; 3 * BLOCK]; BLOCK], dx: i32, dy: i32) -> f64 {
    let right = BLOCK.saturating_add_signed(dx as isize);
    let mut columns = [0.0; BLOCK];
    for (a, b) in rows.iter().zip(&rows[dy as usize..]) {
        let pairs = a[BLOCK..2 * BLOCK].iter().zip(&b[right..right + BLOCK]);
        for (sum, (a, b)) in columns.iter_mut().zip(pairs) {
            *sum += a * b;
        }
    }
    columns.iter().sum()
}
