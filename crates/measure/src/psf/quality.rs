//! Whether a PSF image is what the measurement requires: background subtracted, enough light over the noise, sampled with
//! the pixels of the galaxies.
//!
//! Everything is measured on the pixels that are used, of sum one. The border of a PSF holds its wings, so that its level
//! alone does not show a background: wings are not negative and fall at least like r^(−2.5), and only what lies outside
//! these bounds counts as a background.

use std::f64::consts::PI;

use ndarray::{ArrayView2, Axis, s};
use shearq_quantities::statistics::upper_median;

use super::denoised_star::{MIN_DENOISED_SIDE, UNCHANGED_SNR, noise_level};
use super::star::psf_offset;
use super::truncation::Truncation;
use super::width::BORDER;
use crate::defects::{dead_pixels, hot_pixels};
use crate::moments::{CoreSize, psf_core_size};
use crate::warning::{ExaminedPsfs, Warning};

// Distances from the centre, in units of half the side, of the pixels with which the border is compared.
const HALFWAY: std::ops::Range<f64> = 0.5..0.65;
// Power of the radius: slower than the averaged rings of an Airy disc (3) and turbulence (11/3).
const SLOWEST_WING: f64 = 2.5;
// Power of the radius with which the rings of an Airy disc fall.
const RING_FALL: f64 = 3.0;
// Chosen by hand, for all warnings.
const SIGNIFICANCE: f64 = 5.0;
// Light of a background, in units of the star's. Above it |m| may exceed 2·10⁻³. Chosen by hand.
const MAX_BACKGROUND: f64 = 0.1;
// Pixels a side in which the light of a background changes m: those of a PSF that 48/linear/star uses.
const BACKGROUND_SIDE: usize = 48;
// PSFs of fewer pixels have m of either sign, +0.005 to +0.4. 32 px: the simulations below.
const MIN_BACKGROUND_SIDE: usize = 44;
// m over the square of the background's light on these pixels in units of the star's. Galaxies of half-light radii 2.2 to 4 px (1.8 to 3.5 px
// for the FWHM of 2.4 px) at S/N 20: −0.003, −0.041, −0.20 for 0.3, 1 and 2 % of the peak of a Moffat PSF of FWHM 3.4 px (shares 0.33, 1.1,
// 2.2), −0.005 and −0.11 for 0.3 and 1 % at 2.4 px (0.58, 1.9); the same at S/N 60. Half-light radii of 4 to 6 px: +0.009, −0.018, −0.23.
const M_PER_SQUARED_BACKGROUND: f64 = -0.033;
// Further light changes m no more. The same simulations: −0.71 for 5 % (share 5.6), −0.78 for 2 % at 2.4 px (3.9).
const LEAST_M_OF_BACKGROUND: f64 = -0.8;
// Share of a negative background from which the deconvolved light has no width. The same simulations: −0.003 for −0.17, and no shapes for −0.29.
const DARK_BACKGROUND: f64 = -0.2;
// In units of the peak: stamps without a star have any level.
const MAX_STATED_LEVEL: f64 = 100.0;
// Light of a gradient that is extrapolated from the brighter edge, in units of the star's. Chosen by hand.
const MAX_GRADIENT: f64 = 0.3;
// At S/N 1000 the noise of one star changes m by 3.1·10⁻³: docs/limitations.md.
const MIN_SNR_SHARED: f64 = 1000.0;
// Of a star per galaxy, the noise averages out. Chosen by hand.
const MIN_SNR_EACH: f64 = 100.0;
// Wave number in radians per pixel at which the transform of a PSF is compared with the limits below.
const SAMPLED_WAVE_NUMBER: f64 = 2.0;
// Where the transform of a PSF from finer pixels is zero.
const FILTERED_WAVE_NUMBER: f64 = 3.0;
// Power of rounding there.
const MAX_FILTERED_POWER: f64 = 1e-5;
// A further one: of optics, less light than usual there in relation to P(2) shows that an alias of the opposite sign was added.
const EDGE_WAVE_NUMBER: f64 = 2.6;
// m is 0.6 to 1.2 times P(2π − 1), the light that is aliased to one radian per pixel, which the pixels show only together with P(1):
// an image has S(k) = P(k) + c P(2π − k), where c = 1 for a PSF centred on a pixel and −1 on a corner. Limits and slopes below are
// values at c = 0 and their changes with c, chosen by hand: m of 400 galaxies of half-light radii 1.5 to 3.5 px at S/N 200 behind 25 PSFs.
// ln S(2)/ln S(1) of turbulence and Gaussians exceeds this, that of obscured optics with any jitter or charge diffusion does not: at c = −1,
// 3.2 to 4.7 and 1.8 to 3.15. Airy discs of λ/D = 1 px and obscurations from 0.35 on have 3.22 and more.
const INDEX_TURBULENCE: [f64; 2] = [3.0, -0.2];
// S(2) from which m departs from zero, and how m then grows with it.
// Optics at c = −1: S(2) = 0.256 (Roman Y106) has m = 0.032, 0.342 (Euclid NISP J) 0.041. At c = 1, 0.30 (Euclid VIS) has m = 0, 0.37 (J129) 0.008,
// 0.44 (Y106) 0.032, 0.58 (NISP J) 0.041.
const OPTICS: [[f64; 2]; 2] = [[0.28, 0.07], [0.26, -0.04]];
// Turbulence at c = −1: S(2) = 0.32 has m = 0.004, 0.45 0.014, 0.54 0.023.
const TURBULENCE: [[f64; 2]; 2] = [[0.315, 0.015], [0.05, -0.005]];
// c below which a PSF is on a corner. Chosen by hand.
const MAX_CORNER: f64 = -0.5;
// There, S(2) of optics without aliases is as large, but S(2.6)/S(2) exceeds this at an index of 2.65 and its slope with the index: Roman Y106
// and J129 have 0.41 to 0.43 at 2.6 to 2.7, Euclid NISP J 0.44 at 2.75 and Airy discs of λ/D = 1 px 0.47 to 0.48 at 3.0; GREAT3's
// PSFs of multiepoch-space, of λ/D = 1.2 to 1.6 px, 0.47 to 0.50 at 2.6 to 2.8, Euclid VIS and Roman H158 0.53 and more. All have m = 0.
const EDGE_RATIO: [f64; 2] = [0.462, 0.08];
// Index at which the limit has that value. Definition.
const EDGE_RATIO_INDEX: f64 = 2.65;
// Nor does ln S(2)/ln S(1) fall below this with aliases: J129 has 2.63. Obscurations of 0.17 and more have at most 2.48 from λ/D = 1.5 px on.
const MIN_ALIASED_INDEX: f64 = 2.55;
// S(3)/S(2.6), squared, on a corner. With aliases, S is zero at π by symmetry and 0.22 to 0.30 there; optics of λ/D = 2 px have 0.12.
const MIN_ALIASED_FALL: f64 = 0.04;
// Largest change of c in units of that of m at c = ±1, which is positive on a corner. Airy discs and Moffat PSFs on a pixel's centre
// have 0 to 0.32, those on the middle of a side 0.2 to 0.5 of either sign.
const C_PER_M: f64 = 0.3;
// Effect on m of aliasing above which a warning is due.
const MAX_ALIASING: f64 = 0.002;
// Mean square radius of the PSF's core in units of the galaxies', above which a warning is due. Simulated galaxies, PSF of
// FWHM 3.4 px: 0.48 to 0.53; PSF 1.3 times too wide: 0.75; 1.4 times: 0.86 to 0.93. Command and seed not recorded.
const MAX_CORE_RATIO: f64 = 0.83;
// The same ratio above which an error is due. The same simulation, PSF 1.5 times too wide: 0.97 to 1.06. Stars have 1.
const IMPOSSIBLE_CORE_RATIO: f64 = 1.02;
// Share of the PSFs of an image that a warning requires. Chosen by hand.
const MIN_SHARE: f64 = 0.1;
// Standard deviations of m and of c by the noise of one star, times its S/N, below S/N 500.
// Table star-noise of docs/ledger.csv, 40 realizations of the noise per S/N: m 2.2 to 2.4, c 1.16 to 1.20 at S/N 50 to 500.
const BIAS_TIMES_SNR: [f64; 2] = [2.3, 1.2];
// The same for a star that is not denoised. The same table at S/N 1000: 0.0055 and 0.0023.
const BIAS_TIMES_SNR_UNCHANGED: [f64; 2] = [5.5, 2.3];

