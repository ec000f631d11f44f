use std::path::{Path, PathBuf};

use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{ArgGroup, Args};
use shearq_challenges::{CHALLENGES, PublicChallenge, Simulated, Simulation};

use crate::arguments::{SetList, Sharding, SimulationArguments, Threads};
use crate::progress::{Bar, mark_resumable};
use crate::tell;
use shearq_dataset::layout::{DataFolder, MAX_IMAGE};
use shearq_dataset::run::SimulationRecord;
use shearq_dataset::threads::Progress;
use shearq_dataset::{fingerprint, images};
use shearq_pipeline::galaxy_fits::read_fits;
use shearq_pipeline::scenes::{SHEARS, SceneFolders, SceneRecord, simulate_scenes, write_shears};
use shearq_pipeline::simulate::simulate_images;
use shearq_simulate::fit::Fit;
use shearq_simulate::scene::{Layout, SceneSettings, SceneSimulator};
use shearq_simulate::set::SimulationSettings;

/// Write simulated images with their PSFs and true shear: sets of stamps like GREAT10's, scenes, or a branch of GREAT3.
///
/// The sets follow Table 2 of Nurbaeva et al. (2015). Sets 1 to 3 have galaxies of bulge and disc at S/N 20 and a Moffat PSF of
/// 3.4 px. The others differ by S/N 10 (4 to 6), S/N 40 (7 to 9), many S/N (10 to 12); small (13, 14), large (15, 16)
/// and many sizes (17, 18); a Kolmogorov PSF (19, 20); many bulge fractions (21, 22); displaced bulges (23, 24).
///
/// S/N is √(Σ I²)/σ of the galaxy before lensing, convolved with a round PSF. Images that the same settings made are kept, so the same
/// command resumes a stopped simulation.
///
/// With --constant-shear all galaxies have one shear. Several shears, --opposite or --rotated make a folder for each
/// version of the same galaxies, with the same noise: OUT/g1_+0.02_g2_+0 and so on, and OUT/plus and OUT/minus of scenes with a shear
/// each. --opposite-noise adds versions with the same noise of the other sign (OUT/plus_noise). `bias` recognises the pairs.
///
/// With --scenes the command writes exposures of fields whose galaxies lie anywhere and blend, to test a pipeline with its
/// detection (docs/scenes.md): OUT/scene-001.fits, …, psf.fits, truth-001.csv with all galaxies, and shears.csv for `bias --truth`. The shear
/// of a scene acts on shapes and on places. Each scene has its own, unless --constant-shear states it.
///
/// With `--challenge great3 --branch BRANCH`, the command writes a branch of GREAT3 in its layout into
/// OUT/EXPERIMENT/OBSERVATION/SHEAR, and its truth, as it was released, below OUT/truth (docs/great3.md).
/// Of images that are kept, it compares the first galaxy with the one that it would draw.
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("sheared").args(["constant_shear", "branch", "scenes"]).multiple(true))]
#[command(group = ArgGroup::new("turnable").args(["constant_shear", "scenes"]).multiple(true))]
#[command(group = ArgGroup::new("of_fits").args(["branch", "scenes"]))]
#[command(group = ArgGroup::new(OTHER_DATA).args(SCENES_REFUSE).multiple(true))]
pub(crate) struct Arguments {
    /// Sets, as `1,2,7-9` or `all`.
    #[arg(long, value_name = "LIST", required_unless_present_any = ["challenge", "scenes"])]
    sets: Option<SetList>,
    /// Images per set.
    #[arg(long, value_name = "N", required_unless_present_any = ["challenge", "scenes"], value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    images: Option<u32>,
    #[command(flatten)]
    simulation: SimulationArguments,
    #[command(flatten)]
    scene: SceneArguments,
    /// Also simulate each scene with the opposite noise, so that what is linear in the noise cancels.
    #[arg(long, requires = "scenes", conflicts_with = OTHER_DATA)]
    opposite_noise: bool,
    /// Shear of all galaxies, instead of a shear field or a shear per scene. May be given several times.
    #[arg(long, value_name = "G1,G2", allow_hyphen_values = true, value_parser = two_numbers, conflicts_with_all = ["amplitude", "tilt"])]
    constant_shear: Vec<[f64; 2]>,
    /// Also simulate the galaxies under the opposite shear, those of a branch into OUT/opposite.
    #[arg(long, requires = "sheared", conflicts_with_all = ["amplitude", "tilt"])]
    opposite: bool,
    /// Also simulate the galaxies rotated by 90 degrees, in scenes also their positions.
    #[arg(long, requires = "turnable", conflicts_with_all = ["amplitude", "tilt"])]
    rotated: bool,
    /// Simulate a branch of this challenge: great3.
    #[arg(long, value_parser = simulated(), requires = "branch", conflicts_with_all = GREAT10_ONLY)]
    challenge: Option<String>,
    /// Branch: control or multiepoch, ground or space, constant or variable, such as control-ground-constant.
    #[arg(long, value_name = "NAME", requires = "challenge", conflicts_with_all = GREAT10_ONLY, value_parser = branch)]
    branch: Option<String>,
    /// Subfields of the branch [default: 200].
    #[arg(long, value_name = "N", requires = "branch", conflicts_with_all = GREAT10_ONLY, value_parser = clap::value_parser!(u16).range(1..=1000))]
    subfields: Option<u16>,
    /// Fits to galaxies, drawn at random: a table with the columns n, r_e (half the light is within the ellipse of this long half
    /// axis, in arcsec) and q (axis ratio), and perhaps flux, bulge_r_e, bulge_q, bulge_flux (n = 4; flux 0 for none) and snr.
    #[arg(long, value_name = "FILE", requires = "of_fits", conflicts_with_all = SETS_ONLY)]
    galaxies: Option<PathBuf>,
    /// Folder to write to.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    sharding: Sharding,
    #[command(flatten)]
    threads: Threads,
}

