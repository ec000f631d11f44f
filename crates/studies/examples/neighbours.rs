//! The bias m of galaxies that have one neighbour, by its distance and flux.
//!
//! `cargo run --release -p shearq-studies --example neighbours -- SCENES SEED SNR` prints a table in Markdown. m is less that of the same galaxies without their neighbours. Galaxies and neighbours are a bulge and a disc with half-light radii of 2.5 to 5 px, behind
//! a Moffat PSF with a FWHM of 3.4 px. The shear is (γ, γ) and (−γ, −γ) with γ = 0.02. Each scene is measured in eight
//! versions: both shears, turned by 90 degrees or not, and both signs of the noise. Only the galaxy is sheared, or the
//! whole scene about the galaxy.
#![expect(clippy::print_stdout, reason = "an example shows what it finds")]

use std::error::Error;
use std::f64::consts::{PI, TAU};

use ndarray::{Array2, Array3, ArrayView2};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_measure::{
    ArraySource, KnownNoise, Measurement, Measurer, OneThread, PsfWorker, Psfs, Session,
};
use shearq_quantities::{FunctionalPsf, PsfProfile, PsfTransform, Shear, TransformedPsf};
use shearq_simulate::galaxy::Galaxy;
use shearq_simulate::render::{RenderScratch, Renderer};

// Pixels on a side of a stamp.
const SIDE: usize = 48;
// Shear of each component, of either sign.
const SHEAR: f64 = 0.02;
// Distances of the neighbour in pixels.
const DISTANCES: [[f64; 2]; 6] = [
    [5.0, 7.0],
    [7.0, 10.0],
    [10.0, 13.0],
    [13.0, 16.0],
    [16.0, 20.0],
    [20.0, 24.0],
];
// Fluxes of the neighbour in units of the galaxy's.
const RATIOS: [[f64; 2]; 2] = [[0.3, 1.0], [1.0, 3.0]];
// Groups of scenes that the errors come from.
const GROUPS: usize = 20;

#[derive(Clone, Copy)]
struct Profile {
    shape: Shear,
    radius: f64,
    bulge: f64,
}

impl Profile {
    fn drawn(rng: &mut ChaCha8Rng) -> Self {
        let modulus: f64 = 0.14 * (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
        let angle = rng.random_range(0.0..TAU);
        let modulus = modulus.min(0.6);
        Profile {
            shape: Shear::new(modulus * angle.cos(), modulus * angle.sin()),
            radius: rng.random_range(2.5..5.0),
            bulge: rng.random_range(0.0..1.0),
        }
    }

    // With a flux of 1, turned by 90 degrees or not, and sheared.
    fn galaxy(self, turned: bool, shear: f64) -> Result<Galaxy, Box<dyn Error>> {
        let side = if turned { -1.0 } else { 1.0 };
        let shape = Shear::new(side * self.shape.e1, side * self.shape.e2);
        let shape = shape.sheared_by(Shear::new(shear, shear));
        let radii = [0.6 * self.radius, 1.25 * self.radius];
        Ok(Galaxy::bulge_and_disc(
            1.0, self.bulge, radii[0], radii[1], shape,
        )?)
    }
}

struct Drawing<'a> {
    renderer: Renderer,
    psf: TransformedPsf<'a>,
    scratch: RenderScratch,
    // S/N of the galaxies, in noise of level 1.
    snr: f64,
}

impl Drawing<'_> {
    fn draw(&mut self, galaxy: &Galaxy, [x, y]: [f64; 2]) -> Array2<f32> {
        let mut out = vec![0.0; SIDE * SIDE];
        let middle = (SIDE as f64 - 1.0) / 2.0;
        let centre = (middle + x, middle + y);
        self.renderer
            .render(galaxy, &self.psf, centre, &mut self.scratch, &mut out);
        Array2::from_shape_vec((SIDE, SIDE), out).expect("as long as a stamp")
    }

    // A galaxy at `place`: `[turned][sign of the shear]`, and its flux.
    fn central(
        &mut self,
        profile: Profile,
        place: [f64; 2],
    ) -> Result<(Stamps, f32), Box<dyn Error>> {
        let mut stamps = self.all(|_, _| place, profile, true)?;
        let squares: f32 = stamps.iter().flatten().flatten().map(|v| v * v).sum();
        let flux = self.snr as f32 / (squares / 4.0).sqrt();
        for stamp in stamps.iter_mut().flatten() {
            *stamp *= flux;
        }
        Ok((stamps, flux))
    }

    fn all(
        &mut self,
        place: impl Fn(bool, f64) -> [f64; 2],
        profile: Profile,
        sheared: bool,
    ) -> Result<Stamps, Box<dyn Error>> {
        let mut one = |turned: bool, sign: f64| -> Result<_, Box<dyn Error>> {
            let shear = if sheared { sign * SHEAR } else { 0.0 };
            Ok(self.draw(&profile.galaxy(turned, shear)?, place(turned, shear)))
        };
        Ok([
            [one(false, 1.0)?, one(false, -1.0)?],
            [one(true, 1.0)?, one(true, -1.0)?],
        ])
    }
}