// Pixels of the brightest value that symmetry around a corner makes equal.
const SYMMETRIC_TOP: usize = 4;
// Squared distances in pixels from a corner of the pixels next to these four, in equal steps.
const SQUARED_RADII: [f64; 3] = [2.5, 4.5, 6.5];
// ln of the light that is missing in the four: a core at 0.9 of the peak, of which m is 0.02, lacks 0.09 behind a Moffat PSF of FWHM 3.4 px.
// Gaussian, Moffat and Airy PSFs lack none, because the third derivative of ln p by r² is zero or negative.
const MIN_MISSING_TOP: f64 = 0.05;
// The same per square of ln p(1.5, 0.5)/p(0.5, 1.5), as an ellipticity along an axis imitates it: 0.36 for a Moffat PSF (β = 3) of
// FWHM 3.4 px and ε = 0.3.
const MISSING_BY_ELLIPTICITY: f64 = 0.5;
// ln of the peak to p at the last radius; narrower cores are not sampled. Chosen by hand.
const MAX_SAMPLED_FALL: f64 = 2.0;
// Rounding to single precision, in units of the peak.
const FLATNESS: f64 = 2e-7;

#[derive(Debug, Clone, Copy)]
pub(crate) struct PsfQuality {
    side: usize,
    snr: f64,
    /// Background: level in units of the peak, light in units of the star's.
    level: f64,
    background: f64,
    /// The change of m by the background, infinite if no shapes remain; NaN where it is not known.
    background_m: f64,
    /// Gradient of the background: change per pixel in units of the peak, light in units of the star's.
    slope: [f64; 2],
    gradient: f64,
    /// Modulus of the transform at [`SAMPLED_WAVE_NUMBER`], and the change of m and the largest one of c by light that is aliased.
    power: f64,
    aliasing: [f64; 2],
    truncation: Option<Truncation>,
    core: Option<CoreSize>,
    moved: Option<[f64; 2]>,
    /// Pixels that are much darker than those around them; those that are much brighter, and the distance of the farthest from the centre.
    dead: usize,
    hot: usize,
    farthest_hot: f64,
    /// Whether the brightest pixels have one value, below that of the peak.
    is_cut: bool,
    /// Centroid from the centre of the pixels that are used.
    pub(crate) offset: [f64; 2],
}

impl PsfQuality {
    /// S/N of the star; infinite without noise.
    pub(crate) fn snr(&self) -> f64 {
        self.snr
    }

    /// Standard deviations of m and c by the noise of the star, if all galaxies share it.
    pub(crate) fn noise_bias(&self) -> [f64; 2] {
        let [denoised, unchanged] = UNCHANGED_SNR;
        if self.side < MIN_DENOISED_SIDE || self.snr >= unchanged {
            return BIAS_TIMES_SNR_UNCHANGED.map(|times| times / self.snr.max(1.0));
        }
        // Between the two, less and less of the noise is removed.
        BIAS_TIMES_SNR.map(|times| times / self.snr.clamp(1.0, denoised))
    }