// Exposures of fields. Without options: 3.3 arcmin a side, 75 galaxies per arcmin², seeing 0.7 arcsec.
#[derive(Debug, Args)]
pub(super) struct SceneArguments {
    /// Simulate this many scenes instead of sets.
    #[arg(long, value_name = "N", conflicts_with = OTHER_DATA, value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    pub(super) scenes: Option<u32>,
    /// Pixels a side of a scene.
    #[arg(long, value_name = "PX", requires = "scenes", conflicts_with = OTHER_DATA, default_value_t = SceneSettings::default().side)]
    side: usize,
    /// Pixels along the edges of a scene without galaxies and stars, so that shears move none across an edge.
    #[arg(long, value_name = "PX", requires = "scenes", conflicts_with = OTHER_DATA, default_value_t = SceneSettings::default().border)]
    border: usize,
    /// Arcseconds per pixel of a scene.
    #[arg(long, value_name = "ARCSEC", requires = "scenes", conflicts_with = OTHER_DATA, default_value_t = SceneSettings::default().pixel_arcsec)]
    pixel: f64,
    /// FWHM of the PSF of a scene, a Moffat profile (β = 3), in arcsec.
    #[arg(long, value_name = "ARCSEC", requires = "scenes", conflicts_with = OTHER_DATA, default_value_t = SceneSettings::default().seeing_arcsec)]
    seeing: f64,
    /// Ellipticity ε of the PSF of a scene [default: 0.03,-0.02].
    #[arg(long, value_name = "E1,E2", requires = "scenes", conflicts_with = OTHER_DATA, allow_hyphen_values = true, value_parser = two_numbers)]
    psf_shape: Option<[f64; 2]>,
    /// Change of the PSF from the middle of a scene to its edges: the share by which the FWHM grows to the right edge, and the ellipticity
    /// that is added to e1 at the right edge and to e2 at the upper one. A model like PSFEx's is written, too: model.psf.
    #[arg(long, value_name = "FWHM,E", requires = "scenes", conflicts_with = OTHER_DATA, allow_hyphen_values = true, value_parser = two_numbers)]
    psf_gradient: Option<[f64; 2]>,
    /// Galaxies per arcmin².
    #[arg(long, value_name = "N", requires = "scenes", conflicts_with = OTHER_DATA, default_value_t = SceneSettings::default().density)]
    density: f64,
    /// Least and largest S/N of galaxies, each alone [default: 3,400]. The noise of a pixel is 1.
    #[arg(long, value_name = "FAINT,BRIGHT", requires = "scenes", conflicts_with = OTHER_DATA, value_parser = two_numbers)]
    snr: Option<[f64; 2]>,
    /// Slope of the number counts per magnitude, d log₁₀ N/d mag, between these S/N.
    #[arg(long, value_name = "SLOPE", requires = "scenes", conflicts_with = OTHER_DATA, default_value_t = SceneSettings::default().counts_slope)]
    counts_slope: f64,
    /// Stars per arcmin², of S/N 50 to 2000.
    #[arg(long, value_name = "N", requires = "scenes", conflicts_with = OTHER_DATA, default_value_t = SceneSettings::default().star_density)]
    stars: f64,
    /// Exposures of each scene: scene-001.fits, and scene-001-epoch-2.fits and so on with the camera turned and moved at random.
    #[arg(long, value_name = "N", requires = "scenes", conflicts_with = OTHER_DATA, default_value_t = SceneSettings::default().epochs)]
    epochs: u32,
    /// Electrons per unit of the image, of which the light has noise, too [default: the noise is the same everywhere].
    #[arg(long, value_name = "GAIN", requires = "scenes", conflicts_with = OTHER_DATA)]
    gain: Option<f64>,
    /// Where galaxies are: `random`, or on a `hexagonal` lattice, without blends.
    #[arg(long, value_name = "LAYOUT", requires = "scenes", conflicts_with = OTHER_DATA, default_value = "random", value_parser = layout())]
    layout: Layout,
}

