//! A new challenge: a public folder for participants and a private folder with the truth.

use std::path::Path;

use sha2::{Digest, Sha256};
use shearq_dataset::grid::{read_psfs, write_psfs};
use shearq_dataset::images::{self, ImageId};
use shearq_dataset::layout::{DataFolder, LAYOUT_FILE, Layout, MAX_SET, fill};
use shearq_dataset::run::{SIMULATION_FILE, SimulationRecord};
use shearq_dataset::threads::{Progress, Quiet};
use shearq_dataset::truth::{ReadTruth, Reading, grid_of_set, read_truth, reading_of, write_truth};
use shearq_files::fits::{ImageReader, ImageWriter, Value};
use shearq_files::open::is_there;
use shearq_files::{FileError, atomic, names_of};
use shearq_pipeline::scenes::{SceneFolders, SceneRecord, simulate_scenes, write_shears};
use shearq_pipeline::simulate::simulate_images;
use shearq_quantities::units::{Degrees, Pixels};
use shearq_results::record::SetRecord;
use shearq_results::score::ScoreError;
use shearq_scoring::{Choice, Convention, Options, RowCounts, ScoredImages, SetSession, TrueShear};
use shearq_simulate::field::ShearSpectrum;
use shearq_simulate::fit::Fit;
use shearq_simulate::scene::{SceneSettings, SceneSimulator};
use shearq_simulate::set::{FixedPsf, STAMP, SimulationSettings};

use crate::error::{ChallengeError, EXPECTED_RESPONSE, unscored};
use crate::kind::{ConstantShears, Kind, MIN_SCENES, Noise, RankBy, additive_bias, response};
use crate::page::readme;
use crate::seal::{Key, close, names, seal_public, sums};
use crate::shapes::References;
use crate::terms::{CHALLENGE_FILE, Challenge, Data, Deadline, Rules, SceneData};

#[derive(Debug, Clone)]
pub struct Plan {
    pub name: String,
    pub version: u32,
    pub kind: Kind,
    /// Metric that ranks the entries; `None` for the default of the kind, which depends on the true shear.
    pub metric: Option<RankBy>,
    pub spectra: bool,
    pub contact: String,
    pub address: String,
    pub entries_per_team: Option<u32>,
    pub opens: Option<Deadline>,
    pub closes: Option<Deadline>,
    pub partial: bool,
    /// Largest |m| of ranked entries of scenes.
    pub max_m: Option<f64>,
}

#[derive(Debug, Clone)]
pub struct Simulation {
    pub sets: Vec<u32>,
    pub images: u32,
    pub grid: usize,
    /// Factor on the shear power; `None` to draw it from the seed.
    pub amplitude: Option<f64>,
    /// Extra slope of the shear power; `None` to draw it from the seed.
    pub tilt: Option<f64>,
}

#[derive(Debug, Clone)]
pub struct Scenes {
    pub count: u32,
    /// Of any seed.
    pub settings: SceneSettings,
    /// Galaxies are drawn from these, or from the default population if there are none.
    pub fits: Vec<Fit>,
    /// Fingerprint of the table of these fits.
    pub galaxies: Option<String>,
}

#[derive(Debug, Clone, Copy)]
pub struct Folders<'a> {
    pub public: &'a Path,
    pub private: &'a Path,
}

// Range of the factor on the shear power that a seed determines.
const AMPLITUDES: (f64, f64) = (0.5, 2.0);
// Largest extra slope of the shear power that a seed determines.
const TILT: f64 = 0.2;
/// Factor s on bandpowers, log-uniform between 1/s and s. The best spectrum that can be had without images is the median,
/// with σ_sys smaller than for zero shear by (s − 1)/(s + 1): ⟨|x − 1|⟩/⟨x⟩ of a log-uniform x. With 4, no template exceeds 5/3 of
/// the Q of zero shear, and the shear stays weak.
pub const SCATTER: f64 = 4.0;
/// Q of the best template relative to the Q of zero shear.
pub const TEMPLATE_GAIN: f64 = (SCATTER + 1.0) / (SCATTER - 1.0);

