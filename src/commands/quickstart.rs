use std::path::{Path, PathBuf};

use clap::Args;
use shearq_bias::Estimate;
use shearq_scoring::Options;
use shearq_submissions::{Configuration, Registry};

use super::simulate::{Versions, versions};
use crate::arguments::Threads;
use crate::progress::{Bar, mark_resumable};
use crate::{print, print_table, tell};
use shearq_catalogue::request::Request;
use shearq_catalogue::truth::{Truth, expand};
use shearq_dataset::images;
use shearq_dataset::run::{Run, Source};
use shearq_files::table::FileFormat;
use shearq_pipeline::run::run_folder;
use shearq_render::figure::{Band, Figure, LinePlot, PanelGrid, Series, Style};
use shearq_render::html::{Block, Picture, Section};
use shearq_render::table::{Cell, Table};
use shearq_results::bias::{BiasResult, sum};
use shearq_results::catalogues::OWN;
use shearq_results::compare::{Variant, score_all};
use shearq_results::record::{columns_named, mean};
use shearq_results::views::bias::bias_table;
use shearq_results::views::comparison::{compare, named, per_set_plot, verdict};
use shearq_results::views::pages;
use shearq_simulate::set::{FixedPsf, SimulationSettings};

/// Measure m, c, noise and Q of three configurations on simulated galaxies.
///
/// It takes about 20 s of processor time and writes some megabytes: a table, a figure, and report.html with all metrics.
/// m and c come from galaxies of S/N 40 under shears of +0.02 and -0.02, each also rotated by 90 degrees, with the same
/// noise. Q and noise come from shear fields of 50 times GREAT10's power: with GREAT10's own power and so few galaxies,
/// zero shear without any image would have a higher Q than all measurements.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Folder to write to.
    #[arg(long, value_name = "DIR", default_value = "shearq-quickstart")]
    out: PathBuf,
    /// Print the comparison with all metrics, too.
    #[arg(long)]
    wide: bool,
    #[command(flatten)]
    threads: Threads,
}

const SUBMISSIONS: [&str; 3] = ["23/raw/star", "23/den/star", "48/linear/star"];
const SEED: u64 = 2013;
// GREAT10's set of S/N 40.
const SET: u32 = 8;
// 40,000 measurements under four versions of an image determine m to 10⁻³ and c to 6·10⁻⁴ (48/linear/star).
const PAIRS_GRID: usize = 100;
const SHEAR: f64 = 0.02;
// Chosen by hand: the least factor on GREAT10's shear power that is a multiple of 10 and at which zero shear (Q = 3.0) has
// about half the Q of the worst configuration (5.7).
const AMPLITUDE: f64 = 50.0;
const FIELDS: u32 = 10;
const FIELDS_GRID: usize = 60;

// What is measured of a configuration, besides its scores.
struct Pairs {
    bias: BiasResult,
    all: Estimate,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    mark_resumable();
    let Arguments { out, wide, threads } = arguments;
    let threads = threads.number();
    let registry = Registry::embedded()?;
    let options = Options {
        choice: OWN,
        ..Options::default()
    };
    // Progress and advice go to standard error, so that the table can be piped.
    tell(format_args!(
        "simulating and measuring galaxies: shears of ±{SHEAR}, and {FIELDS} shear fields"
    ));
    let (mut folders, mut pairs) = (Vec::new(), Vec::new());
    let mut made_by = Vec::new();
    for name in SUBMISSIONS {
        let folder = out.join(name.replace('/', "-"));
        let configuration = registry.get(name)?.configuration;
        made_by.push((name.to_owned(), toml::to_string(&configuration)?));
        let (own, fields) = measure(name, &configuration, &folder, threads)?;
        pairs.push(own);
        folders.push(fields);
    }
    let settings = serde_json::to_string(&fields_settings())?;
    made_by.insert(0, ("Shear fields".to_owned(), settings));
    let mut variants = score_all(&folders, &[], None, None, options, threads)?;
    for variant in &mut variants {
        // Published metrics are means over 200 images of all sets, and would look like a failure next to these images.
        variant.published = None;
    }
    let table = summary(&pairs, &variants);
    let figure = figure(&pairs, &variants);
    let full = compare(&variants, options.definition);
    print("\n")?;
    print_table(&table)?;
    if *wide {
        print_table(&full)?;
    }
    let picture = out.join("quickstart.png");
    figure.save(&picture)?;
    let caption = "m of pairs of shears, and Q of shear fields, with standard errors. Grey: |m| below 0.002, which Euclid requires.";
    let mut answer = vec![
        Block::Table(table),
        Block::Figure(Picture::draw(&figure, "quickstart", caption)?),
    ];
    let rows = named(&variants);
    let mut scores = pages::comparison(full, verdict(&rows), &per_set_plot(&rows))?
        .titled("Scores on the shear fields");
    for (pairs, variant) in pairs.iter().zip(&variants) {
        answer.push(Block::Folded(Table {
            title: format!("m and c of {}", variant.name),
            ..bias_table(&pairs.bias)
        }));
        let spectra = pages::spectra(&variant.name, &variant.scored())?;
        spectra.into_iter().for_each(|figure| scores.push(figure));
    }
    let sections = vec![
        Section::new("quickstart", "m, c, noise and Q", answer),
        scores,
    ];
    let report = out.join("report.html");
    pages::save(&report, "Quickstart (simulated data)", sections, made_by)?;
    tell(format_args!(
        "\nfigure: {}\nreport with all metrics and plots: {}\nNext: m and c of your catalogue (shearq bias --help),\nor shapes of your own galaxies (shearq measure --help).",
        picture.display(),
        report.display()
    ));
    Ok(())
}

