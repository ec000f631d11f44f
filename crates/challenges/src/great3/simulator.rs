//! Branches of a challenge like GREAT3 (Mandelbaum et al. 2014, ApJS 212, 5).
//!
//! Ranges of seeing, optics, shear and offsets are those of the organisers' public program. Unlike theirs, PSFs are ellipses:
//! a round profile behind a pupil with a central obscuration, sheared as a whole, without aberrations and struts.

use std::f64::consts::TAU;

use ndarray::Array2;
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use shearq_quantities::{FunctionalPsf, PsfProfile, PsfTransform, Pupil, Shear, TransformedPsf};
use shearq_scoring::aperture::Lattice;
use shearq_scoring::great3::{
    Branch, Experiment, Identity, NODES_PER_GALAXY, Observation, STARS_PER_SIDE,
    SUBFIELDS_PER_FIELD,
};
use shearq_scoring::modes::Decomposer;
use shearq_scoring::{Complex64, Grid, ScoringError};

use shearq_simulate::add_noise;
use shearq_simulate::field::{Content, ShearSpectrum, random_field, random_shear};
use shearq_simulate::fit::{Fit, FitComponent, axis_ratio, log_normal, rayleigh};
use shearq_simulate::galaxy::{Galaxy, GalaxyError, Sersic};
use shearq_simulate::render::{RenderScratch, Renderer};
use shearq_simulate::set::{MAX_INTRINSIC_MODULUS, NYQUIST_SHARE, stream};
use shearq_simulate::signal::power;

// Galaxies, epochs and stars are off the centres of their stamps by up to this on each axis.
const MAX_OFFSET_PX: f64 = 1.0;
// Doubled by the organisers, so that Q_v is more sensitive to m.
const SPECTRUM_AMPLITUDE: f64 = 2.0;
const SEEING_ARCSEC: (f64, f64) = (0.5, 0.85);
// λ/D in arcsec.
const GROUND_OPTICS: (f64, f64) = (0.013, 0.083);
const SPACE_OPTICS: (f64, f64) = (0.12, 0.17);
// Up to 0.5 in the challenge, where the transform of the pupil rises at medium wavenumbers. Tables of transforms only fall.
const OBSCURATIONS: (f64, f64) = (0.1, 0.3);
// FWHM of jitter and charge diffusion in space: Gaussians of 0.010″ together in the challenge, here of Kolmogorov's profile.
const SMEAR_ARCSEC: f64 = 0.025;
// |ε|² of PSFs, in the challenge of the atmosphere.
const PSF_ELLIPTICITY_SQUARED: (f64, f64) = (1e-4, 9e-4);
const PIXEL_NOISE: f32 = 1.0;

// The default galaxies. The challenge has fits to COSMOS galaxies, which are not part of this program. Chosen by hand, near their
// sizes and shapes.
const INTRINSIC_SIGMA: f64 = 0.18;
const MEDIAN_RADIUS_ARCSEC: f64 = 0.4;
const RADIUS_SCATTER: f64 = 0.35;
const RADII_ARCSEC: (f64, f64) = (0.15, 1.0);
const BULGE_AND_DISC_SHARE: f64 = 0.2;
// Indices of single components, of equal frequency.
const INDICES: [f64; 8] = [0.5, 1.0, 1.0, 1.0, 1.5, 1.5, 2.5, 4.0];
// The least S/N of the challenge, and the slope of N(> S/N) ∝ (S/N)^−1.5, that of galaxies by flux in a Euclidean universe, hence a
// density of −2.5.
const SNR: (f64, f64) = (20.0, 400.0);
const COUNT_SLOPE: f64 = 1.5;

/// The branches that can be simulated: the PSF of others varies, or their galaxies are images.
pub fn simulated_branches() -> impl Iterator<Item = Branch> {
    let simulated = [Experiment::Control, Experiment::Multiepoch];
    Branch::all().filter(move |branch| simulated.contains(&branch.experiment))
}

/// A branch and its random numbers.
#[derive(Debug)]
pub struct BranchSimulator {
    pub branch: Branch,
    pub seed: u64,
    /// Galaxies per side of a subfield.
    pub grid: usize,
    /// Whether all shears have the opposite sign; all else stays, noise included.
    pub opposite: bool,
    /// Galaxies are drawn from these; if it is empty, from the default distribution.
    fits: Vec<Fit>,
    renderer: Renderer,
}

