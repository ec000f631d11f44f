//! The page of `shearq reproduce`: Fig. 3, Table 1 and Figs 8 to 11 of the paper.

use shearq_pipeline::PipelineError;
use shearq_pipeline::run::{measurers, simulated_steps};
use shearq_pipeline::simulate::simulator;
use shearq_render::figure::{ImageRow, LinePlot, PanelGrid, Series, Style};
use shearq_render::page::{Page, PageError};
use shearq_render::table::{Cell, Table};
use shearq_results::views::pages::{bins, spectrum_panel, steps_figure, steps_row};
use shearq_scoring::Metrics;
use shearq_simulate::kinds::{SetKind, shares};
use shearq_submissions::{Configuration, PsfForm, Published};

use crate::calibration::{self, Curves};
use crate::reproduce::{ConfigurationResult, Plan, SetResult};
use crate::response::Response;

type Metric = fn(&Metrics) -> f64;

// The paper shows these two in Figs 3 and 9 to 11.
const RAW: &str = "23/raw/star";
const DENOISED: &str = "23/den/star";

const SECT_THREE: &str = "The network deconvolves a stamp. The ellipticity is measured on the autocorrelation (ACF) of the result, after subtracting the mean of its edge. The ACF is clipped at the radius that contains 89 % of the largest enclosed light.";
const SECT_FOUR: &str = "Exponential galaxies are convolved with a Moffat PSF each and have white noise of 10, 20 or 40 dB. Both updating rules deconvolve them with λ from 10⁻⁶ to 10⁶. All data are simulated.";
const SECT_FIVE: &str = "Configurations of Table 1 on sets of Table 2. The images are simulated, not the challenge's. Unpublished properties are chosen here: distributions of S/N and size, PSF fields and shear spectra. Metrics are for the standard convention and the leaderboard definition. Errors come from the part of the ellipticities that the truth does not explain.";

fn metric_of(result: &ConfigurationResult, metric: Metric) -> (f64, f64) {
    let score = &result.score;
    (metric(&score.metrics), metric(&score.errors))
}

fn over_sets(results: &[SetResult], place: usize, metric: Metric) -> Vec<(f64, f64)> {
    let of_set = |set: &SetResult| metric_of(&set.results[place], metric);
    results.iter().map(of_set).collect()
}

// Mean over the challenge's 24 sets, of which one simulated set stands for all of its kind.
fn mean_of_24(results: &[SetResult], place: usize, metric: Metric) -> (f64, f64) {
    let sets: Vec<u32> = results.iter().map(|set| set.set).collect();
    let (mut mean, mut variance) = (0.0, 0.0);
    for ((value, error), share) in over_sets(results, place, metric)
        .into_iter()
        .zip(shares(&sets))
    {
        mean += share * value;
        variance += (share * error).powi(2);
    }
    (mean, variance.sqrt())
}

fn measured((value, error): (f64, f64), decimals: usize) -> Cell {
    Cell::with_error(value, Some(error), decimals)
}

/// Table 1: our metrics beside the published ones.
pub fn table_one(results: &[SetResult], configurations: &[(Configuration, Published)]) -> Table {
    let rows: Vec<_> = configurations.iter().enumerate().collect();
    let mut table = Table::titled("Table 1: configurations over all sets (simulated data)");
    let mut words = |key, label, detail, word: &dyn Fn(&Configuration) -> String| {
        let place = table.column(key, label, &rows, |(_, (own, _))| Cell::text(word(own)));
        table.headings[place].detail = detail;
    };
    words("method", "Method", false, &|own| own.name.clone());
    words("size", "Size", true, &|own| {
        format!("{0}×{0}", own.stamp.size)
    });
    words("denoised", "Den", true, &|own| match own.wavelet() {
        Some(_) => "Y".into(),
        None => "N".into(),
    });
    words("psf", "PSF", true, &|own| match own.psf.form {
        PsfForm::Star => "Star".into(),
        PsfForm::Functional => "Func".into(),
    });
    type InTable = Option<(&'static str, &'static str, fn(&Published) -> f64)>;
    let mut metric = |key, label, metric: Metric, published: InTable, decimals| {
        table.column(key, label, &rows, |(place, _)| {
            measured(mean_of_24(results, *place, metric), decimals)
        });
        if let Some((key, label, value)) = published {
            table.column(key, label, &rows, |(_, (_, published))| {
                Cell::number(value(published), decimals)
            });
        }
    };
    let m_half: InTable = Some(("m_half_published", "M/2 publ.", |p| p.m_half));
    metric("m_half", "M/2", |f| f.m_half, m_half, 4);
    let sqrt_a: InTable = Some(("sqrt_a_published", "√A publ.", |p| p.sqrt_a));
    metric("sqrt_a", "√A×10⁴", |f| f.sqrt_a, sqrt_a, 4);
    metric(
        "q",
        "Q",
        |f| f.q,
        Some(("q_published", "Q publ.", |p| p.q)),
        2,
    );
    metric("q_calibrated", "Q calibrated", |f| f.q_calibrated, None, 2);
    metric("q_dn", "Q_dn", |f| f.q_dn, None, 1);
    metric("m_cross", "m (cross)", |f| f.m_cross, None, 4);
    table.notes = vec![
        "Q calibrated: after dividing the bandpowers by (1 + m)², with m by cross-correlation with the truth; unknown if the response of a set is less than 3σ above zero.".into(),
        "Means over sets: each kind of image counts as often as among the challenge's 24 sets; absent kinds do not count.".into(),
        "Standard convention, leaderboard definition. Errors come from the part of the spectra that the truth does not explain. Published metrics refer to the challenge's images, 200 per set.".into(),
    ];
    table
}