impl Folders<'_> {
    // Checks that the public folder can become one of this challenge. Returns the key of an earlier, stopped command.
    fn prepare(&self, plan: &Plan) -> Result<Option<Key>, FileError> {
        let Folders { public, private } = self;
        if is_there(&public.join(CHALLENGE_FILE)) {
            let message = "this is a complete challenge; expected a new folder";
            return Err(FileError::new(public, message));
        }
        for folder in [public, private] {
            std::fs::create_dir_all(folder)
                .map_err(FileError::doing(folder, "cannot make the folder"))?;
        }
        let real = |folder: &Path| {
            let doing = FileError::doing(folder, "cannot find the folder");
            folder.canonicalize().map_err(doing)
        };
        let (open, secret) = (real(public)?, real(private)?);
        if open.starts_with(&secret) || secret.starts_with(&open) {
            let message = format!(
                "one folder contains the other (the private folder is {}); participants would get the truth",
                private.display()
            );
            return Err(FileError::new(public, message));
        }
        let key = Key::read(private)?;
        match &key {
            Some(key) if (&key.name, key.version) != (&plan.name, plan.version) => {
                let message = format!(
                    "this folder belongs to another challenge (found {} version {}, expected {} version {})",
                    key.name, key.version, plan.name, plan.version
                );
                Err(FileError::new(private, message))
            }
            Some(_) => Ok(key),
            None => {
                for folder in [public, private] {
                    // A command that was killed leaves hidden files.
                    if names(folder)?.iter().any(|name| !name.starts_with('.')) {
                        let message =
                            "the folder has files already; expected a new or an empty folder";
                        return Err(FileError::new(folder, message));
                    }
                }
                close(private)?;
                Ok(None)
            }
        }
    }
}

// The seed and the key of a challenge, those of an earlier command if it was stopped.
fn seeded(plan: &Plan, earlier: Option<Key>) -> (u128, Key) {
    let kept = earlier
        .as_ref()
        .and_then(|key| key.seed.as_ref()?.parse().ok());
    let seed: u128 = kept.unwrap_or_else(rand::random);
    let key = earlier.unwrap_or_else(|| Key::new(&plan.name, plan.version, Some(seed)));
    (seed, key)
}

// A number between 0 and 1 that a seed determines, for each purpose: from the first 64 bits of a SHA-256.
fn drawn(seed: u128, purpose: &str) -> f64 {
    let digest = Sha256::digest(format!("shearq challenge\0{purpose}\0{seed}\0"));
    let bits = digest[..8]
        .iter()
        .fold(0, |bits, byte| bits << 8 | u64::from(*byte));
    bits as f64 / 2f64.powi(64)
}