// Stamps `[turned][sign of the shear]`.
type Stamps = [[Array2<f32>; 2]; 2];

#[derive(Clone, Copy)]
struct Away {
    distance: f64,
    angle: f64,
}

impl Away {
    // Its place if the galaxy is at `galaxy`, turned by 90 degrees or not, under a shear about the galaxy.
    fn place(self, galaxy: [f64; 2], turned: bool, shear: f64) -> [f64; 2] {
        let angle = self.angle + if turned { PI / 2.0 } else { 0.0 };
        let [x, y] = [self.distance * angle.cos(), self.distance * angle.sin()];
        let [[a, b], [c, d]] = Shear::new(shear, shear).matrix();
        [galaxy[0] + a * x + b * y, galaxy[1] + c * x + d * y]
    }
}

// A scene's versions `[sign of the shear][version]`.
type Scene = [[Measurement; 4]; 2];

// Sums of one component over scenes.
#[derive(Clone, Copy, Default)]
struct Sums {
    e: [f64; 2],
    count: [f64; 2],
    response: f64,
}

impl Sums {
    fn of(scene: &Scene, k: usize) -> Self {
        let mut sums = Sums::default();
        for (side, versions) in scene.iter().enumerate() {
            for galaxy in versions.iter().filter(|g| g.flags.is_empty()) {
                sums.e[side] += [galaxy.e1, galaxy.e2][k];
                sums.count[side] += 1.0;
                sums.response += galaxy.response.map_or(f64::NAN, |r| r[k][k]);
            }
        }
        sums
    }

    fn add(&mut self, other: Sums, sign: f64) {
        for side in 0..2 {
            self.e[side] += sign * other.e[side];
            self.count[side] += sign * other.count[side];
        }
        self.response += sign * other.response;
    }

    fn bias(self) -> f64 {
        let response = self.response / (self.count[0] + self.count[1]);
        let means = [0, 1].map(|side| self.e[side] / self.count[side]);
        (means[0] - means[1]) / (2.0 * SHEAR) / response - 1.0
    }
}

// m of components less that without a neighbour, and its error: a jackknife over groups of scenes.
fn bias(scenes: &[Scene], alone: &[Scene], components: &[usize]) -> (f64, f64) {
    let mut groups = [[Sums::default(); 2]; GROUPS];
    for (at, (scene, without)) in scenes.iter().zip(alone).enumerate() {
        for &k in components {
            groups[at % GROUPS][0].add(Sums::of(scene, k), 1.0);
            groups[at % GROUPS][1].add(Sums::of(without, k), 1.0);
        }
    }
    let mut all = [Sums::default(); 2];
    for group in groups {
        all[0].add(group[0], 1.0);
        all[1].add(group[1], 1.0);
    }
    let left_out = groups.map(|group| {
        let mut rest = all;
        rest[0].add(group[0], -1.0);
        rest[1].add(group[1], -1.0);
        rest[0].bias() - rest[1].bias()
    });
    let mean = left_out.iter().sum::<f64>() / GROUPS as f64;
    let squares: f64 = left_out.iter().map(|v| (v - mean) * (v - mean)).sum();
    let error = (squares * (GROUPS as f64 - 1.0) / GROUPS as f64).sqrt();
    (all[0].bias() - all[1].bias(), error)
}

fn measured(
    worker: &mut PsfWorker<'_>,
    galaxy: &Stamps,
    neighbour: Option<(&Stamps, f32)>,
    noise: ArrayView2<'_, f32>,
) -> Result<Scene, Box<dyn Error>> {
    let mut one = |sign: usize, version: usize| -> Result<_, Box<dyn Error>> {
        let turned = version / 2;
        let side = [1.0f32, -1.0][version % 2];
        let mut stamp = &galaxy[turned][sign] + &(&noise * side);
        if let Some((stamps, flux)) = neighbour {
            stamp.scaled_add(flux, &stamps[turned][sign]);
        }
        Ok(worker.measure(stamp.view())?)
    };
    let mut side = |sign: usize| -> Result<[Measurement; 4], Box<dyn Error>> {
        Ok([one(sign, 0)?, one(sign, 1)?, one(sign, 2)?, one(sign, 3)?])
    };
    Ok([side(0)?, side(1)?])
}