// Metrics of every set and configuration: the data of Figs 8, 10 and 11.
fn per_set_table(results: &[SetResult]) -> Table {
    let of_set = |set: &'_ SetResult| -> Vec<_> {
        let all = set.results.iter().cloned();
        all.map(|own| (set.set, own)).collect()
    };
    let rows: Vec<(u32, ConfigurationResult)> = results.iter().flat_map(of_set).collect();
    let mut table = Table::titled("Every set and configuration");
    table.column("set", "Set", &rows, |row| Cell::number(f64::from(row.0), 0));
    table.column("kind", "Kind", &rows, |row| {
        Cell::text(SetKind::of(row.0).map_or("", |kind| kind.image.label()))
    });
    table.column("submission", "Configuration", &rows, |(_, own)| {
        Cell::text(&own.configuration)
    });
    let mut metric = |key, label, metric: Metric, decimals| {
        table.column(key, label, &rows, |(_, own)| {
            measured(metric_of(own, metric), decimals)
        });
    };
    metric("q", "Q", |f| f.q, 2);
    metric("q_dn", "Q_dn", |f| f.q_dn, 1);
    metric("m_half", "M/2", |f| f.m_half, 4);
    metric("sqrt_a", "√A×10⁴", |f| f.sqrt_a, 4);
    metric("m_cross", "m (cross)", |f| f.m_cross, 4);
    metric("q_calibrated", "Q calibrated", |f| f.q_calibrated, 2);
    table.column("conventions", "Conv. matched/best", &rows, |(_, own)| {
        let best = own.score.convention_leaderboard;
        Cell::text(format!("{}/{best}", own.convention_matched))
    });
    let mut response = |key, label, value: fn(&Response) -> (f64, f64), decimals| {
        table.column(key, label, &rows, |(_, own)| {
            measured(value(&own.response), decimals)
        });
    };
    response("slope1", "slope e1", |r| (r.slope[0], r.slope_error[0]), 3);
    response("slope2", "slope e2", |r| (r.slope[1], r.slope_error[1]), 3);
    let scatter = |r: &Response| (r.rms_scatter(), r.rms_scatter_error());
    response("scatter", "scatter / slope", scatter, 4);
    table.column("flagged", "Flagged", &rows, |(_, own)| {
        Cell::number(own.response.flagged as f64, 0)
    });
    table
}

// Fig. 9: true and measured shear power spectra, a panel per set, and its data.
fn power_spectra(results: &[SetResult], place: usize, name: &str) -> (PanelGrid, Table) {
    let panel = |set: &SetResult| {
        let own = &set.results[place];
        let powers = [&set.l, &set.true_ee, &own.ee, &own.ee_error];
        spectrum_panel(Some(set.set), SetKind::of(set.set), powers, None)
    };
    let figure = PanelGrid {
        title: format!("Shear power spectra of {name}"),
        columns: 4,
        plots: results.iter().map(panel).collect(),
    };
    let bins = |set: &'_ SetResult| -> Vec<_> {
        let own = &set.results[place];
        let bin = |b: usize| {
            let measured = (own.ee[b], own.ee_error[b]);
            (set.set, b + 1, set.l[b], set.true_ee[b], measured)
        };
        bins(&set.l).map(bin).collect()
    };
    let rows: Vec<_> = results.iter().flat_map(bins).collect();
    let mut table = Table::titled("Shear power spectra");
    table.column("set", "Set", &rows, |row| Cell::number(f64::from(row.0), 0));
    table.column("bin", "Bin", &rows, |row| Cell::number(row.1 as f64, 0));
    table.column("l", "ℓ", &rows, |row| Cell::number(row.2, 1));
    table.column("true", "true", &rows, |row| Cell::number(row.3, 9));
    table.column("measured", "measured", &rows, |row| measured(row.4, 9));
    (figure, table)
}

