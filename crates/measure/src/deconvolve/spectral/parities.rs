//! What is done with windowed spectra by their parities, as `plane` defines them. Real even spectra have two: cc and ss.

use multiversion::multiversion;

use super::plane::Quarters;
use super::product::LANES;

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
        let (even, odd) = (lanes_mut(even, at), lanes_mut(odd, at));
        for l in 0..LANES {
            let square = (cc[l] * cc[l] + ss[l] * ss[l]) + (sc[l] * sc[l] + cs[l] * cs[l]);
            even[l] = scale[l] * (square - variance * floor_even[l]);
            let mixed = 2.0 * (cc[l] * ss[l] - sc[l] * cs[l]);
            odd[l] = scale[l] * (mixed - variance * floor_odd[l]);
        }
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
        let product = along(four(v, at), four(change, at));
        let (mean_even, mean_odd) = (lanes(mean[0], at), lanes(mean[1], at));
        let scale = lanes(scale, at);
        let (even, odd) = (lanes_mut(even, at), lanes_mut(odd, at));
        for l in 0..LANES {
            let twice = 2.0 * scale[l];
            even[l] = twice * (product[0][l] + variance * mean_even[l]);
            odd[l] = twice * (product[1][l] + variance * mean_odd[l]);
        }
    }
}

/// Writes v̂ times 2·scale and a real even spectrum.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn twice_scaled(v: &Quarters, real: &[f32], scale: &[f32], out: &mut Quarters) {
    let quarter = scale.len();
    let v = parts(&v.0, quarter);
    let [out_cc, out_cs, out_sc, out_ss] = out.each();
    for at in (0..quarter).step_by(LANES) {
        let [cc, cs, sc, ss] = four(v, at);
        let (even, odd) = (lanes(real, at), lanes(real, quarter + at));
        let scale = lanes(scale, at);
        let (out_cc, out_ss) = (lanes_mut(out_cc, at), lanes_mut(out_ss, at));
        for l in 0..LANES {
            let (even, odd) = (2.0 * scale[l] * even[l], 2.0 * scale[l] * odd[l]);
            out_cc[l] = cc[l] * even + ss[l] * odd;
            out_ss[l] = cc[l] * odd + ss[l] * even;
        }
        let (out_cs, out_sc) = (lanes_mut(out_cs, at), lanes_mut(out_sc, at));
        for l in 0..LANES {
            let (even, odd) = (2.0 * scale[l] * even[l], 2.0 * scale[l] * odd[l]);
            out_sc[l] = sc[l] * even - cs[l] * odd;
            out_cs[l] = cs[l] * even - sc[l] * odd;
        }
    }
}

/// Sums over the plane of Re(conj(a)·b) times each of three real even spectra.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn sums(a: &Quarters, b: &Quarters, kinds: &[Vec<f32>; 3]) -> [f32; 3] {
    let quarter = a.0.len() / 4;
    let (a, b) = (parts(&a.0, quarter), parts(&b.0, quarter));
    let mut sums = [[0.0f32; LANES]; 3];
    for at in (0..quarter).step_by(LANES) {
        let product = along(four(a, at), four(b, at));
        for (sums, kind) in sums.iter_mut().zip(kinds) {
            let (even, odd) = (lanes(kind, at), lanes(kind, quarter + at));
            for l in 0..LANES {
                sums[l] += product[0][l] * even[l] + product[1][l] * odd[l];
            }
        }
    }
    // Of modes above and below: (e − o)(E − O) + (e + o)(E + O).
    sums.map(|lanes| 2.0 * lanes.iter().sum::<f32>())
}

/// Re(conj(a)·b) of modes: cc and ss.
#[inline(always)]
fn along(a: [&[f32; LANES]; 4], b: [&[f32; LANES]; 4]) -> [[f32; LANES]; 2] {
    let mut out = [[0.0; LANES]; 2];
    let ([acc, acs, asc, ass], [bcc, bcs, bsc, bss]) = (a, b);
    for l in 0..LANES {
        out[0][l] = (acc[l] * bcc[l] + ass[l] * bss[l]) + (asc[l] * bsc[l] + acs[l] * bcs[l]);
        out[1][l] = (acc[l] * bss[l] + ass[l] * bcc[l]) - (asc[l] * bcs[l] + acs[l] * bsc[l]);
    }
    out
}

/// cc, cs, sc and ss.
#[inline(always)]
fn parts(values: &[f32], quarter: usize) -> [&[f32]; 4] {
    std::array::from_fn(|part| &values[part * quarter..][..quarter])
}

/// The lanes at a place of four quarters.
#[inline(always)]
fn four<'a>(parts: [&'a [f32]; 4], at: usize) -> [&'a [f32; LANES]; 4] {
    let [cc, cs, sc, ss] = parts;
    [lanes(cc, at), lanes(cs, at), lanes(sc, at), lanes(ss, at)]
}

#[inline(always)]
fn lanes(values: &[f32], at: usize) -> &[f32; LANES] {
    values[at..].first_chunk().expect("quarters of whole lanes")
}

#[inline(always)]
fn lanes_mut(values: &mut [f32], at: usize) -> &mut [f32; LANES] {
    values[at..]
        .first_chunk_mut()
        .expect("quarters of whole lanes")
}