/// Shear and intrinsic ellipticities on all nodes of a field with variable shear, and the offsets of its subfields in nodes.
struct LatticeField {
    number: usize,
    shear: Array2<Complex64>,
    intrinsic: Array2<Complex64>,
    offsets: Vec<(usize, usize)>,
}

/// One image of a subfield.
#[derive(Debug)]
pub struct Epoch {
    psf: FunctionalPsf,
    transform: PsfTransform,
    /// Offset of all galaxies in pixels.
    pub dither: (f64, f64),
}

impl Epoch {
    pub fn psf_ellipticity(&self) -> Shear {
        self.psf.shape
    }

    fn transformed(&self) -> TransformedPsf<'_> {
        self.transform
            .of(&self.psf)
            .expect("the transform was made for this PSF")
    }
}

/// What the galaxies of a subfield share, and which galaxy is where.
#[derive(Debug)]
pub struct Subfield {
    pub number: usize,
    /// Offset in its field, in nodes of the lattice.
    offset: (usize, usize),
    pub epochs: Vec<Epoch>,
    /// Shear of all galaxies, unless it varies.
    pub constant_shear: Option<Shear>,
    /// Shear and intrinsic ellipticity of each galaxy where the shear varies, row by row.
    lensing: Vec<(Shear, Shear)>,
    /// Number of the galaxy in each place; 2p and 2p + 1 are a pair.
    galaxies: Vec<usize>,
}

impl Subfield {
    /// Offset of the subfield in its field in degrees.
    pub fn offset_degrees(&self) -> (f64, f64) {
        let degrees =
            |nodes: usize| nodes as f64 * Lattice::GREAT3.field.0 / Lattice::GREAT3.side as f64;
        (degrees(self.offset.0), degrees(self.offset.1))
    }
}

/// A galaxy of a subfield, without its noise.
#[derive(Debug)]
pub struct DrawnGalaxy {
    place: usize,
    sheared: Galaxy,
    // Factor of its light that gives its S/N in all epochs together.
    scale: f64,
    offset: (f64, f64),
}

#[derive(Clone, Copy)]
enum Purpose {
    // Beyond those of GREAT10's sets, so that one seed does not repeat their galaxies.
    Shear = 32,
    Intrinsic,
    Offsets,
    Psf,
    Places,
    Galaxy,
    Noise,
    Stars,
}

impl BranchSimulator {
    /// # Errors
    /// If a fit cannot be drawn.
    pub fn new(
        branch: Branch,
        seed: u64,
        grid: usize,
        fits: Vec<Fit>,
    ) -> Result<Self, GalaxyError> {
        let simulator = BranchSimulator {
            branch,
            seed,
            grid,
            opposite: false,
            fits,
            renderer: Renderer::new(branch.stamp()),
        };
        for fit in &simulator.fits {
            fit.galaxy(branch.pixel_arcsec(), 1.0, |_| Shear::ZERO)?;
        }
        Ok(simulator)
    }

    fn stream(&self, number: usize, epoch: usize, purpose: Purpose) -> ChaCha8Rng {
        stream([self.seed, number as u64, epoch as u64, purpose as u64])
    }

    fn uniform(rng: &mut ChaCha8Rng, (from, to): (f64, f64)) -> f64 {
        rng.random_range(from..to)
    }

    fn offset(rng: &mut ChaCha8Rng) -> (f64, f64) {
        let mut px = || rng.random_range(-MAX_OFFSET_PX..MAX_OFFSET_PX);
        (px(), px())
    }

    /// All subfields with these numbers, in order.
    pub fn subfields(
        &self,
        numbers: impl Iterator<Item = usize>,
    ) -> impl Iterator<Item = Result<Subfield, ScoringError>> {
        // The field of the last subfield: twenty share it, and making it takes a second.
        let mut known: Option<LatticeField> = None;
        numbers.map(move |number| {
            if self.branch.constant {
                return Ok(self.subfield(number, None));
            }
            let field = number / SUBFIELDS_PER_FIELD;
            let lattice = match &mut known {
                Some(same) if same.number == field => same,
                other => other.insert(self.lattice(field)?),
            };
            Ok(self.subfield(number, Some(lattice)))
        })
    }

