//! What is done with windowed spectra by their parities, as `plane` defines them. Real even spectra have two: cc and ss.

use multiversion::multiversion;

use super::plane::Quarters;
use shearq_quantities::product::LANES;

/// Writes scale·(|v̂|² − variance·floor).
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn power(v: &Quarters, scale: &[f32], floor: &[f32], variance: f32, out: &mut [f32]) {
    let quarter = scale.len();
    let v = parts(&v.0, quarter);
    let floor = [&floor[..quarter], &floor[quarter..]];
    let (even, odd) = out.split_at_mut(quarter);
    for at in (0..quarter).step_by(LANES) {
        let [cc, cs, sc, ss] = four(v, at);
        let (floor_even, floor_odd) = (lanes(floor[0], at), lanes(floor[1], at));
        let scale = lanes(scale, at);
        // Results are stored together: the compiler does not know that they are apart.
        let mut out = [[0.0f32; LANES]; 2];
        for l in 0..LANES {
            let square = (cc[l] * cc[l] + ss[l] * ss[l]) + (sc[l] * sc[l] + cs[l] * cs[l]);
            out[0][l] = scale[l] * (square - variance * floor_even[l]);
            let mixed = 2.0 * (cc[l] * ss[l] - sc[l] * cs[l]);
            out[1][l] = scale[l] * (mixed - variance * floor_odd[l]);
        }
        (*lanes_mut(even, at), *lanes_mut(odd, at)) = (out[0], out[1]);
    }
}

/// Writes 2·scale·(Re(conj(v̂)·δv̂) + variance·mean).
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn change(
    v: &Quarters,
    change: &Quarters,
    scale: &[f32],
    mean: &[f32],
    variance: f32,
    out: &mut [f32],
) {
    let quarter = scale.len();
    let (v, change) = (parts(&v.0, quarter), parts(&change.0, quarter));
    let mean = [&mean[..quarter], &mean[quarter..]];
    let (even, odd) = out.split_at_mut(quarter);
    for at in (0..quarter).step_by(LANES) {
        let (v, change) = (four(v, at), four(change, at));
        let (mean_even, mean_odd) = (lanes(mean[0], at), lanes(mean[1], at));
        let scale = lanes(scale, at);
        let mut out = [[0.0f32; LANES]; 2];
        for l in 0..LANES {
            let twice = 2.0 * scale[l];
            out[0][l] = twice * (even_along(v, change, l) + variance * mean_even[l]);
            out[1][l] = twice * (odd_along(v, change, l) + variance * mean_odd[l]);
        }
        (*lanes_mut(even, at), *lanes_mut(odd, at)) = (out[0], out[1]);
    }
}

/// Writes v̂ times 2·scale and a real even spectrum.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn twice_scaled(v: &Quarters, real: &[f32], scale: &[f32], out: &mut Quarters) {
    let quarter = scale.len();
    let v = parts(&v.0, quarter);
    for at in (0..quarter).step_by(LANES) {
        let [cc, cs, sc, ss] = four(v, at);
        let (even, odd) = (lanes(real, at), lanes(real, quarter + at));
        let scale = lanes(scale, at);
        let mut products = [[0.0f32; LANES]; 4];
        for l in 0..LANES {
            let (even, odd) = (2.0 * scale[l] * even[l], 2.0 * scale[l] * odd[l]);
            products[0][l] = cc[l] * even + ss[l] * odd;
            products[1][l] = cs[l] * even - sc[l] * odd;
            products[2][l] = sc[l] * even - cs[l] * odd;
            products[3][l] = cc[l] * odd + ss[l] * even;
        }
        for (part, products) in out.each().into_iter().zip(products) {
            *lanes_mut(part, at) = products;
        }
    }
}

/// Sums over the plane of Re(conj(a)·b) times each of four real even spectra.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn sums(a: &Quarters, b: &Quarters, kinds: &[Vec<f32>; 4]) -> [f32; 4] {
    let quarter = a.0.len() / 4;
    let (a, b) = (parts(&a.0, quarter), parts(&b.0, quarter));
    let (mut of_first, mut of_second) = ([0.0f32; LANES], [0.0f32; LANES]);
    let (mut of_third, mut of_fourth) = ([0.0f32; LANES], [0.0f32; LANES]);
    let [first, second, third, fourth] = kinds;
    let kinds = [first, second, third, fourth].map(|kind| (&kind[..quarter], &kind[quarter..]));
    for at in (0..quarter).step_by(LANES) {
        let (a, b) = (four(a, at), four(b, at));
        let kind = |k: usize| (lanes(kinds[k].0, at), lanes(kinds[k].1, at));
        let (first, second, third, fourth) = (kind(0), kind(1), kind(2), kind(3));
        for l in 0..LANES {
            let (even, odd) = (even_along(a, b, l), odd_along(a, b, l));
            of_first[l] += even * first.0[l] + odd * first.1[l];
            of_second[l] += even * second.0[l] + odd * second.1[l];
            of_third[l] += even * third.0[l] + odd * third.1[l];
            of_fourth[l] += even * fourth.0[l] + odd * fourth.1[l];
        }
    }
    // Of modes above and below: (e − o)(E − O) + (e + o)(E + O).
    [of_first, of_second, of_third, of_fourth].map(|lanes| 2.0 * lanes.iter().sum::<f32>())
}

/// The part cc of Re(conj(a)·b) of modes.
#[inline(always)]
fn even_along(a: [&[f32; LANES]; 4], b: [&[f32; LANES]; 4], l: usize) -> f32 {
    let ([acc, acs, asc, ass], [bcc, bcs, bsc, bss]) = (a, b);
    (acc[l] * bcc[l] + ass[l] * bss[l]) + (asc[l] * bsc[l] + acs[l] * bcs[l])
}

/// The part ss of it.
#[inline(always)]
fn odd_along(a: [&[f32; LANES]; 4], b: [&[f32; LANES]; 4], l: usize) -> f32 {
    let ([acc, acs, asc, ass], [bcc, bcs, bsc, bss]) = (a, b);
    (acc[l] * bss[l] + ass[l] * bcc[l]) - (asc[l] * bcs[l] + acs[l] * bsc[l])
}

/// cc, cs, sc and ss.
#[inline(always)]
pub(super) fn parts(values: &[f32], quarter: usize) -> [&[f32]; 4] {
    std::array::from_fn(|part| &values[part * quarter..][..quarter])
}

/// The lanes at a place of four quarters.
#[inline(always)]
pub(super) fn four(parts: [&[f32]; 4], at: usize) -> [&[f32; LANES]; 4] {
    let [cc, cs, sc, ss] = parts;
    [lanes(cc, at), lanes(cs, at), lanes(sc, at), lanes(ss, at)]
}

#[inline(always)]
pub(super) fn lanes(values: &[f32], at: usize) -> &[f32; LANES] {
    values[at..].first_chunk().expect("quarters of whole lanes")
}

#[inline(always)]
pub(super) fn lanes_mut(values: &mut [f32], at: usize) -> &mut [f32; LANES] {
    values[at..]
        .first_chunk_mut()
        .expect("quarters of whole lanes")
}