/// Writes a challenge of simulated images. The same command resumes a stopped one. Returns the description.
pub fn simulated(
    plan: &Plan,
    simulation: &Simulation,
    folders: Folders<'_>,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Challenge, ChallengeError> {
    plan.check_grid()?;
    if simulation.amplitude == Some(0.0) {
        return Err(ChallengeError::NoShear);
    }
    let one_shear_per_set = plan.kind == Kind::Great3;
    if one_shear_per_set && (simulation.amplitude.is_some() || simulation.tilt.is_some()) {
        return Err(ChallengeError::NoSpectrum);
    }
    let (seed, key) = seeded(plan, folders.prepare(plan)?);
    let (least, most) = AMPLITUDES;
    let settings = SimulationSettings {
        seed_high: (seed >> 64) as u64,
        spectrum: ShearSpectrum {
            amplitude: simulation
                .amplitude
                .unwrap_or_else(|| least * (most / least).powf(drawn(seed, "amplitude"))),
            tilt: simulation
                .tilt
                .unwrap_or_else(|| TILT * (2.0 * drawn(seed, "tilt") - 1.0)),
            scatter: SCATTER,
        },
        one_shear_per_set,
        // Participants download half as much as with a star for each galaxy.
        fixed_psf: FixedPsf::One,
        ..SimulationSettings::new(seed as u64, simulation.grid)
    };
    settings.validate()?;
    key.write(folders.private)?;
    let record = SimulationRecord {
        version: shearq_dataset::VERSION.into(),
        settings,
    };
    let public = DataFolder::new(folders.public);
    let private = DataFolder::new(folders.private);
    let data = Data {
        sets: simulation.sets.clone(),
        images: simulation.images,
        grid: simulation.grid,
        stamp: STAMP,
        field_degrees: public.layout().field_degrees,
        scene: None,
    };
    // One image of each set shows whether entries can be ranked, before hours of simulation.
    let first = images::of_simulation(&data.sets, 1);
    simulate_images(&record, &first, &public, &private, threads, progress)?;
    let rankable = rankable(plan, &data, &public, &private, false, threads, progress)?;
    let ids = images::of_simulation(&data.sets, data.images);
    simulate_images(&record, &ids, &public, &private, threads, progress)?;
    finish(plan, rankable, data, folders, key, threads)
}

/// Writes a challenge of scenes with a shear each. The same command resumes a stopped one. Progress is in objects. Returns the
/// description.
///
/// There is one version of each scene: participants would find the shear from two under opposite shears, or from one that is
/// turned, because shapes cancel in their mean, and from one with the opposite noise.
pub fn of_scenes(
    plan: &Plan,
    scenes: &Scenes,
    folders: Folders<'_>,
    threads: usize,
    start: impl FnOnce(u64) -> Box<dyn Progress>,
) -> Result<Challenge, ChallengeError> {
    if plan.kind != Kind::Scenes {
        return Err(ChallengeError::ScenesOfKind(plan.kind));
    }
    if !(MIN_SCENES..=MAX_SET).contains(&scenes.count) {
        return Err(ChallengeError::SceneCount(scenes.count));
    }
    if scenes.settings.density == 0.0 {
        return Err(ChallengeError::NoGalaxies);
    }
    plan.check()?;
    let (seed, key) = seeded(plan, folders.prepare(plan)?);
    let settings = SceneSettings {
        seed: seed as u64,
        seed_high: (seed >> 64) as u64,
        ..scenes.settings
    };
    let simulator = SceneSimulator::new(settings, scenes.fits.clone())?;
    let sets: Vec<u32> = (1..=scenes.count).collect();
    let shear = |set: &u32| {
        let g = simulator.shear(*set);
        (*set, [g.e1, g.e2])
    };
    ConstantShears::new(sets.iter().map(shear).collect()).map_err(ChallengeError::Shears)?;
    key.write(folders.private)?;
    let record = SceneRecord {
        version: shearq_dataset::VERSION.into(),
        settings,
        galaxies: scenes.galaxies.clone(),
    };
    let apart = SceneFolders {
        images: folders.public,
        truth: folders.private,
    };
    let exposures = u64::from(scenes.count * settings.epochs);
    let mut progress = start(exposures * simulator.objects() as u64);
    let progress = progress.as_mut();
    simulate_scenes(&simulator, &record, scenes.count, apart, threads, progress)?;
    let version = [(&simulator, folders.private)];
    write_shears(version.into_iter(), scenes.count, folders.private)?;
    let data = Data {
        sets,
        images: 1,
        grid: 0,
        stamp: 0,
        field_degrees: 0.0,
        scene: Some(SceneData {
            side: settings.side,
            arcmin2: settings.area_arcmin2(),
            psf_varies: settings.psf_gradient != [0.0; 2],
            epochs: (settings.epochs > 1).then_some(settings.epochs),
            gain: settings.gain,
        }),
    };
    // The noise of the images is in the scatter that ranks entries, so that no error is smaller.
    let rankable = (plan.kind.metric(true), Noise::default());
    finish(plan, rankable, data, folders, key, threads)
}

