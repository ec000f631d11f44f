use std::path::{Path, PathBuf};

use clap::builder::PossibleValuesParser;
use clap::{ArgGroup, Args};
use shearq_challenges::{CHALLENGES, PublicChallenge, Simulated, Simulation};

use crate::arguments::{SetList, Sharding, SimulationArguments, Threads};
use crate::progress::{Bar, mark_resumable};
use crate::tell;
use shearq_dataset::images;
use shearq_dataset::layout::{DataFolder, MAX_IMAGE};
use shearq_dataset::run::SimulationRecord;
use shearq_dataset::threads::Progress;
use shearq_pipeline::simulate::simulate_folder;
use shearq_simulate::set::SimulationSettings;

/// Write simulated GREAT10-like sets: images, PSFs, true shear and intrinsic shapes.
///
/// The sets follow Table 2 of the paper. Sets 1 to 3 have galaxies of bulge and disc at S/N 20 and a Moffat PSF of
/// 3.4 px. The others differ by S/N 10 (4 to 6), S/N 40 (7 to 9), many S/N (10 to 12); small (13, 14), large (15, 16)
/// and many sizes (17, 18); a Kolmogorov PSF (19, 20); many bulge fractions (21, 22); displaced bulges (23, 24).
///
/// S/N is √(Σ I²)/σ before lensing and behind a round PSF. Images that the same settings made are kept, so the same
/// command resumes a stopped simulation.
///
/// With --constant-shear all galaxies have one shear. Several shears, --opposite or --rotated make a folder for each
/// version of the same galaxies, with the same noise: OUT/g1_+0.02_g2_+0 and so on. `bias` recognises the pairs.
///
/// With `--challenge great3 --branch BRANCH`, the command writes a branch of GREAT3 in its layout into
/// OUT/EXPERIMENT/OBSERVATION/SHEAR, and its truth, as it was released, below OUT/truth (docs/great3.md).
/// Of images that are kept, it compares the first galaxy with the one that it would draw.
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("sheared").args(["constant_shear", "branch"]))]
pub(crate) struct Arguments {
    /// Sets, as `1,2,7-9` or `all`.
    #[arg(long, value_name = "LIST", required_unless_present = "challenge")]
    sets: Option<SetList>,
    /// Images per set.
    #[arg(long, value_name = "N", required_unless_present = "challenge", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    images: Option<u32>,
    #[command(flatten)]
    simulation: SimulationArguments,
    /// Shear of all galaxies, instead of a shear field. May be given several times.
    #[arg(long, value_name = "G1,G2", allow_hyphen_values = true, value_parser = parse_shear, conflicts_with_all = ["amplitude", "tilt"])]
    constant_shear: Vec<[f64; 2]>,
    /// Also simulate the galaxies under the opposite shear, those of a branch into OUT/opposite.
    #[arg(long, requires = "sheared", conflicts_with_all = ["amplitude", "tilt"])]
    opposite: bool,
    /// Also simulate the galaxies rotated by 90 degrees.
    #[arg(long, requires = "constant_shear", conflicts_with_all = ["amplitude", "tilt"])]
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
    #[arg(long, value_name = "FILE", requires = "branch", conflicts_with_all = GREAT10_ONLY)]
    galaxies: Option<PathBuf>,
    /// Folder to write to.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    sharding: Sharding,
    #[command(flatten)]
    threads: Threads,
}

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

fn parse_shear(text: &str) -> Result<[f64; 2], String> {
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
    let mut shears = Vec::new();
    for &shear in wanted.shears {
        // Adding zero makes zero of minus zero, which would name another folder.
        let opposite = wanted.opposite.then(|| shear.map(|g| 0.0 - g));
        for [g1, g2] in std::iter::once(shear).chain(opposite) {
            anyhow::ensure!(
                !shears.contains(&[g1, g2]),
                "--constant-shear: the shear {g1}, {g2} is asked for twice"
            );
            shears.push([g1, g2]);
        }
    }
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
    let (Some(sets), Some(images)) = (&arguments.sets, arguments.images) else {
        anyhow::bail!("expected --sets and --images, or --challenge and --branch");
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
        let (new, old) = simulate_folder(&record, &images, &data, threads, &mut bar)?;
        made += new;
        already += old;
    }
    drop(bar);
    tell(format_args!(
        "{made} images simulated, {already} there already, in {}",
        arguments.out.display()
    ));
    // The names of the folders are made here, and are arguments of the next commands.
    if versions.len() > 1 {
        let folders = versions.iter();
        let shown: Vec<String> = folders.map(|(_, out)| out.display().to_string()).collect();
        tell(format_args!("folders: {}", shown.join(", ")));
    }
    Ok(())
}