    // Shears have E modes only and intrinsic ellipticities B modes only, as in the challenge, so that shapes add little noise to E.
    fn lattice(&self, field: usize) -> Result<LatticeField, ScoringError> {
        let grid = Grid::great10(Lattice::GREAT3.side)?;
        let decomposer = Decomposer::new(grid);
        let spectrum = ShearSpectrum {
            amplitude: SPECTRUM_AMPLITUDE,
            ..ShearSpectrum::default()
        };
        let mut rng = self.stream(field, 0, Purpose::Shear);
        let shear = random_field(&decomposer, &mut rng, Content::EOnly, |l| spectrum.c_l(l));
        let cell = (grid.side().0 / grid.n as f64).powi(2);
        let white = 2.0 * INTRINSIC_SIGMA.powi(2) * cell / NYQUIST_SHARE;
        let mut rng = self.stream(field, 0, Purpose::Intrinsic);
        let mut intrinsic = random_field(&decomposer, &mut rng, Content::BOnly, |_| white);
        intrinsic.mapv_inplace(|e| e * (MAX_INTRINSIC_MODULUS / e.norm()).min(1.0));
        Ok(LatticeField {
            number: field,
            shear,
            intrinsic,
            offsets: self.offsets(field),
        })
    }

    // The first subfield lies on the nodes from 0, the others on random ones between its galaxies.
    fn offsets(&self, field: usize) -> Vec<(usize, usize)> {
        let all = 1..NODES_PER_GALAXY * NODES_PER_GALAXY;
        let mut offsets: Vec<_> = all
            .map(|k| (k % NODES_PER_GALAXY, k / NODES_PER_GALAXY))
            .collect();
        offsets.shuffle(&mut self.stream(field, 0, Purpose::Offsets));
        offsets.insert(0, (0, 0));
        offsets
    }

    fn subfield(&self, number: usize, of: Option<&LatticeField>) -> Subfield {
        let cells = self.grid * self.grid;
        let mut galaxies: Vec<usize> = (0..cells).collect();
        let mut lensing = Vec::new();
        let mut constant_shear = None;
        let mut offset = (0, 0);
        // In variable branches all subfields of a field have one PSF.
        let mut of_psf = number;
        if let Some(field) = of {
            offset = field.offsets[number % SUBFIELDS_PER_FIELD];
            of_psf = field.number;
            let shear = |e: Complex64| Shear::new(e.re, e.im);
            lensing = (0..cells)
                .map(|place| {
                    let node = self.node(offset, (place % self.grid, place / self.grid));
                    let g = field.shear[node];
                    let g = if self.opposite { -g } else { g };
                    (shear(g), shear(field.intrinsic[node]))
                })
                .collect();
        } else {
            let mut rng = self.stream(number, 0, Purpose::Shear);
            let g = random_shear(&mut rng);
            let g = if self.opposite { -g } else { g };
            constant_shear = Some(Shear::new(g.re, g.im));
            galaxies.shuffle(&mut self.stream(number, 0, Purpose::Places));
        }
        let epochs = (0..self.branch.epochs()).map(|epoch| {
            let mut rng = self.stream(of_psf, epoch, Purpose::Psf);
            self.epoch(&mut rng)
        });
        Subfield {
            number,
            offset,
            epochs: epochs.collect(),
            constant_shear,
            lensing,
            galaxies,
        }
    }

    fn epoch(&self, rng: &mut ChaCha8Rng) -> Epoch {
        let (optics, arcsec) = if self.branch.observation == Observation::Space {
            (SPACE_OPTICS, SMEAR_ARCSEC)
        } else {
            // Frequencies fall from 20 at the best seeing to 9 at the worst: the root of 20x − 5.5x² = 14.5u.
            let u: f64 = rng.random();
            let x = (20.0 - (400.0 - 22.0 * 14.5 * u).sqrt()) / 11.0;
            let (best, worst) = SEEING_ARCSEC;
            (GROUND_OPTICS, best + x * (worst - best))
        };
        let pupil = Pupil {
            lambda_over_diameter: Self::uniform(rng, optics) / arcsec,
            obscuration: Self::uniform(rng, OBSCURATIONS),
        };
        let modulus = Self::uniform(rng, PSF_ELLIPTICITY_SQUARED).sqrt();
        let e = Complex64::from_polar(modulus, rng.random_range(0.0..TAU));
        let profile = PsfProfile::Kolmogorov;
        let fwhm = arcsec / self.branch.pixel_arcsec();
        let dither = match self.branch.epochs() {
            1 => (0.0, 0.0),
            _ => Self::offset(rng),
        };
        Epoch {
            psf: FunctionalPsf::new(profile, fwhm, Shear::new(e.re, e.im))
                .expect("widths and ellipticities drawn here are within range"),
            transform: PsfTransform::behind(profile, pupil).expect("Kolmogorov is a valid profile"),
            dither,
        }
    }