/// Writes a challenge of the images in `data`, which another program made. New headers are written, because the old headers
/// may contain the seed or the shear. The true shear is in the files `truth` with `{set}` for the set number, or in the
/// data folder.
pub fn of_images(
    plan: &Plan,
    data: &DataFolder,
    truth: Option<&str>,
    folders: Folders<'_>,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Challenge, ChallengeError> {
    plan.check_grid()?;
    let about = about(data)?;
    let first = data.galaxies(about.sets[0], 1);
    if is_there(&data.root().join(SIMULATION_FILE))
        || ImageReader::open(&first)?.number("SEED")?.is_some()
    {
        let message = "these images were made by `simulate`; their noise is a function of a seed that participants can find by trying, and with it the shear";
        return Err(FileError::new(first, message)
            .hint("--sets LIST --images N in place of --data, which draws 128 bits")
            .into());
    }
    let earlier = folders.prepare(plan)?;
    let key = earlier.unwrap_or_else(|| Key::new(&plan.name, plan.version, None));
    key.write(folders.private)?;
    let public = DataFolder::new(folders.public);
    let private = DataFolder::new(folders.private);
    for &set in &about.sets {
        let path = match truth {
            Some(pattern) => fill(pattern, set, 0).into(),
            None => data.truth(set),
        };
        let reading = match truth {
            Some(_) => Reading {
                field: Degrees(about.field_degrees),
                stamp: Pixels(about.stamp as f64),
                sign: None,
            },
            None => reading_of(data, set)?,
        };
        let ReadTruth { grid, shear, sign } = read_truth(&path, &reading)?;
        if sign.is_none() {
            let message = "cannot determine the sign of g2";
            return Err(FileError::new(&path, message).hint("a line `# g2sign: standard` (g2 > 0 along x = y) or `# g2sign: challenge` (the other sign) in the file").into());
        }
        if grid.n != about.grid {
            let message = format!(
                "the true shear has {0} × {0} rows; expected {1} × {1}, as the images",
                grid.n, about.grid
            );
            return Err(FileError::new(&path, message).into());
        }
        write_truth(&private.truth(set), &grid, &shear)?;
        copy_image(data, &public, ImageId { set, image: 1 }, &about)?;
    }
    let rankable = rankable(plan, &about, &public, &private, true, threads, progress)?;
    for &set in &about.sets {
        for image in 1..=about.images {
            if image > 1 {
                copy_image(data, &public, ImageId { set, image }, &about)?;
            }
            progress.advance((about.grid * about.grid) as u64);
        }
    }
    finish(plan, rankable, about, folders, key, threads)
}

impl Plan {
    // The same of a challenge of galaxies on a grid.
    fn check_grid(&self) -> Result<(), ChallengeError> {
        match self.kind {
            Kind::Scenes => Err(ChallengeError::NoScenes),
            Kind::Great10 | Kind::Great3 => self.check(),
        }
    }

    // Checks what does not depend on the data.
    fn check(&self) -> Result<(), ChallengeError> {
        if let (Some(opens), Some(closes)) = (&self.opens, &self.closes)
            && closes.last < opens.first
        {
            let (opens, closes) = (opens.clone(), closes.clone());
            return Err(ChallengeError::ClosesFirst { opens, closes });
        }
        match self.metric.unwrap_or(self.kind.metric(false)) {
            metric if self.spectra && !metric.is_of_spectra() => {
                let metric = metric.label();
                Err(ChallengeError::NotOfSpectra { metric })
            }
            _ => Ok(()),
        }
    }
}