fn print(case: &str, scenes: &[Scene], alone: &[Scene]) {
    let [(m1, error1), (m2, error2)] = [0, 1].map(|k| bias(scenes, alone, &[k]));
    let (m1, m2, error) = (1e3 * m1, 1e3 * m2, 1e3 * error1.max(error2));
    // A neighbour along an axis raises the response of one component and lowers that of the other, about which their mean does not
    // scatter.
    let (mean, mean_error) = bias(scenes, alone, &[0, 1]);
    let (mean, mean_error) = (1e3 * mean, 1e3 * mean_error);
    let versions = scenes.iter().flatten().flatten();
    let lost = versions.filter(|g| !g.flags.is_empty()).count();
    println!(
        "| {case} | {m1:+.1}, {m2:+.1} ± {error:.1} | {mean:+.1} ± {mean_error:.1} | {lost} |"
    );
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scenes, seed, snr] = arguments.as_slice() else {
        return Err("expected SCENES SEED SNR".into());
    };
    let (scenes, seed): (usize, u64) = (scenes.parse()?, seed.parse()?);
    let profile = PsfProfile::Moffat { beta: 3.0 };
    let transform = PsfTransform::new(profile)?;
    let psf = FunctionalPsf::new(profile, 3.4, Shear::new(0.03, -0.02))?;
    let mut drawing = Drawing {
        renderer: Renderer::new(SIDE),
        psf: transform.of(&psf)?,
        scratch: RenderScratch::new(),
        snr: snr.parse()?,
    };
    let mut bins = vec![Vec::<Scene>::new(); 1 + 2 * DISTANCES.len() * RATIOS.len()];

    let measurer = Measurer::named("48/linear/star", SIDE)?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let noise = |rng: &mut ChaCha8Rng| {
        Array2::from_shape_simple_fn((SIDE, SIDE), || {
            let value: f32 = StandardNormal.sample(rng);
            value
        })
    };
    let place = |rng: &mut ChaCha8Rng| [rng.random_range(-0.5..0.5), rng.random_range(-0.5..0.5)];
    // The size of the population, which the window is adapted to.
    let mut survey = Array3::<f32>::zeros((200, SIDE, SIDE));
    for mut stamp in survey.outer_iter_mut() {
        let at = place(&mut rng);
        let (stamps, _) = drawing.central(Profile::drawn(&mut rng), at)?;
        stamp.assign(&(&stamps[0][0] + &noise(&mut rng)));
    }
    let cut = measurer.configuration().psf_cut();
    let star = shearq_measure::Star::cut(psf.stamp(SIDE).view(), cut)?;
    let psfs = Psfs::prepared(star.psf.view());
    let mut source = ArraySource::new(&measurer, survey.view(), &psfs)?;
    let session = Session::open(&measurer, &mut source, KnownNoise::Stated(1.0), &OneThread)?;
    let mut worker = measurer.worker();
    let mut image = session.image(&mut worker);
    let mut worker = image.psf(star.psf.view())?;

    for _ in 0..scenes {
        let at = place(&mut rng);
        let (galaxy, flux) = drawing.central(Profile::drawn(&mut rng), at)?;
        let noise = noise(&mut rng);
        bins[0].push(measured(&mut worker, &galaxy, None, noise.view())?);
        let mut bin = 1;
        for range in DISTANCES {
            let profile = Profile::drawn(&mut rng);
            let away = Away {
                distance: rng.random_range(range[0]..range[1]),
                angle: rng.random_range(0.0..TAU),
            };
            let share: f64 = rng.random_range(0.0..1.0);
            for sheared in [false, true] {
                let here = |turned: bool, shear: f64| away.place(at, turned, shear);
                let stamps = drawing.all(here, profile, sheared)?;
                for ratio in RATIOS {
                    let light = flux * (ratio[0] * (ratio[1] / ratio[0]).powf(share)) as f32;
                    let neighbour = Some((&stamps, light));
                    let found = measured(&mut worker, &galaxy, neighbour, noise.view())?;
                    bins[bin].push(found);
                    bin += 1;
                }
            }
        }
    }

    println!("| neighbour at (px) | sheared | flux ratio | m1, m2 (10⁻³) | their mean | flagged |");
    println!("|---|---|---|---|---|---|");
    let mut rest = bins[1..].iter();
    for [near, far] in DISTANCES {
        for sheared in ["no", "yes"] {
            for [faint, bright] in RATIOS {
                let scenes = rest.next().expect("scenes of each kind");
                let case = format!("{near} to {far} | {sheared} | {faint} to {bright}");
                print(&case, scenes, &bins[0]);
            }
        }
    }
    Ok(())
}