// Options of sets alone.
const SETS_ONLY: [&str; 6] = ["sets", "images", "amplitude", "tilt", "fixed_psf", "shard"];

/// The group of options without a meaning for scenes, of each command that simulates them.
pub(super) const OTHER_DATA: &str = "other_data";

const SCENES_REFUSE: [&str; 10] = [
    "sets",
    "images",
    "amplitude",
    "tilt",
    "fixed_psf",
    "shard",
    "grid",
    "challenge",
    "branch",
    "subfields",
];

// Options without a meaning for branches of GREAT3.
const GREAT10_ONLY: [&str; 8] = [
    "sets",
    "images",
    "amplitude",
    "tilt",
    "fixed_psf",
    "constant_shear",
    "rotated",
    "shard",
];

fn layout() -> impl TypedValueParser<Value = Layout> {
    PossibleValuesParser::new(["random", "hexagonal"]).map(|name| match name.as_str() {
        "hexagonal" => Layout::Hexagonal,
        _ => Layout::Random,
    })
}

// Names of the challenges of which branches can be simulated.
fn simulated() -> PossibleValuesParser {
    let simulated = CHALLENGES
        .iter()
        .filter(|own| !(own.simulated)().is_empty());
    PossibleValuesParser::new(simulated.map(|own| own.name))
}

fn branch(name: &str) -> Result<String, String> {
    let names: Vec<String> = CHALLENGES
        .iter()
        .flat_map(|own| (own.simulated)())
        .collect();
    match names.iter().any(|own| own == name) {
        true => Ok(name.to_owned()),
        false => Err(format!("expected one of {}", names.join(", "))),
    }
}

fn two_numbers(text: &str) -> Result<[f64; 2], String> {
    let expected = || "expected two numbers, as in `0.02,0`".to_owned();
    let (g1, g2) = text.split_once(',').ok_or_else(expected)?;
    let number = |text: &str| text.trim().parse::<f64>().map_err(|_| expected());
    Ok([number(g1)?, number(g2)?])
}

/// Constant shears of the same galaxies.
pub(super) struct Versions<'a> {
    pub settings: SimulationSettings,
    pub shears: &'a [[f64; 2]],
    /// Whether the opposite shears are wanted, too.
    pub opposite: bool,
    /// Whether all galaxies are also wanted rotated by 90 degrees.
    pub rotated: bool,
    pub out: &'a Path,
}

/// A folder per version, by whose names `bias` finds the pairs.
pub(super) fn versions(
    wanted: &Versions<'_>,
) -> anyhow::Result<Vec<(SimulationSettings, PathBuf)>> {
    let &Versions { settings, out, .. } = wanted;
    let shears = with_opposites(wanted.shears, wanted.opposite)?;
    let mut versions = Vec::new();
    for shear @ [g1, g2] in shears {
        for (rotated, ending) in [(false, ""), (true, "_rotated")] {
            if rotated && !wanted.rotated {
                continue;
            }
            let settings = SimulationSettings {
                constant_shear: Some(shear),
                rotated,
                ..settings
            };
            settings.validate()?;
            versions.push((settings, out.join(format!("g1_{g1:+}_g2_{g2:+}{ending}"))));
        }
    }
    Ok(match versions.as_slice() {
        [] => vec![(settings, out.to_owned())],
        // One version needs no folder of its own.
        [(only, _)] => vec![(*only, out.to_owned())],
        _ => versions,
    })
}