// Figs 8, 10 and 11: a metric per set for the configurations at `places`.
fn metric_per_set(
    results: &[SetResult],
    places: &[(usize, &str)],
    metric: Metric,
    title: &str,
    y_label: &str,
) -> LinePlot {
    let series = places.iter().enumerate().map(|(k, &(place, name))| {
        let (y, errors) = over_sets(results, place, metric).into_iter().unzip();
        // Shifted, so that points do not hide each other.
        let aside = (k as f64 - 0.5 * (places.len() as f64 - 1.0)) * 0.12;
        let x = results.iter().map(|set| f64::from(set.set) + aside);
        Series::new(name, x.collect(), y, Style::Points, k).with_errors(errors)
    });
    LinePlot {
        title: title.into(),
        x_label: "set".into(),
        x_whole: true,
        y_label: y_label.into(),
        series: series.collect(),
        ..LinePlot::default()
    }
}

/// The steps of one galaxy at S/N 10, 20 and 40, as in Fig. 3, if the plan has the configuration of that figure.
pub fn steps(plan: &Plan) -> Result<Vec<ImageRow>, PipelineError> {
    let configuration = plan.configurations.iter().find(|own| own.name == RAW);
    let measurers = measurers(configuration.map_or(&[][..], std::slice::from_ref))?;
    let mut rows = Vec::new();
    for measurer in &measurers {
        for (set, snr) in [(5, 10), (2, 20), (8, 40)] {
            let simulator = simulator(set, plan.simulation)?;
            if let Some(steps) = simulated_steps(&simulator, measurer, 1, (1, 1))? {
                rows.push(steps_row(&format!("S/N {snr}"), steps));
            }
        }
    }
    Ok(rows)
}

/// Sects 3 to 5: the steps of the method, the calibration of λ, Table 1 and Figs 4 to 11.
pub fn exhibits(
    page: &mut Page<'_>,
    steps: Vec<ImageRow>,
    (curves, calibration): (&Curves, &Table),
    table_one: &Table,
    results: &[SetResult],
    names: &[String],
) -> Result<(), PageError> {
    page.section("The method (Sect. 3)", SECT_THREE);
    if !steps.is_empty() {
        page.figure(
            "fig3-steps",
            &steps_figure(RAW, steps),
            "As Fig. 3 of the paper: from a stamp to its clipped autocorrelation, for a galaxy at S/N 10, 20 and 40.",
        )?;
    }
    page.section("Calibration of λ (Sect. 4)", SECT_FOUR);
    calibration::figures(page, curves)?;
    page.table("calibration", calibration)?;
    page.section("Configurations (Sect. 5)", SECT_FIVE);
    page.table("table1", table_one)?;
    let all: Vec<(usize, &str)> = names.iter().map(String::as_str).enumerate().collect();
    let title = "Quality factor per set";
    page.figure(
        "fig8-q-per-set",
        &metric_per_set(results, &all, |f| f.q, title, "Q"),
        "As Fig. 8 of the paper: quality factor per set and configuration.",
    )?;
    let [at_raw, at_den] = [RAW, DENOISED].map(|name| names.iter().position(|own| own == name));
    if let (Some(at_raw), Some(at_den)) = (at_raw, at_den) {
        let both = [(at_raw, RAW), (at_den, DENOISED)];
        let images = results.first().map_or(0, |set| set.images);
        let (figure, table) = power_spectra(results, at_den, DENOISED);
        let caption = format!(
            "As Fig. 9 of the paper: true and measured shear power spectra of 23/den/star. The measured spectra contain the noise of {images} images."
        );
        page.figure("fig9-power-spectra", &figure, &caption)?;
        page.data("fig9-power-spectra", &table)?;
        let title = "Multiplicative bias per set";
        page.figure(
            "fig10-multiplicative",
            &metric_per_set(results, &both, |f| f.m_half, title, "M/2"),
            "As Fig. 10 of the paper: multiplicative bias per set.",
        )?;
        let title = "Additive bias per set";
        page.figure(
            "fig11-additive",
            &metric_per_set(results, &both, |f| f.sqrt_a, title, "√A × 10⁴"),
            "As Fig. 11 of the paper: additive bias per set.",
        )?;
    }
    page.section("Every set", "The data of the figures per set.");
    page.table("fig8-11-per-set", &per_set_table(results))
}