// Scores of a reference measurement of the first image of each set, and the mean Q of zero shear.
fn first_scores(
    data: &Data,
    public: &DataFolder,
    truths: Vec<(u32, TrueShear)>,
    metric: RankBy,
    threads: usize,
) -> Result<(Vec<SetRecord>, f64), ChallengeError> {
    let grid = data.grid().map_err(unscored)?;
    let first = data.sets.iter().map(|&set| ImageId { set, image: 1 });
    let first: Vec<ImageId> = first.collect();
    let references = References::measure(public, &first, grid, threads, &mut Quiet)?;
    let mut scored = Vec::new();
    let mut zero = 0.0;
    for (set, truth) in truths {
        let options = Options {
            definition: metric.definition(),
            choice: Choice::Insist(Convention::STANDARD),
            ..Options::default()
        };
        let wrong = |source| ScoreError::Scoring {
            set: Some(set),
            source,
        };
        let session = SetSession::new(grid, Some(truth), options).map_err(wrong)?;
        let mut first = session.begin();
        if let Some(shapes) = references.of(set, 1) {
            let examined = session.examine(shapes, RowCounts::default());
            first.add(&examined.map_err(wrong)?).map_err(wrong)?;
        }
        let ScoredImages { score, rows, .. } = first.finish().map_err(wrong)?;
        zero += score.zero_quality().q / data.sets.len() as f64;
        scored.push(SetRecord::new(set, false, vec![1], &score, &rows, true));
    }
    Ok((scored, zero))
}

// The noise of a first image becomes that of the mean of all images.
fn average_images(of_first: &mut SetRecord, images: u32) {
    let images = f64::from(images);
    let (metrics, errors) = (&mut of_first.metrics, &mut of_first.errors);
    // The power of the noise, which dominates Q, averages down by their number.
    metrics.q *= images;
    // What c scatters between constant shears is noise, too.
    for noise in [
        &mut metrics.c1,
        &mut metrics.c2,
        &mut errors.m_cross,
        &mut errors.c1,
        &mut errors.c2,
    ] {
        *noise /= images.sqrt();
    }
}

// Largest response of a reference measurement to the true shear, or inverse. Its m is a few tenths at most, and a true shear of
// twice or half the scale has a response of 0.5 or 2; one of another sign, order or set has a response near 0.
const MAX_RESPONSE: f64 = 1.6;
// Standard errors by which a response must be out of range. Of the 25 responses of 24 sets, chance reaches this in one of 1,200
// challenges whose responses are all at the limit, and in none whose responses are near 1.
const MIN_CONTRADICTION_SIGNIFICANCE: f64 = 4.0;

// A true shear that the images contradict: the organiser would find out when entries arrive.
fn contradiction(
    scored: &[SetRecord],
    constant: Option<&ConstantShears>,
) -> Result<(), ChallengeError> {
    // One constant shear has no response.
    let each = scored.chunks(1).filter(|_| constant.is_none());
    for sets in std::iter::once(scored).chain(each) {
        let (response, error) = response(sets, constant);
        let margin = MIN_CONTRADICTION_SIGNIFICANCE * error;
        if response + margin < 1.0 / MAX_RESPONSE || response - margin > MAX_RESPONSE {
            return Err(ChallengeError::Contradiction {
                of: sets_in_words(sets),
                response,
                error,
            });
        }
    }
    Ok(())
}

fn sets_in_words(sets: &[SetRecord]) -> String {
    match sets {
        [one] => format!("set {}", one.set),
        _ => "all sets".into(),
    }
}

