//! Gaussian noise, many numbers at a time.
//!
//! `rand_distr` draws one number at a time. In vectors, and with the products of small matrices of `render`, a stamp takes 22
//! instead of 36 µs. Two random words make two numbers (Box and Muller 1958): √(−2 ln u)·cos φ and √(−2 ln u)·sin φ. Logarithm, cosine and
//! sine are polynomials of sums and products that are never fused, so that all machines draw the same bits.

use multiversion::multiversion;
use rand::Rng;

// Numbers that are drawn together: pairs of one AVX-512 vector. The bytes of simulations depend on it.
const BLOCK: usize = 32;
const PAIRS: usize = BLOCK / 2;
// Blocks whose words are drawn at once: a call of the generator costs as much as a few words.
const BLOCKS: usize = 8;

/// Multiplies each value by `scale` and adds noise of standard deviation `sigma` to it.
///
/// The noise depends on the state of `rng` and the number of values only. No number exceeds 6.7 standard deviations,
/// which Gaussian noise does once in 4·10¹⁰ numbers.
pub fn add_noise(rng: &mut impl Rng, scale: f32, sigma: f32, values: &mut [f32]) {
    const WORD: usize = size_of::<u32>();
    let mut bytes = [0; WORD * BLOCK * BLOCKS];
    let mut words = [0; BLOCK * BLOCKS];
    for values in values.chunks_mut(BLOCK * BLOCKS) {
        let count = values.len().next_multiple_of(BLOCK);
        rng.fill_bytes(&mut bytes[..WORD * count]);
        for (word, bytes) in words.iter_mut().zip(bytes.as_chunks().0) {
            *word = u32::from_le_bytes(*bytes);
        }
        add(&words[..count], scale, sigma, values);
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add(words: &[u32], scale: f32, sigma: f32, values: &mut [f32]) {
    let mut block = [0.0; BLOCK];
    for (words, values) in words.chunks_exact(BLOCK).zip(values.chunks_mut(BLOCK)) {
        let (radii, turns) = words.split_at(PAIRS);
        let (cosines, sines) = block.split_at_mut(PAIRS);
        for k in 0..PAIRS {
            [cosines[k], sines[k]] = pair(radii[k], turns[k]);
        }
        for (value, noise) in values.iter_mut().zip(&block) {
            *value = *value * scale + noise * sigma;
        }
    }
}

/// Two independent numbers of mean 0 and variance 1 from two words.
#[inline(always)]
fn pair(radius: u32, turn: u32) -> [f32; 2] {
    // In (0, 1]: halves keep the word from being zero. The upper bits alone fit into the conversion of signed numbers.
    let u = ((radius >> 1) as i32 as f32 + 0.5) * (1.0 / 2_147_483_648.0);
    let r = (-2.0 * ln(u)).sqrt();
    // Two bits choose one of four axes, and the others the angle from it, within an eighth of a turn.
    let angle = (turn << 2) as i32 as f32 * (std::f32::consts::FRAC_PI_4 / 2_147_483_648.0);
    let (sin, cos) = small_sin_cos(angle);
    let sign = turn & 0x8000_0000;
    let (along, across) = (f32::from_bits((r * cos).to_bits() ^ sign), r * sin);
    if turn & 0x4000_0000 == 0 {
        [along, across]
    } else {
        [across, along]
    }
}

/// ln x for positive normal numbers, to 1.5 units in the last place.
///
/// With x = m·2ᵉ and m between √½ and √2, ln x = e ln 2 + ln m. The polynomial of m − 1 has the least largest error
/// (Moshier's Cephes library, `logf`).
#[inline(always)]
fn ln(x: f32) -> f32 {
    // The bits of √½: m is not below it.
    const ROOT: u32 = 0x3f35_04f3;
    let bits = x.to_bits().wrapping_sub(ROOT);
    let e = (bits as i32 >> 23) as f32;
    let m = f32::from_bits((bits & 0x007f_ffff) + ROOT);
    let t = m - 1.0;
    let t2 = t * t;
    let mut p = 7.037_683_6e-2;
    for c in [
        -1.151_461e-1,
        1.167_699_9e-1,
        -1.242_014_1e-1,
        1.424_932_3e-1,
        -1.666_805_8e-1,
        2.000_071_5e-1,
        -2.499_999_4e-1,
        3.333_333e-1,
    ] {
        p = p * t + c;
    }
    // ln 2 in two parts. The product of e and the larger part is exact.
    t * t2 * p + e * -2.121_944_4e-4 - 0.5 * t2 + t + e * 0.693_359_4
}

/// Sine and cosine within an eighth of a turn, by the first terms of their series.
#[inline(always)]
fn small_sin_cos(x: f32) -> (f32, f32) {
    let x2 = x * x;
    let sin = x + x * x2 * (-1.0 / 6.0 + x2 * (1.0 / 120.0 - x2 * (1.0 / 5040.0)));
    let cos = 1.0 - x2 * (0.5 - x2 * (1.0 / 24.0 - x2 * (1.0 / 720.0 - x2 * (1.0 / 40320.0))));
    (sin, cos)
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// The same as [`pair`], by the functions of the standard library in double precision.
    fn plain(radius: u32, turn: u32) -> [f64; 2] {
        let r = (-2.0 * ((f64::from(radius >> 1) + 0.5) / 2f64.powi(31)).ln()).sqrt();
        let angle = f64::from((turn << 2) as i32) / 2f64.powi(31) * std::f64::consts::FRAC_PI_4;
        let sign = if turn >> 31 == 0 { 1.0 } else { -1.0 };
        let (along, across) = (sign * r * angle.cos(), r * angle.sin());
        match turn >> 30 & 1 {
            0 => [along, across],
            _ => [across, along],
        }
    }

    #[test]
    fn pairs_are_those_of_exact_functions() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let edges = [
            0,
            1,
            2,
            3,
            1 << 30,
            (1 << 31) - 1,
            1 << 31,
            u32::MAX - 1,
            u32::MAX,
        ];
        let mut cases: Vec<[u32; 2]> = edges.map(|r| edges.map(|t| [r, t])).concat();
        cases.extend((0..100_000).map(|_| [rng.random(), rng.random()]));
        for [radius, turn] in cases {
            let exact = plain(radius, turn);
            // u is rounded to 24 bits: by e = 2⁻²⁵ at most, which changes r = √(−2 ln u) by e/r or less than √(2e).
            let e = 2f64.powi(-25);
            let of_u = f64::min(e / exact[0].hypot(exact[1]), f64::sqrt(2.0 * e));
            for (found, exact) in pair(radius, turn).into_iter().zip(exact) {
                // A few roundings of f32, and the series' next terms: 3·10⁻⁷ of the sine.
                let tolerance = 1.1 * of_u + 1e-6 * exact.abs() + 1e-7;
                assert!(
                    (f64::from(found) - exact).abs() < tolerance,
                    "{radius} {turn}: {found} {exact}"
                );
            }
        }
    }

    #[test]
    fn noise_is_gaussian_white_and_of_the_variance_asked_for() {
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let count = 1 << 21;
        let mut noise = vec![3.0; count];
        add_noise(&mut rng, 0.0, 2.0, &mut noise);
        let noise: Vec<f64> = noise.iter().map(|v| 0.5 * f64::from(*v)).collect();
        let mean_of = |f: &dyn Fn(usize) -> f64| (0..count).map(f).sum::<f64>() / count as f64;
        // Means of powers 1 to 6, and their variances: those of Gaussian numbers.
        let moments = [
            (0.0, 1.0),
            (1.0, 2.0),
            (0.0, 15.0),
            (3.0, 96.0),
            (0.0, 945.0),
            (15.0, 10170.0),
        ];
        for (power, (expected, variance)) in (1..).zip(moments) {
            let found = mean_of(&|k| noise[k].powi(power));
            let error = f64::sqrt(variance / count as f64);
            assert!((found - expected).abs() < 4.0 * error, "{power}: {found}");
        }
        // Neighbours, the two numbers of a pair, and blocks do not know of each other, and neither do their squares.
        for lag in [1, 2, PAIRS, BLOCK, BLOCK * BLOCKS] {
            let other = |k: usize| noise[(k + lag) % count];
            let product = mean_of(&|k| noise[k] * other(k));
            let squares = mean_of(&|k| (noise[k].powi(2) - 1.0) * (other(k).powi(2) - 1.0));
            let error = f64::sqrt(1.0 / count as f64);
            assert!(product.abs() < 4.0 * error, "{lag}: {product}");
            assert!(squares.abs() < 4.0 * 2.0 * error, "{lag}: {squares}");
        }
        // Shares beyond 1 to 4 standard deviations.
        let shares = [0.317_310_5, 0.045_500_3, 2.699_8e-3, 6.334e-5];
        for (beyond, share) in [1.0, 2.0, 3.0, 4.0].into_iter().zip(shares) {
            let found = mean_of(&|k| f64::from(noise[k].abs() > beyond));
            let error = f64::sqrt(share / count as f64);
            assert!((found - share).abs() < 4.0 * error, "{beyond}: {found}");
        }
    }

    #[test]
    fn noise_of_a_part_begins_like_noise_of_the_whole() {
        let draw = |count: usize| {
            let mut values = vec![1.0; count];
            add_noise(&mut ChaCha8Rng::seed_from_u64(1), 3.0, 0.5, &mut values);
            values
        };
        let all = draw(2304);
        // Parts of a block, blocks, and their words in parts.
        for count in [1, 31, 32, 33, 255, 256, 257, 1000] {
            assert_eq!(draw(count), all[..count], "{count}");
        }
    }
}