// Each shear, and after it the opposite one if it is asked for.
fn with_opposites(wanted: &[[f64; 2]], opposite: bool) -> anyhow::Result<Vec<[f64; 2]>> {
    let mut shears = Vec::new();
    for &shear in wanted {
        // Adding zero makes zero of minus zero, which would name another folder.
        let opposite = opposite.then(|| shear.map(|g| 0.0 - g));
        for [g1, g2] in std::iter::once(shear).chain(opposite) {
            anyhow::ensure!(
                !shears.contains(&[g1, g2]),
                "--constant-shear: the shear {g1}, {g2} is asked for twice"
            );
            shears.push([g1, g2]);
        }
    }
    Ok(shears)
}

/// A version of the same scenes.
struct SceneVersion {
    shear: Option<[f64; 2]>,
    opposite: bool,
    rotated: bool,
    negative_noise: bool,
    out: PathBuf,
}

// As of sets, and without a constant shear the folders plus and minus.
fn scene_versions(arguments: &Arguments) -> anyhow::Result<Vec<SceneVersion>> {
    let shears = with_opposites(&arguments.constant_shear, arguments.opposite)?;
    let mut named: Vec<(Option<[f64; 2]>, bool, String)> = shears
        .into_iter()
        .map(|[g1, g2]| (Some([g1, g2]), false, format!("g1_{g1:+}_g2_{g2:+}")))
        .collect();
    if named.is_empty() {
        // Scenes with a shear each.
        named.push((None, false, "plus".into()));
        if arguments.opposite {
            named.push((None, true, "minus".into()));
        }
    }
    let mut versions = Vec::new();
    for (shear, opposite, name) in named {
        for (rotated, negative_noise, ending) in [
            (false, false, ""),
            (true, false, "_rotated"),
            (false, true, "_noise"),
            (true, true, "_rotated_noise"),
        ] {
            let asked_for =
                (!rotated || arguments.rotated) && (!negative_noise || arguments.opposite_noise);
            if asked_for {
                versions.push(SceneVersion {
                    shear,
                    opposite,
                    rotated,
                    negative_noise,
                    out: arguments.out.join(format!("{name}{ending}")),
                });
            }
        }
    }
    if let [only] = versions.as_mut_slice() {
        // One version needs no folder of its own.
        only.out.clone_from(&arguments.out);
    }
    Ok(versions)
}

impl SceneArguments {
    pub(super) fn settings(&self, seed: u64) -> SceneSettings {
        let default = SceneSettings::default();
        SceneSettings {
            seed,
            side: self.side,
            border: self.border,
            pixel_arcsec: self.pixel,
            seeing_arcsec: self.seeing,
            psf_shape: self.psf_shape.unwrap_or(default.psf_shape),
            psf_gradient: self.psf_gradient.unwrap_or(default.psf_gradient),
            layout: self.layout,
            density: self.density,
            snr: self.snr.unwrap_or(default.snr),
            counts_slope: self.counts_slope,
            star_density: self.stars,
            epochs: self.epochs,
            gain: self.gain,
            ..default
        }
    }
}

/// The fits of a table of galaxies, and its fingerprint.
pub(super) fn fits_of(galaxies: Option<&Path>) -> anyhow::Result<(Vec<Fit>, Option<String>)> {
    let fits = galaxies.map(read_fits).transpose()?;
    let print = galaxies.map(fingerprint::of_file).transpose()?;
    Ok((fits.unwrap_or_default(), print))
}