// The metric of a challenge and the errors of a measurement with the noise of the images, if entries can be ranked by it.
fn rankable(
    plan: &Plan,
    data: &Data,
    public: &DataFolder,
    private: &DataFolder,
    foreign: bool,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<(RankBy, Noise), ChallengeError> {
    let grid = data.grid().map_err(unscored)?;
    let truths = data.sets.iter().map(|&set| {
        let truth = private.read_truth(set, &grid)?;
        Ok((set, truth))
    });
    let truths: Vec<(u32, TrueShear)> = truths.collect::<Result<_, ChallengeError>>()?;
    let constant = ConstantShears::of(truths.iter().map(|(set, truth)| (*set, truth)))
        .map_err(ChallengeError::Shears)?;
    let metric = plan
        .metric
        .unwrap_or_else(|| plan.kind.metric(constant.is_some()));
    let label = metric.label();
    if !metric.suits(constant.is_some()) {
        return Err(ChallengeError::Undefined {
            metric: label,
            constant: constant.is_some(),
        });
    }
    if plan.spectra && data.sets.len() < 2 {
        return Err(ChallengeError::OneSpectrum);
    }
    progress.note("measuring the first images");
    let (mut scored, zero) = first_scores(data, public, truths, metric, threads)?;
    let constant = constant.as_ref();
    if foreign {
        contradiction(&scored, constant)?;
    }
    for of_first in &mut scored {
        average_images(of_first, data.images);
    }
    let images = f64::from(data.images);
    let noise = Noise {
        response: response(&scored, constant).1,
        c: additive_bias(&scored, constant).1,
    };
    let groups: Vec<&[SetRecord]> = match metric.needs_the_response_of_each_set() {
        true => scored.chunks(1).collect(),
        false => vec![&scored],
    };
    for sets in groups {
        // The response itself is one; measured on a single image, it scatters too much.
        let (_, error) = response(sets, constant);
        if error * EXPECTED_RESPONSE > 1.0 || error.is_nan() {
            return Err(ChallengeError::SmallResponse {
                metric: label,
                of: sets_in_words(sets),
                found: 1.0 / error,
                images: (images * (error * EXPECTED_RESPONSE).powi(2)).ceil(),
            });
        }
    }
    if matches!(metric, RankBy::Q | RankBy::QCorrected) {
        let (catalogue, _) = metric.of(&scored, None);
        let template = TEMPLATE_GAIN * zero;
        if catalogue < template {
            return Err(ChallengeError::BehindTemplate {
                metric: label,
                template,
                catalogue,
                images: (images * template / catalogue).ceil(),
            });
        }
    }
    Ok((metric, noise))
}

// Sets, images and grid of a data folder, which must be the same for all sets.
fn about(data: &DataFolder) -> Result<Data, ChallengeError> {
    if data.layout().great3.is_some() {
        let message = "this is a branch of GREAT3, whose truth is in another folder already (expected sets with images from 1)";
        return Err(FileError::new(data.root(), message).hint("give this folder to participants, and score their entries with `shearq score --challenge great3 --branch BRANCH --truth DIR`").into());
    }
    let ids = images::of_folder(data, &[])?;
    let mut about: Option<Data> = None;
    for of_set in ids.chunk_by(|a, b| a.set == b.set) {
        let set = of_set[0].set;
        let path = data.galaxies(set, 1);
        let count = of_set.len() as u32;
        if !of_set.iter().map(|id| id.image).eq(1..=count) {
            let numbers: Vec<String> = of_set.iter().map(|id| id.image.to_string()).collect();
            let message = format!(
                "set {set}: its images are not numbered from 1 without gaps (found {}, expected 1 to {count})",
                names_of(&numbers)
            );
            return Err(FileError::new(path, message).into());
        }
        let grid = grid_of_set(data, set)?;
        let own = Data {
            sets: Vec::new(),
            images: count,
            grid: grid.n,
            stamp: grid.stamp.0 as usize,
            field_degrees: data.layout().field_degrees,
            scene: None,
        };
        let about = about.get_or_insert_with(|| own.clone());
        if (about.images, about.grid, about.stamp) != (own.images, own.grid, own.stamp) {
            let message = format!(
                "set {set} has {} images of {2} × {2} galaxies; expected {} of {3} × {3}, as the first set",
                own.images, about.images, own.grid, about.grid
            );
            return Err(FileError::new(path, message).into());
        }
        about.sets.push(set);
    }
    about.ok_or_else(|| FileError::new(data.root(), "there are no galaxy images here").into())
}

// Copies pixels and PSFs of an image under new headers.
fn copy_image(
    data: &DataFolder,
    public: &DataFolder,
    id: ImageId,
    about: &Data,
) -> Result<(), FileError> {
    let ImageId { set, image } = id;
    let numbers = [
        ("SET", Value::Int(i64::from(set))),
        ("IMAGE", Value::Int(i64::from(image))),
        ("STAMP", Value::Int(about.stamp as i64)),
    ];
    let (star, functional) = (data.psf_star(set, image), data.psf_functional(set, image));
    if !is_there(&star) && !is_there(&functional) {
        return Err(FileError::new(star, "there is no PSF of this image"));
    }
    if is_there(&star) {
        let mut reader = ImageReader::open(&star)?;
        copy_pixels(&mut reader, &public.psf_star(set, image), &numbers[..2])?;
    }
    if is_there(&functional) {
        let rows = read_psfs(&functional)?;
        write_psfs(&public.psf_functional(set, image), &rows)?;
    }
    let mut reader = ImageReader::open(data.galaxies(set, image))?;
    let mut header = numbers.to_vec();
    header.push(("NGRID", Value::Int(about.grid as i64)));
    if let Some(noise) = reader.number("NOISESIG")? {
        header.push(("NOISESIG", Value::Real(noise)));
    }
    copy_pixels(&mut reader, &public.galaxies(set, image), &header)
}

fn copy_pixels(
    from: &mut ImageReader,
    to: &Path,
    header: &[(&str, Value)],
) -> Result<(), FileError> {
    let (width, height) = (from.width(), from.height());
    let mut writer = ImageWriter::create(to, width, height, header)?;
    // Rows that fit into a few megabytes.
    let at_a_time = ((1 << 20) / width.max(1)).clamp(1, height.max(1));
    let mut row = 0;
    while row < height {
        let rows = at_a_time.min(height - row);
        writer.write_rows(&from.read_rows(rows)?)?;
        row += rows;
    }
    writer.finish()
}

// Writes description, layout and page for participants, and seals the public folder.
fn finish(
    plan: &Plan,
    (metric, noise): (RankBy, Noise),
    data: Data,
    folders: Folders<'_>,
    mut key: Key,
    threads: usize,
) -> Result<Challenge, ChallengeError> {
    let kind = plan.kind;
    let layout = data.scene.is_none().then(|| layout_text(&data));
    let mut challenge = Challenge {
        name: plan.name.clone(),
        version: plan.version,
        kind,
        contact: plan.contact.clone(),
        address: plan.address.clone(),
        seal: String::new(),
        conventions: kind.conventions(),
        rules: Rules {
            metric,
            contents: kind.contents(plan.spectra),
            entries_per_team: plan.entries_per_team,
            opens: plan.opens.clone(),
            closes: plan.closes.clone(),
            partial: plan.partial,
            max_m: plan.max_m,
        },
        data,
    };
    let Folders { public, private } = folders;
    if let Some(layout) = layout {
        for folder in [public, private] {
            atomic::write(folder.join(LAYOUT_FILE), layout.as_bytes())?;
        }
    }
    key.noise = Some(noise);
    key.files = sums(private, names(private)?, threads)?;
    challenge.seal = key.seal();
    atomic::write(public.join("README.md"), readme(&challenge).as_bytes())?;
    let path = public.join(CHALLENGE_FILE);
    atomic::write(&path, challenge.text(&path)?.as_bytes())?;
    key.public = Some(seal_public(public, threads)?);
    key.write(private)?;
    close(private)?;
    Ok(challenge)
}

// The layout of the images, without names of truth files.
fn layout_text(data: &Data) -> String {
    let layout = Layout::default();
    format!(
        "galaxies = {:?}\npsf_star = {:?}\npsf_functional = {:?}\nfield_degrees = {:?}\nstamp = {}\n",
        layout.galaxies, layout.psf_star, layout.psf_functional, data.field_degrees, data.stamp
    )
}