    fn node(&self, offset: (usize, usize), (ix, iy): (usize, usize)) -> (usize, usize) {
        (
            NODES_PER_GALAXY * ix + offset.0,
            NODES_PER_GALAXY * iy + offset.1,
        )
    }

    /// The pixel (x, y) that the challenge calls the centre of a stamp, and the identity SSSXXXYYY.
    pub fn place(&self, subfield: &Subfield, (ix, iy): (usize, usize)) -> ([i64; 2], i64) {
        let centre = |k: usize| (k * self.branch.stamp() + self.branch.stamp() / 2 - 1) as i64;
        let place = match self.branch.constant {
            true => (ix, iy),
            false => self.node(subfield.offset, (ix, iy)),
        };
        let id = Identity::new(subfield.number, place);
        ([centre(ix), centre(iy)], id.number())
    }

    /// True shear and intrinsic ellipticity of a galaxy.
    pub fn truth(&self, subfield: &Subfield, (ix, iy): (usize, usize)) -> (Shear, Shear) {
        let place = iy * self.grid + ix;
        match subfield.constant_shear {
            None => subfield.lensing[place],
            Some(shear) => {
                let (fit, direction, _) = self.draw_fit(subfield, place);
                let e = direction * fit.main.modulus();
                (shear, Shear::new(e.re, e.im))
            }
        }
    }

    // The fit of a galaxy, the direction of its long axis as a unit ellipticity, and its S/N.
    fn draw_fit(&self, subfield: &Subfield, place: usize) -> (Fit, Complex64, f64) {
        let galaxy = subfield.galaxies[place];
        let mut rng = self.stream(subfield.number, 0, Purpose::Galaxy);
        // Two galaxies of a pair are one, turned by 90 degrees. Variable branches have no pairs.
        let (kind, turned) = match self.branch.constant {
            false => (galaxy, false),
            true => (galaxy / 2, galaxy % 2 == 1),
        };
        rng.set_stream(kind as u64);
        let snr = SNR.0 * (1.0 - rng.random::<f64>()).powf(-1.0 / COUNT_SLOPE);
        let angle = rng.random_range(0.0..TAU);
        let fit = match self.fits.len() {
            0 => default_fit(&mut rng),
            count => self.fits[rng.random_range(0..count)],
        };
        let direction = Complex64::from_polar(if turned { -1.0 } else { 1.0 }, angle);
        (fit, direction, fit.snr.unwrap_or(snr.min(SNR.1)))
    }

    /// The galaxy in a place.
    pub fn galaxy_at(&self, subfield: &Subfield, (ix, iy): (usize, usize)) -> DrawnGalaxy {
        let place = iy * self.grid + ix;
        let (fit, direction, snr) = self.draw_fit(subfield, place);
        let known = subfield.lensing.get(place);
        let intrinsic = |own: &FitComponent| {
            let e = direction * own.modulus();
            known.map_or(Shear::new(e.re, e.im), |(_, intrinsic)| *intrinsic)
        };
        let drawn = |shear| {
            fit.galaxy(self.branch.pixel_arcsec(), 1.0, |own| {
                intrinsic(own).sheared_by(shear)
            })
            .expect("fits were checked, and ellipticities drawn here are within range")
        };
        // S/N is defined before lensing, so that a cut by it does not select by shear.
        let unlensed = drawn(Shear::ZERO);
        let powers = subfield
            .epochs
            .iter()
            .map(|epoch| power(&unlensed, &epoch.transformed()));
        // Galaxies of a pair have offsets and noise of their own.
        let mut rng = self.stream(subfield.number, 0, Purpose::Noise);
        rng.set_stream(place as u64);
        DrawnGalaxy {
            place,
            sheared: drawn(match subfield.constant_shear {
                Some(shear) => shear,
                None => subfield.lensing[place].0,
            }),
            scale: snr / powers.sum::<f64>().sqrt(),
            offset: Self::offset(&mut rng),
        }
    }