    /// Of a PSF of sum one, which was `moved` by so much to its centre; `None` if it is too small, or a pixel is not
    /// finite.
    pub(crate) fn from_psf(
        psf: ArrayView2<'_, f64>,
        moved: Option<[f64; 2]>,
    ) -> Option<PsfQuality> {
        let n = psf.nrows();
        if n != psf.ncols() || n < 4 * BORDER || psf.iter().any(|value| !value.is_finite()) {
            return None;
        }
        let middle = (n as f64 - 1.0) / 2.0;
        let distance = |x: usize, y: usize| {
            let along = |at: usize| (at as f64 - middle).abs();
            along(x).max(along(y))
        };
        let (mut border, mut halfway, mut edges) =
            (Mean::default(), Mean::default(), [Mean::default(); 4]);
        let mut peak = f64::NEG_INFINITY;
        for ((y, x), &value) in psf.indexed_iter() {
            let away = distance(x, y);
            for (edge, at) in edges.iter_mut().zip([x, n - 1 - x, y, n - 1 - y]) {
                if at < BORDER {
                    edge.add(value, away);
                }
            }
            if away > middle - BORDER as f64 {
                border.add(value, away);
            } else if HALFWAY.contains(&(away / (middle + 0.5))) {
                halfway.add(value, away);
            }
            peak = peak.max(value);
        }
        let sigma = noise_level(psf, &mut Vec::new());
        // The level below the slowest wing through both rings; a negative border has no wing.
        let fall = (halfway.radius() / border.radius()).powf(SLOWEST_WING);
        let below_wing = (border.mean() - fall * halfway.mean()) / (1.0 - fall);
        let level = if below_wing > 0.0 {
            below_wing
        } else {
            border.mean().min(0.0)
        };
        let error =
            sigma * (1.0 / border.count + fall * fall / halfway.count).sqrt() / (1.0 - fall);
        let level = if level.abs() > SIGNIFICANCE * error {
            level
        } else {
            0.0
        };
        let pixels = (n * n) as f64;
        let used = n.min(BACKGROUND_SIDE).pow(2) as f64;
        let star = (1.0 - level * pixels).max(f64::MIN_POSITIVE);
        let [left, right, bottom, top] = edges.map(|edge| edge.mean());
        let across = (n - BORDER) as f64;
        let error = sigma * 2f64.sqrt() / (edges[0].count.sqrt() * across);
        let slope = [(right - left) / across, (top - bottom) / across];
        let steep = slope[0].hypot(slope[1]);
        let steep = if steep > SIGNIFICANCE * error {
            steep
        } else {
            0.0
        };
        let noise = noise_beneath_rings(psf, sigma, [halfway.radius(), border.radius()]);
        // Not the S/N of all pixels, by which stars are denoised: a background is no light here, and outer pixels hold
        // more noise than light.
        let (mut power, mut count) = (0.0, 0.0);
        for ((y, x), &value) in psf.indexed_iter() {
            let away = distance(x, y);
            if away < HALFWAY.start * (middle + 0.5) {
                power += (value - border.mean()).powi(2);
                count += 1.0;
            }
        }
        let peak = (peak - border.mean()).max(f64::MIN_POSITIVE);
        let moduli = [
            0.5 * SAMPLED_WAVE_NUMBER,
            SAMPLED_WAVE_NUMBER,
            EDGE_WAVE_NUMBER,
        ]
        .map(|k| {
            let square = axis_power(psf, k);
            (square - pixels * sigma * sigma).max(0.0).sqrt()
        });
        let offset = psf_offset(psf);
        let hot = hot_pixels(psf, sigma);
        Some(PsfQuality {
            side: n,
            dead: dead_pixels(psf, sigma),
            hot: hot.len(),
            farthest_hot: hot.into_iter().fold(0.0, f64::max),
            is_cut: is_cut(psf),
            snr: (power - count * noise * noise).max(0.0).sqrt() / noise,
            level: (level / peak).clamp(-MAX_STATED_LEVEL, MAX_STATED_LEVEL),
            background: level * pixels / star,
            background_m: match n {
                MIN_BACKGROUND_SIDE.. => m_of_background(level * used / star),
                _ => f64::NAN,
            },
            slope: slope.map(|slope| slope / peak),
            gradient: steep * 0.5 * n as f64 * pixels / star,
            power: moduli[1],
            aliasing: aliased(psf, moduli, sigma, offset.map(|off| middle + off)),
            truncation: Truncation::of(psf, 1.0),
            core: psf_core_size(psf, offset, border.mean(), sigma),
            moved,
            offset,
        })
    }
}

// The change of m by a background with this light, in units of the star's.
fn m_of_background(share: f64) -> f64 {
    match share < DARK_BACKGROUND {
        true => f64::INFINITY,
        false => (M_PER_SQUARED_BACKGROUND * share * share).max(LEAST_M_OF_BACKGROUND),
    }
}

// What aliased light changes m by, and c by at most, from the moduli of the transform at three wave numbers, for a PSF whose centre is at
// `place` in pixels.
fn aliased(
    psf: ArrayView2<'_, f64>,
    [low, sampled, edge]: [f64; 3],
    sigma: f64,
    place: [f64; 2],
) -> [f64; 2] {
    let [x, y] = place.map(|at| (2.0 * PI * at).cos());
    let phase = 0.5 * (x + y);
    let filtered = axis_power(psf, FILTERED_WAVE_NUMBER);
    let falls = filtered < MIN_ALIASED_FALL * axis_power(psf, EDGE_WAVE_NUMBER);
    // From finer pixels, or of optics that the pixels sample: without aliases.
    if filtered < MAX_FILTERED_POWER || phase < MAX_CORNER && falls {
        return [0.0; 2];
    }
    // Less the noise of the transform.
    let least = sampled - 2.0 * sigma * psf.nrows() as f64;
    let size = aliasing([low, least, edge], phase);
    let most = (0.5 * (x - y)).abs().max(phase);
    [-phase * size, C_PER_M * size * most.max(0.0)]
}