fn run_scenes(arguments: &Arguments, scenes: u32) -> anyhow::Result<()> {
    let seed = arguments.simulation.settings()?.seed;
    let settings = arguments.scene.settings(seed);
    let (fits, galaxies) = fits_of(arguments.galaxies.as_deref())?;
    let mut simulators = Vec::new();
    for version in scene_versions(arguments)? {
        let settings = SceneSettings {
            constant_shear: version.shear,
            opposite: version.opposite,
            rotated: version.rotated,
            negative_noise: version.negative_noise,
            ..settings
        };
        simulators.push((SceneSimulator::new(settings, fits.clone())?, version.out));
    }
    let moved = simulators
        .iter()
        .map(|(own, _)| own.sheared_border())
        .fold(0.0, f64::max)
        .ceil();
    if simulators.len() > 1 && (settings.border as f64) < moved {
        tell(format_args!(
            "warning: --border is {} px, and the shear moves objects by up to {moved} px (expected a wider border): those near the edges are on the image under one of the shears only, so that pairs do not cancel their shapes. Try: --border {moved}",
            settings.border
        ));
    }
    let objects: usize = simulators.iter().map(|(own, _)| own.objects()).sum();
    let exposures = u64::from(scenes) * u64::from(settings.epochs);
    let mut bar = Bar::new("simulating", exposures * objects as u64);
    let mut made = 0;
    for (simulator, out) in &simulators {
        let record = SceneRecord {
            version: shearq_dataset::VERSION.into(),
            settings: *simulator.settings(),
            galaxies: galaxies.clone(),
        };
        let threads = arguments.threads.number();
        let folders = SceneFolders {
            images: out,
            truth: out,
        };
        made += simulate_scenes(simulator, &record, scenes, folders, threads, &mut bar)?;
    }
    drop(bar);
    let of_versions = simulators.iter().map(|(own, out)| (own, out.as_path()));
    write_shears(of_versions, scenes, &arguments.out)?;
    let all = exposures as usize * simulators.len();
    tell(format_args!(
        "{made} {} of {:.2} arcmin² simulated, {} there already, in {}; true shears in {}",
        if settings.epochs > 1 {
            "exposures"
        } else {
            "scenes"
        },
        settings.area_arcmin2(),
        all - made,
        arguments.out.display(),
        arguments.out.join(SHEARS).display()
    ));
    tell_folders(simulators.iter().map(|(_, out)| out.as_path()));
    Ok(())
}

// The names of the folders are made here, and are arguments of the next commands.
fn tell_folders<'p>(folders: impl Iterator<Item = &'p Path>) {
    let shown: Vec<String> = folders.map(|out| out.display().to_string()).collect();
    if shown.len() > 1 {
        tell(format_args!("folders: {}", shown.join(", ")));
    }
}

fn run_branch(arguments: &Arguments, challenge: &str, branch: &str) -> anyhow::Result<()> {
    let settings = arguments.simulation.settings()?;
    let simulation = Simulation {
        seed: settings.seed,
        grid: settings.grid,
        subfields: arguments.subfields.map(usize::from),
        galaxies: arguments.galaxies.as_deref(),
        opposite: arguments.opposite,
        out: &arguments.out,
    };
    let threads = arguments.threads.number();
    let start = |galaxies: u64| -> Box<dyn Progress> { Box::new(Bar::new("simulating", galaxies)) };
    let branch = PublicChallenge::named(challenge)?.branch(Some(branch))?;
    let Some(simulated) = branch.simulate(&simulation, threads, &start) else {
        anyhow::bail!("{} cannot be simulated", branch.title());
    };
    let Simulated {
        made,
        images,
        folder,
        truth,
    } = simulated?;
    tell(format_args!(
        "{made} images simulated, {} there already, in {}; truth in {}",
        images - made,
        folder.display(),
        truth.display()
    ));
    Ok(())
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    mark_resumable();
    if let (Some(challenge), Some(branch)) = (&arguments.challenge, &arguments.branch) {
        return run_branch(arguments, challenge, branch);
    }
    if let Some(scenes) = arguments.scene.scenes {
        return run_scenes(arguments, scenes);
    }
    let (Some(sets), Some(images)) = (&arguments.sets, arguments.images) else {
        anyhow::bail!("expected --sets and --images, --scenes, or --challenge and --branch");
    };
    let images = images::of_simulation(&sets.simulated()?, images);
    let images = arguments.sharding.part(&images);
    let versions = versions(&Versions {
        settings: arguments.simulation.settings()?,
        shears: &arguments.constant_shear,
        opposite: arguments.opposite,
        rotated: arguments.rotated,
        out: &arguments.out,
    })?;
    let grid = versions[0].0.grid as u64;
    let galaxies = (versions.len() * images.len()) as u64 * grid * grid;
    let mut bar = Bar::new("simulating", galaxies);
    let (mut made, mut already) = (0, 0);
    for (settings, out) in &versions {
        let record = SimulationRecord {
            version: shearq_dataset::VERSION.into(),
            settings: *settings,
        };
        let data = DataFolder::new(out);
        let threads = arguments.threads.number();
        let (new, old) = simulate_images(&record, &images, &data, &data, threads, &mut bar)?;
        made += new;
        already += old;
    }
    drop(bar);
    tell(format_args!(
        "{made} images simulated, {already} there already, in {}",
        arguments.out.display()
    ));
    tell_folders(versions.iter().map(|(_, out)| out.as_path()));
    Ok(())
}