    /// Draws a galaxy with its noise into `out`, a stamp in row-major order.
    pub fn draw(
        &self,
        subfield: &Subfield,
        epoch: usize,
        galaxy: &DrawnGalaxy,
        scratch: &mut RenderScratch,
        out: &mut [f32],
    ) {
        let own = &subfield.epochs[epoch];
        let centre = self.centre(galaxy.offset, own.dither);
        self.renderer
            .render(&galaxy.sheared, &own.transformed(), centre, scratch, out);
        let mut rng = self.stream(subfield.number, epoch + 1, Purpose::Noise);
        rng.set_stream(galaxy.place as u64);
        add_noise(&mut rng, galaxy.scale as f32, PIXEL_NOISE, out);
    }

    fn centre(&self, offset: (f64, f64), dither: (f64, f64)) -> (f64, f64) {
        let middle = (self.branch.stamp() as f64 - 1.0) / 2.0;
        (middle + offset.0 + dither.0, middle + offset.1 + dither.1)
    }

    /// The image of stars without noise, row-major. The one at the lower left is in the middle of its stamp, the others are off it.
    pub fn stars(
        &self,
        subfield: &Subfield,
        epoch: usize,
        scratch: &mut RenderScratch,
    ) -> Vec<f32> {
        let size = self.branch.stamp();
        let mut rng = self.stream(subfield.number, epoch, Purpose::Stars);
        let point = Galaxy::point(1.0).expect("a valid flux");
        let mut stamp = vec![0.0; size * size];
        let mut image = vec![0.0; (STARS_PER_SIDE * size).pow(2)];
        for k in 0..STARS_PER_SIDE * STARS_PER_SIDE {
            let offset = match k {
                0 => (0.0, 0.0),
                _ => Self::offset(&mut rng),
            };
            let psf = subfield.epochs[epoch].transformed();
            let centre = self.centre(offset, (0.0, 0.0));
            self.renderer
                .render(&point, &psf, centre, scratch, &mut stamp);
            for (y, line) in stamp.chunks_exact(size).enumerate() {
                let start =
                    ((k / STARS_PER_SIDE * size + y) * STARS_PER_SIDE + k % STARS_PER_SIDE) * size;
                image[start..][..size].copy_from_slice(line);
            }
        }
        image
    }
}