/// The noise of a pixel of which the diffraction rings of optics have no share: `sigma` is measured on the border, and rings fall with the
/// radius, as noise does not. `radii` are mean distances of the pixels halfway to the border and of those on it.
fn noise_beneath_rings(psf: ArrayView2<'_, f64>, sigma: f64, [halfway, border]: [f64; 2]) -> f64 {
    let n = psf.nrows();
    let first = (0.5 * n as f64 - halfway).round() as usize;
    let inner = psf.slice(s![first..n - first, first..n - first]);
    let inside = noise_level(inner, &mut Vec::new());
    let fall = (halfway / border).powf(2.0 * RING_FALL);
    let square = (sigma * sigma - fall * inside * inside) / (1.0 - fall);
    square.clamp(0.0, sigma * sigma).sqrt()
}

/// Whether the core is cut off: more brightest pixels than symmetry makes equal, or a peak below the one that the pixels around it
/// show, of which ln p is a parabola in r².
fn is_cut(psf: ArrayView2<'_, f64>) -> bool {
    let peak = psf.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let is_top = |value: f64| value >= peak - FLATNESS * peak.abs();
    let top: Vec<_> = psf
        .indexed_iter()
        .filter(|(_, value)| is_top(**value))
        .map(|(at, _)| at)
        .collect();
    let [(y, x), .., (last_y, last_x)] = top[..] else {
        return false;
    };
    if top.len() != SYMMETRIC_TOP || (last_y, last_x) != (y + 1, x + 1) {
        return top.len() > SYMMETRIC_TOP;
    }
    let place = |(row, column): (usize, usize)| {
        [column as f64 - x as f64 - 0.5, row as f64 - y as f64 - 0.5]
    };
    let mut rings = [Mean::default(); 3];
    let mut ellipticity = 0.0;
    for (at, &value) in psf.indexed_iter() {
        let [dx, dy] = place(at);
        let square = dx * dx + dy * dy;
        if let Some(k) = SQUARED_RADII.iter().position(|at| *at == square) {
            rings[k].add(value.ln(), square);
            if k == 0 {
                ellipticity += 0.25 * (dx.abs() - dy.abs()) * value.ln();
            }
        }
    }
    // NaN where there is no light.
    let [near, next, far] = rings.map(|ring| ring.mean());
    let missing = 3.0 * (near - next) + far - peak.ln();
    peak.ln() - far < MAX_SAMPLED_FALL
        && missing > MIN_MISSING_TOP + MISSING_BY_ELLIPTICITY * ellipticity * ellipticity
}

/// Mean of |p̂|² at a wave number along x and along y.
fn axis_power(psf: ArrayView2<'_, f64>, wave_number: f64) -> f64 {
    let of_axis = |axis: Axis| {
        let lines = psf.axis_iter(axis).map(|line| line.sum());
        let (cos, sin) = lines
            .enumerate()
            .fold((0.0, 0.0), |(cos, sin), (at, light)| {
                let (s, c) = (wave_number * at as f64).sin_cos();
                (cos + c * light, sin + s * light)
            });
        cos * cos + sin * sin
    };
    0.5 * (of_axis(Axis(0)) + of_axis(Axis(1)))
}

/// About how much m changes, without its sign, by light that pixels alias, of a PSF image with these moduli at half of [`SAMPLED_WAVE_NUMBER`], there and at
/// [`EDGE_WAVE_NUMBER`], whose aliases have the sign and weight `phase`.
fn aliasing([low, sampled, edge]: [f64; 3], phase: f64) -> f64 {
    let at = |[value, change]: [f64; 2]| value + change * phase;
    // NaN of a PSF of one pixel, which has all wave numbers.
    let index = sampled.ln() / low.ln();
    let is_turbulence = index > at(INDEX_TURBULENCE);
    let [least, slope] = if is_turbulence { TURBULENCE } else { OPTICS };
    let [ratio, change] = EDGE_RATIO;
    let is_sampled = edge > (ratio + change * (index - EDGE_RATIO_INDEX)) * sampled;
    if !is_turbulence && phase < MAX_CORNER && (is_sampled || index < MIN_ALIASED_INDEX) {
        return 0.0;
    }
    at(slope) * (sampled - at(least)).max(0.0)
}

/// Means over pixels: of their values, and of their distances from the centre.
#[derive(Debug, Clone, Copy, Default)]
struct Mean {
    sum: f64,
    radii: f64,
    count: f64,
}

impl Mean {
    fn add(&mut self, value: f64, radius: f64) {
        self.sum += value;
        self.radii += radius;
        self.count += 1.0;
    }

    fn mean(&self) -> f64 {
        self.sum / self.count
    }

    fn radius(&self) -> f64 {
        self.radii / self.count
    }
}

/// The PSFs of an image with one defect, if they are more than a few.
struct Defective<'a> {
    psfs: Vec<&'a PsfQuality>,
    of: ExaminedPsfs,
}

impl<'a> Defective<'a> {
    fn among(
        all: &'a [PsfQuality],
        is_defective: impl Fn(&PsfQuality) -> bool,
    ) -> Option<Defective<'a>> {
        let psfs: Vec<_> = all.iter().filter(|psf| is_defective(psf)).collect();
        let (count, of) = (psfs.len(), all.len());
        let is_many = count > 0 && count as f64 >= MIN_SHARE * of as f64;
        is_many.then_some(Defective {
            psfs,
            of: ExaminedPsfs { count, of },
        })
    }

    fn median(&self, value: impl Fn(&PsfQuality) -> f64) -> f64 {
        let mut values: Vec<f64> = self.psfs.iter().map(|psf| value(psf)).collect();
        upper_median(&mut values).unwrap_or(f64::NAN)
    }
}