// One PSF a set: each configuration is measured within seconds.
fn settings_of(grid: usize) -> SimulationSettings {
    SimulationSettings {
        fixed_psf: FixedPsf::One,
        ..SimulationSettings::new(SEED, grid)
    }
}

fn fields_settings() -> SimulationSettings {
    let mut settings = settings_of(FIELDS_GRID);
    settings.spectrum.amplitude = AMPLITUDE;
    settings
}

// Measures the pairs and the shear fields; the folder of the latter.
fn measure(
    name: &'static str,
    configuration: &Configuration,
    folder: &Path,
    threads: usize,
) -> anyhow::Result<(Pairs, PathBuf)> {
    let mut all = versions(&Versions {
        settings: settings_of(PAIRS_GRID),
        shears: &[[SHEAR; 2]],
        opposite: true,
        rotated: true,
        out: &folder.join("pairs"),
    })?;
    let sheared: Vec<PathBuf> = all.iter().map(|(_, folder)| folder.clone()).collect();
    let fields = folder.join("fields");
    all.push((fields_settings(), fields.clone()));
    let images_of = |settings: &SimulationSettings| match settings.constant_shear {
        Some(_) => 1,
        None => FIELDS,
    };
    let galaxies = all.iter().map(|(settings, _)| {
        u64::from(images_of(settings)) * (settings.grid * settings.grid) as u64
    });
    let mut bar = Bar::new(name, galaxies.sum());
    for (settings, folder) in &all {
        let run = Run::new(
            Source::Simulated(*settings),
            configuration.clone(),
            FileFormat::default(),
        );
        let images = images::of_simulation(&[SET], images_of(settings));
        run_folder(&run, *settings, &images, folder, threads, &mut bar)?;
    }
    drop(bar);
    let request = Request::new(expand(&sheared, Truth::Columns)?);
    let bias = sum(&request, &|_| true)?.result()?;
    let all = bias.all()?.clone();
    Ok((Pairs { bias, all }, fields))
}

// A row per configuration, and one of no images at all.
fn summary(pairs: &[Pairs], variants: &[Variant]) -> Table {
    let mut table = Table::titled("Three configurations on the same simulated galaxies");
    let rows: Vec<Option<(&Pairs, &Variant)>> =
        pairs.iter().zip(variants).map(Some).chain([None]).collect();
    table.column("submission", "Configuration", &rows, |row| {
        Cell::text(row.map_or("no images", |(_, variant)| variant.name.as_str()))
    });
    for key in ["m1", "m2", "c1", "c2"] {
        table.column(key, key, &rows, |row| {
            let found = row.and_then(|(pairs, _)| pairs.all.value(key));
            found.map_or(Cell::Empty, |own| {
                Cell::with_error(own.value, Some(own.error), 6)
            })
        });
    }
    for own in columns_named(&["galaxy_noise", "q"]) {
        table.column(own.name, own.heading, &rows, |row| match row {
            Some((_, variant)) => own.cell(&variant.run),
            None if own.name == "q" => Cell::number(zero_quality(variants), 1),
            None => Cell::Empty,
        });
    }
    let measurements = pairs.first().map_or(0, |own| own.all.galaxies);
    table.notes = vec![
        format!(
            "m, c: multiplicative and additive bias, from {measurements} measurements: the same galaxies with the same noise under shears of ±{SHEAR}."
        ),
        "noise: measurement noise of a component of ε of one galaxy.".into(),
        format!(
            "Q: GREAT10's score, higher is better, from {FIELDS} shear fields of {AMPLITUDE} times GREAT10's power. No images: all shears zero."
        ),
        "± is a standard error. Galaxies: S/N 40, one PSF.".into(),
    ];
    table
}

fn zero_quality(variants: &[Variant]) -> f64 {
    let scored = variants.first().map(Variant::scored).unwrap_or_default();
    scored
        .first()
        .map_or(f64::NAN, |set| set.score.zero_quality().q)
}

fn figure(pairs: &[Pairs], variants: &[Variant]) -> PanelGrid {
    let mut names: Vec<String> = variants.iter().map(|own| own.name.clone()).collect();
    let places = |aside: f64| (0..pairs.len()).map(|row| row as f64 + aside).collect();
    let of = |key: &str, aside: f64, colour| {
        let found = pairs.iter().map(|own| own.all.value(key));
        let (values, errors) = found
            .map(|own| own.map_or((f64::NAN, f64::NAN), |own| (own.value, own.error)))
            .unzip();
        Series::new(key, places(aside), values, Style::Points, colour).with_errors(errors)
    };
    let m = LinePlot {
        y_label: "m".into(),
        x_names: names.clone(),
        bands: vec![Band {
            label: String::new(),
            low: -2e-3,
            high: 2e-3,
        }],
        // Side by side, so that points do not hide each other.
        series: vec![of("m1", -0.1, 0), of("m2", 0.1, 1)],
        ..LinePlot::default()
    };
    let (mut q, mut errors): (Vec<f64>, Vec<f64>) = variants
        .iter()
        .map(|own| mean(&own.run.sets, |metrics| metrics.q))
        .unzip();
    names.push("no images".into());
    q.push(zero_quality(variants));
    errors.push(f64::NAN);
    let x = (0..names.len()).map(|row| row as f64).collect();
    let q = LinePlot {
        y_label: "Q".into(),
        x_names: names,
        series: vec![Series::new("", x, q, Style::Points, 2).with_errors(errors)],
        ..LinePlot::default()
    };
    PanelGrid {
        columns: 2,
        plots: vec![m, q],
        ..PanelGrid::default()
    }
}