fn default_fit(rng: &mut ChaCha8Rng) -> Fit {
    let e = rayleigh(rng, INTRINSIC_SIGMA, MAX_INTRINSIC_MODULUS);
    let component = |profile, half_light_arcsec, flux| FitComponent {
        profile,
        half_light_arcsec,
        flux,
        axis_ratio: axis_ratio(e),
    };
    let size = log_normal(rng, MEDIAN_RADIUS_ARCSEC, RADIUS_SCATTER, RADII_ARCSEC);
    if rng.random::<f64>() < BULGE_AND_DISC_SHARE {
        let share = rng.random_range(0.1..0.7);
        let bulge = size * rng.random_range(0.3..0.6);
        return Fit {
            main: component(Sersic::Exponential, size, 1.0 - share),
            bulge: Some(component(Sersic::DeVaucouleurs, bulge, share)),
            snr: None,
        };
    }
    let index = INDICES[rng.random_range(0..INDICES.len())];
    Fit {
        main: component(Sersic::nearest(index), size, 1.0),
        bulge: None,
        snr: None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn simulator(name: &str, grid: usize) -> BranchSimulator {
        BranchSimulator::new(Branch::named(name).unwrap(), 5, grid, Vec::new()).unwrap()
    }

    fn subfield(simulator: &BranchSimulator, number: usize) -> Subfield {
        simulator
            .subfields(number..number + 1)
            .next()
            .unwrap()
            .unwrap()
    }

    // Flux, centroid and S/N of what a stamp has without its noise, which the difference of two scales takes away.
    fn moments(image: &[f32], size: usize) -> [f64; 3] {
        let mut sums = [0.0; 3];
        for (k, value) in image.iter().enumerate() {
            let terms = [1.0, (k % size) as f64, (k / size) as f64];
            for (sum, term) in sums.iter_mut().zip(terms) {
                *sum += f64::from(*value) * term;
            }
        }
        [sums[0], sums[1] / sums[0], sums[2] / sums[0]]
    }

    #[test]
    fn pairs_cancel_intrinsic_shapes() {
        let simulator = simulator("control-ground-constant", 6);
        let subfield = subfield(&simulator, 3);
        let mut by_galaxy = vec![Shear::ZERO; 36];
        let mut shears = Vec::new();
        for place in 0..36 {
            let (g, e) = simulator.truth(&subfield, (place % 6, place / 6));
            by_galaxy[subfield.galaxies[place]] = e;
            shears.push(g);
        }
        for pair in by_galaxy.chunks_exact(2) {
            assert!((pair[0].e1 + pair[1].e1).abs() < 1e-12 && pair[0].modulus() > 0.0);
            assert!((pair[0].e2 + pair[1].e2).abs() < 1e-12);
        }
        assert!(shears.iter().all(|g| *g == shears[0]));
        assert!((0.01..0.05).contains(&shears[0].modulus()));
    }

    #[test]
    fn only_the_star_at_the_lower_left_is_centred() {
        for branch in simulated_branches() {
            let name = branch.to_string();
            let simulator = simulator(&name, 2);
            let size = simulator.branch.stamp();
            let subfield = subfield(&simulator, 0);
            let image = simulator.stars(&subfield, 0, &mut RenderScratch::new());
            let mut off = 0;
            for k in 0..9 {
                let rows = (0..size).flat_map(|y| {
                    let start = ((k / 3 * size + y) * 3 + k % 3) * size;
                    image[start..start + size].iter().copied()
                });
                let [flux, x, y] = moments(&rows.collect::<Vec<f32>>(), size);
                let middle = (size as f64 - 1.0) / 2.0;
                assert!((0.97..1.001).contains(&flux), "{name} {k}: {flux}");
                let distance = (x - middle).hypot(y - middle);
                off += usize::from(distance > 0.05);
                assert!(k > 0 || distance < 1e-3, "{name}: {x} {y}");
            }
            assert_eq!(off, 8, "{name}");
        }
    }

    #[test]
    fn epochs_share_a_galaxy_of_one_signal_to_noise() {
        let name = "multiepoch-ground-constant";
        let simulator = simulator(name, 2);
        let subfield = subfield(&simulator, 1);
        assert_eq!(subfield.epochs.len(), 6);
        let (fit, _, snr) = simulator.draw_fit(&subfield, 0);
        let galaxy = simulator.galaxy_at(&subfield, (0, 0));
        let (mut squares, mut scratch) = (0.0, RenderScratch::new());
        for epoch in 0..6 {
            let mut stamp = vec![0.0; 48 * 48];
            simulator.draw(&subfield, epoch, &galaxy, &mut scratch, &mut stamp);
            squares += stamp.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>() - 48.0 * 48.0;
        }
        // Σ (I + n)² scatters by √(2·6·2304 + 4 S/N²).
        let scatter = (2.0 * 6.0 * 2304.0 + 4.0 * snr * snr).sqrt();
        let light = snr * snr;
        assert!(
            (squares - light).abs() < 4.0 * scatter + 0.1 * light,
            "{squares} {light} {fit:?}"
        );
    }

    #[test]
    fn variable_branches_lie_on_one_lattice() {
        let simulator = simulator("control-ground-variable", 4);
        let all: Vec<_> = simulator.subfields(18..22).map(Result::unwrap).collect();
        // Two fields: PSFs differ, offsets do not repeat.
        assert_eq!(all[0].epochs[0].psf, all[1].epochs[0].psf);
        assert_ne!(all[1].epochs[0].psf, all[2].epochs[0].psf);
        assert_ne!(all[0].offset, all[1].offset);
        assert_eq!(all[2].offset, (0, 0));
        let (_, id) = simulator.place(&all[0], (3, 1));
        let (x, y) = all[0].offset;
        assert_eq!(id as usize, 18_000_000 + 1000 * (21 + x) + 7 + y);
        let (g, e) = simulator.truth(&all[0], (3, 1));
        assert!(
            g.modulus() > 0.0 && g.modulus() < 0.2 && e.modulus() > 0.0,
            "{g:?} {e:?}"
        );
    }
}