/// Warnings about the PSFs of an image, `shared` by all galaxies or not, whose galaxies have the core `galaxies`.
pub(crate) fn psf_warnings(
    all: &[PsfQuality],
    shared: bool,
    galaxies: Option<CoreSize>,
) -> Vec<Warning> {
    let mut found = Vec::new();
    if let Some(psfs) = Defective::among(all, |psf| psf.moved.is_some()) {
        let offset = |k: usize| psfs.median(|psf| psf.moved.map_or(0.0, |moved| moved[k]));
        found.push(Warning::PsfOffCentre {
            offset: [offset(0), offset(1)],
            of: psfs.of,
        });
    }
    let is_defect = |psf: &PsfQuality| psf.dead > 0 || psf.hot > 0 || psf.is_cut;
    if let Some(psfs) = Defective::among(all, is_defect) {
        found.push(Warning::PsfDefect {
            dead: psfs.median(|psf| psf.dead as f64) as usize,
            hot: psfs.median(|psf| psf.hot as f64) as usize,
            distance: psfs.median(|psf| psf.farthest_hot),
            of: psfs.of,
        });
    }
    if let Some(psfs) = Defective::among(all, |psf| psf.background.abs() > MAX_BACKGROUND) {
        found.push(Warning::PsfBackground {
            level: psfs.median(|psf| psf.level),
            share: psfs.median(|psf| psf.background),
            m: psfs.median(|psf| psf.background_m),
            of: psfs.of,
        });
    }
    if let Some(psfs) = Defective::among(all, |psf| psf.gradient > MAX_GRADIENT) {
        found.push(Warning::PsfGradient {
            slope: [0, 1].map(|k| psfs.median(|psf| psf.slope[k])),
            of: psfs.of,
        });
    }
    let enough = if shared { MIN_SNR_SHARED } else { MIN_SNR_EACH };
    if let Some(psfs) = Defective::among(all, |psf| psf.snr < enough) {
        found.push(Warning::PsfNoise {
            snr: psfs.median(|psf| psf.snr),
            enough,
            effect: shared.then(|| [0, 1].map(|k| psfs.median(|psf| psf.noise_bias()[k]))),
            of: psfs.of,
        });
    }
    let is_aliased = |psf: &PsfQuality| psf.aliasing.iter().any(|by| by.abs() > MAX_ALIASING);
    if let Some(psfs) = Defective::among(all, is_aliased) {
        found.push(Warning::PsfNarrow {
            power: psfs.median(|psf| psf.power),
            effect: [0, 1].map(|k| psfs.median(|psf| psf.aliasing[k])),
            of: psfs.of,
        });
    }
    if let Some(psfs) = Defective::among(all, |psf| psf.truncation.is_some()) {
        let of = |value: &dyn Fn(Truncation) -> f64| {
            psfs.median(|psf| psf.truncation.map_or(f64::NAN, value))
        };
        found.push(Warning::PsfTruncated {
            side: of(&|cut| cut.side),
            level: of(&|cut| cut.level),
            effect: [0, 1].map(|k| of(&|cut| cut.effect()[k])),
            of: psfs.of,
        });
    }
    found.extend(galaxies.and_then(|galaxies| too_wide(all, galaxies)));
    found
}

/// A galaxy has no narrower core than its PSF, so that a PSF as wide as the galaxies is one of other data.
fn too_wide(all: &[PsfQuality], galaxies: CoreSize) -> Option<Warning> {
    let mut cores: Vec<CoreSize> = all.iter().filter_map(|psf| psf.core).collect();
    cores.sort_by(|a, b| a.mean_square_radius.total_cmp(&b.mean_square_radius));
    let psf = cores.get(cores.len() / 2)?;
    let exceeds = |ratio: f64| {
        let error = psf.error.hypot(ratio * galaxies.error);
        psf.mean_square_radius - ratio * galaxies.mean_square_radius > SIGNIFICANCE * error
    };
    exceeds(MAX_CORE_RATIO).then(|| Warning::PsfBroad {
        psf: psf.fwhm(),
        galaxies: galaxies.fwhm(),
        fatal: exceeds(IMPOSSIBLE_CORE_RATIO),
    })
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use shearq_quantities::{PsfProfile, Shear};

    use super::*;
    use crate::examine::Examination;
    use crate::psf::testing::{drawn, limits, noisy};
    use crate::psf::{Psfs, Star};

    const MOFFAT: PsfProfile = PsfProfile::Moffat { beta: 3.0 };

    fn sheared(profile: PsfProfile, fwhm: f64, side: usize) -> Array2<f64> {
        drawn(profile, fwhm, Shear::new(0.05, -0.03), side)
    }

    #[test]
    fn the_bias_of_a_noisy_star_is_the_measured_one() {
        // The measured scatters of docs/limitations.md, to 6 %.
        for (snr, m, c) in [
            (50.0, 0.045, 0.023),
            (100.0, 0.023, 0.012),
            (200.0, 0.012, 0.0058),
            (500.0, 0.0047, 0.0024),
            (1000.0, 0.0055, 0.0023),
        ] {
            let found = quality(snr, 48).noise_bias();
            assert!((found[0] / m - 1.0).abs() < 0.06, "{snr}: {found:?}");
            assert!((found[1] / c - 1.0).abs() < 0.06, "{snr}: {found:?}");
        }
        assert_eq!(quality(100.0, 23).noise_bias(), [0.055, 0.023]);
        assert_eq!(quality(f64::INFINITY, 48).noise_bias(), [0.0; 2]);
        // Less than one is as bad as one.
        assert_eq!(quality(0.0, 48).noise_bias(), [2.3, 1.2]);
    }

    fn quality(snr: f64, side: usize) -> PsfQuality {
        let psf = sheared(MOFFAT, 3.4, 48);
        let quality = PsfQuality::from_psf(psf.view(), None).unwrap();
        PsfQuality {
            snr,
            side,
            ..quality
        }
    }

    /// Kinds of warnings about a PSF of any sum.
    fn kinds(stamp: &Array2<f64>) -> Vec<&'static str> {
        let Star { psf, .. } = Star::cut(stamp.view(), stamp.nrows()).unwrap();
        let quality = PsfQuality::from_psf(psf.view(), None).unwrap();
        let found = psf_warnings(&[quality], true, None);
        found.iter().map(Warning::kind).collect()
    }

    /// An Airy disc, (2 J₁(x)/x)² at pixel centres.
    fn airy(fwhm: f64, side: usize) -> Array2<f64> {
        let middle = (side as f64 - 1.0) / 2.0;
        Array2::from_shape_fn((side, side), |(y, x)| {
            let r = (x as f64 - middle).hypot(y as f64 - middle);
            let x = (3.2327 * r / fwhm).max(1e-6);
            (2.0 * puruspe::bessel::Jn(1, x) / x).powi(2)
        })
    }

    #[test]
    fn wings_are_neither_background_nor_noise() {
        for side in [32, 48, 64] {
            for fwhm in [1.6, 2.4, 3.4, 6.0] {
                for profile in [
                    MOFFAT,
                    PsfProfile::Moffat { beta: 2.2 },
                    PsfProfile::Kolmogorov,
                ] {
                    let found = kinds(&sheared(profile, fwhm, side));
                    assert!(found.is_empty(), "{profile:?} {fwhm} {side}: {found:?}");
                }
            }
            for fwhm in [2.4, 3.4] {
                let found = kinds(&airy(fwhm, side));
                assert!(found.is_empty(), "Airy {fwhm} {side}: {found:?}");
            }
        }
        for side in [15, 23] {
            let found = kinds(&sheared(MOFFAT, 3.4, side));
            assert!(found.is_empty(), "{side}: {found:?}");
        }
    }

    #[test]
    fn wrong_psfs_have_their_warning() {
        let good = sheared(MOFFAT, 3.4, 48);
        let peak = good.iter().copied().fold(0.0, f64::max);
        for (share, expected) in [(0.01, 1), (0.05, 1), (-0.002, 1), (0.0003, 0)] {
            let found = kinds(&(&good + share * peak));
            assert_eq!(found, vec!["psf-background"; expected], "{share}");
        }
        let slope = |y: f64| {
            let gradient = |(_, x): (usize, usize)| y * peak * (x as f64 - 23.5) / 23.5;
            &good + &Array2::from_shape_fn((48, 48), gradient)
        };
        assert_eq!(kinds(&slope(0.005)), ["psf-gradient"]);
        let tilted = slope(0.005);
        let quality = PsfQuality::from_psf((&tilted / tilted.sum()).view(), None).unwrap();
        let text = psf_warnings(&[quality], true, None)[0].to_string();
        // 0.5 % of the peak over 23.5 px.
        assert!(
            text.contains("found 0.021 % of the peak per pixel along x and 0.000 %"),
            "{text}"
        );
        assert!(kinds(&slope(0.0005)).is_empty());
        let mut delta = Array2::zeros((48, 48));
        delta[(24, 23)] = 3.0;
        assert_eq!(kinds(&delta), ["psf-narrow"]);
        for (profile, fwhm) in [(MOFFAT, 0.3), (MOFFAT, 1.0), (PsfProfile::Kolmogorov, 1.0)] {
            assert_eq!(kinds(&sheared(profile, fwhm, 48)), ["psf-narrow"], "{fwhm}");
        }
    }

    #[test]
    fn a_background_of_a_psf_states_its_m() {
        let m = |side: usize, share: f64| {
            let psf = sheared(MOFFAT, 3.4, side);
            let psf = &psf + share * psf.iter().copied().fold(0.0, f64::max);
            let found = PsfQuality::from_psf((&psf / psf.sum()).view(), None);
            found.unwrap().background_m
        };
        // Measured ones, to a factor of 1.4.
        for (share, expected) in [(0.003, -0.003), (0.01, -0.041), (0.02, -0.2), (0.05, -0.71)] {
            for side in [48, 64] {
                assert!(
                    (m(side, share) / expected).ln().abs() < 0.34,
                    "{side} {share}"
                );
            }
        }
        assert_eq!(m(48, -0.003), f64::INFINITY);
        assert!(m(32, 0.01).is_nan());
    }

    #[test]
    fn warnings_about_stamps_without_a_star_are_legible() {
        let quality =
            PsfQuality::from_psf(Array2::from_elem((48, 48), 1.0 / 2304.0).view(), None).unwrap();
        let found = psf_warnings(&[quality], true, None);
        let text: Vec<String> = found.iter().map(ToString::to_string).collect();
        assert!(
            !text.is_empty() && text.iter().all(|line| line.len() < 300),
            "{text:?}"
        );
    }

    #[test]
    fn the_noise_of_a_star_is_measured_and_only_warned_about() {
        let good = sheared(MOFFAT, 3.4, 48);
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        for snr in [20.0, 50.0, 100.0, 500.0, 3000.0] {
            for _ in 0..20 {
                let star = noisy(&good, snr, &mut rng) * 100.0;
                let Star { psf, .. } = Star::cut(star.view(), 48).unwrap();
                let quality = PsfQuality::from_psf(psf.view(), None).unwrap();
                // 370 pixels determine σ to 6 %, and Σ p² is known to 2/(S/N).
                let error = quality.snr / snr - 1.0;
                assert!(error.abs() < 0.25 + 10.0 / snr, "{quality:?}");
                let expected = vec!["psf-noise"; usize::from(snr < 1000.0)];
                assert_eq!(kinds(&star), expected, "{quality:?}");
            }
        }
    }

    #[test]
    fn undersampled_optics_are_told_from_sampled_ones() {
        // Moduli at 1, 2 and 2.6 rad/px of images that GalSim draws, the phase of their aliases, and m of the study above.
        for (low, sampled, edge, phase, m) in [
            // Roman Y106, J129, H158, F184; Euclid VIS, NISP J; Airy discs of λ/D 0.85 and 1.3 px.
            (0.603, 0.256, 0.105, -1.0, 0.032),
            (0.580, 0.238, 0.097, -1.0, 0.008),
            (0.537, 0.250, 0.132, -1.0, 0.0),
            (0.429, 0.213, 0.149, -1.0, 0.0),
            (0.568, 0.261, 0.142, -1.0, 0.0),
            (0.678, 0.342, 0.152, -1.0, 0.041),
            (0.697, 0.330, 0.136, -1.0, 0.036),
            (0.615, 0.299, 0.164, -1.0, 0.0),
            // Roman Z087; PSFs of GREAT3's multiepoch-space, and Airy discs of λ/D = 1.6 px and an obscuration of 0 and 0.1.
            (0.635, 0.298, 0.129, -1.0, 0.039),
            (0.623, 0.292, 0.138, -1.0, 0.0),
            (0.656, 0.334, 0.169, -1.0, 0.0),
            (0.694, 0.368, 0.180, -1.0, 0.0),
            (0.702, 0.375, 0.181, -1.0, 0.0),
            (0.657, 0.323, 0.157, -1.0, 0.0),
            (0.645, 0.321, 0.160, -1.0, 0.0),
            // Y106, J129, H158 and VIS on a pixel.
            (0.657, 0.440, 0.374, 1.0, 0.032),
            (0.596, 0.366, 0.348, 1.0, 0.008),
            (0.537, 0.290, 0.278, 1.0, 0.0),
            (0.568, 0.303, 0.297, 1.0, 0.0),
            // Moffat PSFs of β = 3 and FWHM 0.8, 1.0, 1.2, 1.5 px, and a Gaussian of 0.8 px.
            (0.821, 0.452, 0.214, -1.0, 0.015),
            (0.776, 0.390, 0.178, -1.0, 0.008),
            (0.637, 0.232, 0.092, -1.0, 0.001),
            (0.858, 0.620, 0.521, 1.0, 0.015),
            (0.875, 0.535, 0.264, -1.0, 0.023),
        ] {
            let (power, found) = (sampled, aliasing([low, sampled, edge], phase));
            assert_eq!(found > MAX_ALIASING, m > MAX_ALIASING, "{power}: {found}");
            // To a factor of three.
            assert!(found < 3.0 * m || m < 0.002, "{power}: {found}");
            assert!(found > m / 3.0 || m < 0.002, "{power}: {found}");
        }
    }

    #[test]
    fn odd_stamps_are_judged_before_their_shift() {
        let found = |side: usize| {
            let mut examination = Examination::new(48, 0);
            let stamp = airy(1.03, side);
            examination.add_psfs(&Psfs::star(stamp.view()), limits(48, 32, true), 1);
            examination.warnings()
        };
        for (side, sign) in [(48, 1.0), (49, -1.0), (64, 1.0), (65, -1.0)] {
            let found = found(side);
            let [Warning::PsfNarrow { effect: [m, _], .. }] = found.as_slice() else {
                panic!("{side}: {found:?}");
            };
            assert!(sign * m > 0.002, "{side}: {m}");
        }
    }

    #[test]
    fn warnings_begin_at_their_limits() {
        let good = PsfQuality {
            snr: 1e6,
            ..quality(1e6, 48)
        };
        // Literal limits, a factor of 1.2 before and beyond each of them.
        let begins = |kind: &str, shared: bool, limit: f64, of: &dyn Fn(f64) -> PsfQuality| {
            let [before, beyond] = [limit / 1.2, limit * 1.2].map(|value| {
                let found = psf_warnings(&[of(value)], shared, None);
                found.iter().any(|warning| warning.kind() == kind)
            });
            assert!(before != beyond, "{kind} {limit}");
        };
        begins("psf-background", true, 0.1, &|background| PsfQuality {
            background,
            ..good
        });
        begins("psf-gradient", true, 0.3, &|gradient| PsfQuality {
            gradient,
            ..good
        });
        begins("psf-noise", true, 1000.0, &|snr| PsfQuality { snr, ..good });
        begins("psf-noise", false, 100.0, &|snr| PsfQuality { snr, ..good });
        for of in [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]] {
            begins("psf-narrow", true, 0.002, &|aliasing| PsfQuality {
                aliasing: of.map(|share: f64| share * aliasing),
                ..good
            });
        }
        let core = |mean_square_radius| CoreSize {
            mean_square_radius,
            error: 0.0,
        };
        let broad = |ratio: f64| {
            let psf = PsfQuality {
                core: Some(core(ratio)),
                ..good
            };
            let found = psf_warnings(&[psf], true, Some(core(1.0)));
            found.iter().map(Warning::is_fatal).collect::<Vec<_>>()
        };
        assert_eq!(broad(0.8), []);
        assert_eq!(broad(0.86), [false]);
        assert_eq!(broad(0.99), [false]);
        assert_eq!(broad(1.05), [true]);
        // A tenth of the PSFs of an image.
        let of_hundred = |bad: usize| {
            let psf = |k: usize| PsfQuality {
                gradient: if k < bad { 1.0 } else { 0.0 },
                ..good
            };
            psf_warnings(&(0..100).map(psf).collect::<Vec<_>>(), false, None).len()
        };
        assert_eq!([8, 12].map(of_hundred), [0, 1]);
    }

    #[test]
    fn the_slowest_wing_is_no_background() {
        let wing = Array2::from_shape_fn((48, 48), |(y, x)| {
            let (y, x) = (y as f64 - 23.5, x as f64 - 23.5);
            (1.0 + x * x + y * y).powf(-1.25)
        });
        let background = |stamp: &Array2<f64>| {
            let psf = stamp / stamp.sum();
            PsfQuality::from_psf(psf.view(), None).unwrap().background
        };
        assert!(background(&wing).abs() < 0.02, "{}", background(&wing));
        // Light that falls more slowly is one.
        let slower = wing.mapv(|value| value.powf(0.5));
        assert!(background(&slower) > 0.2, "{}", background(&slower));
    }

    #[test]
    fn defects_of_a_psf_are_named() {
        let clean = sheared(MOFFAT, 3.4, 48);
        assert!(!kinds(&clean).contains(&"psf-defect"));
        let peak = clean.iter().copied().fold(0.0, f64::max);
        let cut = clean.mapv(|value: f64| value.min(0.55 * peak));
        assert!(kinds(&cut).contains(&"psf-defect"));
        let has_defect = |psf: &Array2<f64>| kinds(psf).contains(&"psf-defect");
        for at in [(24, 26), (22, 23), (23, 25)] {
            let mut dead = clean.clone();
            dead[at] = 0.0;
            assert!(has_defect(&dead), "{at:?}");
        }
        for at in 20..27 {
            for line in [s![at..=at, ..], s![.., at..=at]] {
                let mut dead = clean.clone();
                dead.slice_mut(line).fill(0.0);
                assert!(has_defect(&dead), "{line:?}");
            }
        }
        for (at, light) in [
            ((34, 34), 1.0),
            ((24, 36), 0.1),
            ((24, 16), 0.3),
            ((24, 28), 1.0),
        ] {
            let mut hot = clean.clone();
            hot[at] += light * peak;
            assert!(has_defect(&hot), "{at:?}");
        }
        for share in [0.7, 0.9] {
            // Four pixels, which a round PSF has, too.
            let cut = clean.mapv(|value: f64| value.min(share * peak));
            assert!(has_defect(&cut), "{share}");
        }
        for fwhm in [1.2, 2.0, 3.4, 6.0] {
            for side in [46, 48] {
                let found = kinds(&airy(fwhm, side));
                assert!(!found.contains(&"psf-defect"), "{fwhm} {side}");
            }
        }
    }

    // An Airy disc of λ/D in pixels, on a centre or a corner, with an obscuration. Pixels are integrated over 5 × 5 points: on one
    // point, a ring may have no light at all.
    fn obscured(lambda_over_d: f64, obscuration: f64, side: usize) -> Array2<f64> {
        let middle = (side as f64 - 1.0) / 2.0;
        let disc = |x: f64| 2.0 * puruspe::bessel::Jn(1, x) / x;
        let light = |x: f64, y: f64| {
            let r = (x - middle).hypot(y - middle);
            let x = (std::f64::consts::PI * r / lambda_over_d).max(1e-6);
            (disc(x) - obscuration.powi(2) * disc(obscuration * x)).powi(2)
        };
        let points = [-0.4, -0.2, 0.0, 0.2, 0.4];
        Array2::from_shape_fn((side, side), |(y, x)| {
            let row = |dy: f64| points.map(|dx| light(x as f64 + dx, y as f64 + dy));
            points.iter().flat_map(|dy| row(*dy)).sum()
        })
    }

    #[test]
    fn dark_rings_are_no_defects() {
        for lambda_over_d in [2.5, 2.8, 3.0, 3.2, 3.5, 4.0] {
            for obscuration in [0.1, 0.3, 0.5] {
                for side in [48, 49, 64, 65] {
                    let psf = obscured(lambda_over_d, obscuration, side);
                    let found = PsfQuality::from_psf((&psf / psf.sum()).view(), None).unwrap();
                    let defects = (found.dead, found.hot, found.is_cut);
                    let case = (lambda_over_d, obscuration, side);
                    assert_eq!(defects, (0, 0, false), "{case:?}");
                }
            }
        }
    }

    #[test]
    fn clean_psfs_have_no_defects() {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        for fwhm in [0.5, 1.0, 1.6, 2.4, 2.8, 3.4, 5.0, 9.0] {
            for profile in [
                MOFFAT,
                PsfProfile::Moffat { beta: 2.2 },
                PsfProfile::Kolmogorov,
            ] {
                for (e1, e2) in [
                    (0.0, 0.0),
                    (0.1, 0.0),
                    (0.3, 0.0),
                    (0.0, 0.2),
                    (-0.15, 0.05),
                ] {
                    for side in [47, 48] {
                        let psf = drawn(profile, fwhm, Shear::new(e1, e2), side);
                        let stars = [20.0, 50.0, 300.0].map(|snr| noisy(&psf, snr, &mut rng));
                        // Whole numbers have equal pixels by chance.
                        let peak = psf.iter().copied().fold(0.0, f64::max);
                        let counts = psf.mapv(|value| (200.0 * value / peak).round());
                        for star in stars.iter().chain([&psf, &counts]) {
                            let found = PsfQuality::from_psf((star / star.sum()).view(), None);
                            let PsfQuality {
                                dead, hot, is_cut, ..
                            } = found.unwrap();
                            let defects = (dead, hot, is_cut && fwhm < 5.0);
                            let case = (profile, fwhm, e1, e2, side);
                            assert_eq!(defects, (0, 0, false), "{case:?}");
                        }
                    }
                }
            }
        }
    }
}
