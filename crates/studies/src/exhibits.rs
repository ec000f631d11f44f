//! Sect. 5 of the paper from the results of its configurations: Table 1, Figs 8 to 11, and the effect of denoising on
//! ellipticities.

use shearq_render::figure::{ColourMap, HeatMap, LinePlot, PanelGrid, Series, Style};
use shearq_render::table::{Cell, Table};
use shearq_results::views::spectrum;
use shearq_scoring::Metrics;
use shearq_simulate::kinds::{ImageType, SetKind, shares};
use shearq_submissions::{Configuration, PsfForm, Published};

use crate::reproduce::{ConfigurationResult, SetResult};
use crate::response::Response;

// Images per set of the challenge. The published metrics contain the noise of so many images.
const PUBLISHED_IMAGES: u32 = 200;

type Metric = fn(&Metrics) -> f64;

// Keys of our, the published and the distance column, label, unit, our and the published metric, and its decimals.
type Beside = (
    [&'static str; 3],
    &'static str,
    &'static str,
    Metric,
    fn(&Published) -> f64,
    usize,
);

fn over_sets(results: &[SetResult], place: usize, metric: Metric) -> Vec<(f64, f64)> {
    let score = |set: &SetResult| {
        let score = &set.results[place].score;
        (metric(&score.metrics), metric(&score.errors))
    };
    results.iter().map(score).collect()
}

// Mean of values with errors over the challenge's 24 sets.
fn weighted(results: &[SetResult], values: &[(f64, f64)]) -> (f64, f64) {
    let sets: Vec<u32> = results.iter().map(|set| set.set).collect();
    // One simulated set may stand for several of the challenge, so that it counts as often as its kind does there.
    let weighted = values.iter().zip(shares(&sets));
    let (mean, variance) =
        weighted.fold((0.0, 0.0), |(mean, variance), ((value, error), share)| {
            (mean + share * value, variance + (share * error).powi(2))
        });
    (mean, variance.sqrt())
}

fn mean_of_24(results: &[SetResult], place: usize, metric: Metric) -> (f64, f64) {
    weighted(results, &over_sets(results, place, metric))
}

fn measured((value, error): (f64, f64), decimals: usize) -> Cell {
    Cell::with_error(value, Some(error), decimals)
}

fn kind_of(set: u32) -> &'static str {
    SetKind::of(set).map_or("", |kind| kind.image.label())
}

/// Table 1: our metrics beside the published ones.
pub fn table_one(results: &[SetResult], configurations: &[(Configuration, Published)]) -> Table {
    // With fewer images, noise alone would put our metrics many errors from the published ones.
    let as_published = results.iter().all(|set| set.images == PUBLISHED_IMAGES);
    let rows: Vec<_> = configurations.iter().enumerate().collect();
    let yes = |yes: bool| Cell::text(if yes { "Y" } else { "N" });
    let mut table = Table::titled("Table 1: configurations over all sets (simulated data)");
    table.column("method", "Method", &rows, |(_, (own, _))| {
        Cell::text(&own.name)
    });
    let size = |own: &Configuration| Cell::text(format!("{0}×{0}", own.stamp.size));
    let details = [
        table.column("size", "Size", &rows, |(_, (own, _))| size(own)),
        table.column("denoised", "Den", &rows, |(_, (own, _))| {
            yes(own.wavelet().is_some())
        }),
        table.column("psf", "PSF", &rows, |(_, (own, _))| {
            Cell::text(match own.psf.form {
                PsfForm::Star => "Star",
                PsfForm::Functional => "Func",
            })
        }),
    ];
    let mean =
        |place: usize, metric, decimals| measured(mean_of_24(results, place, metric), decimals);
    let beside: [Beside; 3] = [
        (
            ["m_half", "m_half_published", "m_half_apart"],
            "M/2",
            "",
            |f| f.m_half,
            |p| p.m_half,
            4,
        ),
        (
            ["sqrt_a", "sqrt_a_published", "sqrt_a_apart"],
            "√A",
            "×10⁴",
            |f| f.sqrt_a,
            |p| p.sqrt_a,
            4,
        ),
        (
            ["q", "q_published", "q_apart"],
            "Q",
            "",
            |f| f.q,
            |p| p.q,
            2,
        ),
    ];
    let mut apart = Vec::new();
    for ([own, publ, distance], label, unit, metric, value, decimals) in beside {
        table.column(own, format!("{label}{unit}"), &rows, |(place, _)| {
            mean(*place, metric, decimals)
        });
        table.column(publ, format!("{label} publ."), &rows, |(_, (_, publ))| {
            Cell::number(value(publ), decimals)
        });
        let label = format!("{label} apart");
        apart.push(table.column(distance, label, &rows, |(place, (_, publ))| {
            // The paper gives no errors, so that ours alone are the unit.
            let (mean, error) = mean_of_24(results, *place, metric);
            match as_published {
                true => Cell::number((mean - value(publ)) / error, 1),
                false => Cell::Empty,
            }
        }));
    }
    table.column("q_calibrated", "Q calibrated", &rows, |(place, _)| {
        mean(*place, |f| f.q_calibrated, 2)
    });
    table.column("q_dn", "Q_dn", &rows, |(place, _)| {
        mean(*place, |f| f.q_dn, 1)
    });
    table.column("m_cross", "m (cross)", &rows, |(place, _)| {
        mean(*place, |f| f.m_cross, 4)
    });
    let apart = apart.into_iter().filter(|_| !as_published);
    for place in details.into_iter().chain(apart) {
        table.headings[place].detail = true;
    }
    table.notes = vec![
        "Q calibrated: after dividing the bandpowers by (1 + m)², with m by cross-correlation with the truth; unknown if the response of a set is less than 3σ above zero.".into(),
        format!("Apart: our metric minus the published one, in our standard errors, if sets have {PUBLISHED_IMAGES} images as in the challenge."),
        "Means over sets: each kind of image counts as often as among the challenge's 24 sets; absent kinds do not count.".into(),
        "Standard convention, leaderboard definition. Errors come from the part of the spectra that the truth does not explain. Published metrics refer to the challenge's images, 200 per set.".into(),
    ];
    table
}

/// Fig. 8: Q per set and configuration.
pub fn q_per_set(results: &[SetResult], names: &[String]) -> HeatMap {
    let mut columns: Vec<String> = results.iter().map(|set| set.set.to_string()).collect();
    columns.push("mean".into());
    let values = ndarray::Array2::from_shape_fn((names.len(), columns.len()), |(place, k)| {
        let over = over_sets(results, place, |f| f.q);
        let mean = || mean_of_24(results, place, |f| f.q);
        over.get(k).copied().unwrap_or_else(mean).0
    });
    HeatMap {
        title: "Quality factor per set".into(),
        row_label: "configuration".into(),
        column_label: "set".into(),
        rows: names.to_vec(),
        columns,
        values,
        decimals: 1,
        value_label: "Q".into(),
        map: ColourMap::Viridis,
    }
}

/// Metrics of every set and configuration: the data of Figs 8, 10 and 11.
pub fn per_set_table(results: &[SetResult]) -> Table {
    let rows: Vec<(u32, &ConfigurationResult)> = results
        .iter()
        .flat_map(|set| set.results.iter().map(|own| (set.set, own)))
        .collect();
    let mut table = Table::titled("Every set and configuration");
    table.column("set", "Set", &rows, |(set, _)| {
        Cell::number(f64::from(*set), 0)
    });
    table.column("kind", "Kind", &rows, |(set, _)| Cell::text(kind_of(*set)));
    table.column("submission", "Configuration", &rows, |(_, own)| {
        Cell::text(&own.configuration)
    });
    let metric = |table: &mut Table, key, label: &str, metric: Metric, decimals| {
        table.column(key, label, &rows, |(_, own)| {
            let score = &own.score;
            measured((metric(&score.metrics), metric(&score.errors)), decimals)
        });
    };
    metric(&mut table, "q", "Q", |f| f.q, 2);
    table.column("q_leaderboard", "Q leaderboard", &rows, |(_, own)| {
        Cell::number(own.score.q_leaderboard, 2)
    });
    metric(&mut table, "q_dn", "Q_dn", |f| f.q_dn, 1);
    metric(&mut table, "m_half", "M/2", |f| f.m_half, 4);
    metric(&mut table, "sqrt_a", "√A×10⁴", |f| f.sqrt_a, 4);
    metric(&mut table, "m_cross", "m (cross)", |f| f.m_cross, 4);
    table.column("conventions", "Conv. matched/best", &rows, |(_, own)| {
        let best = own.score.convention_leaderboard;
        Cell::text(format!("{}/{best}", own.convention_matched))
    });
    metric(
        &mut table,
        "q_calibrated",
        "Q calibrated",
        |f| f.q_calibrated,
        2,
    );
    for (k, key, label) in [(0, "slope1", "slope e1"), (1, "slope2", "slope e2")] {
        table.column(key, label, &rows, |(_, own)| {
            measured((own.response.slope[k], own.response.slope_error[k]), 3)
        });
    }
    table.column("scatter", "scatter / slope", &rows, |(_, own)| {
        let response = &own.response;
        measured((response.rms_scatter(), response.rms_scatter_error()), 4)
    });
    table.column("flagged", "Flagged", &rows, |(_, own)| {
        Cell::number(own.response.flagged as f64, 0)
    });
    table
}

/// Fig. 9: true and measured shear power spectra, a panel per set.
pub fn power_spectra(results: &[SetResult], place: usize, name: &str) -> PanelGrid {
    let panel = |set: &SetResult| {
        let own = &set.results[place];
        let powers = [&set.l, &set.true_ee, &own.ee, &own.ee_error];
        spectrum::panel(Some(set.set), SetKind::of(set.set), powers, None)
    };
    PanelGrid {
        title: format!("Shear power spectra of {name}"),
        columns: 4,
        plots: results.iter().map(panel).collect(),
    }
}

/// The data of Fig. 9.
pub fn power_spectra_table(results: &[SetResult], place: usize) -> Table {
    let rows: Vec<(&SetResult, usize)> = results
        .iter()
        .flat_map(|set| spectrum::bins(&set.l).map(move |b| (set, b)))
        .collect();
    let mut table = Table::titled("Shear power spectra");
    table.column("set", "Set", &rows, |(set, _)| {
        Cell::number(f64::from(set.set), 0)
    });
    table.column("bin", "Bin", &rows, |(_, b)| {
        Cell::number(*b as f64 + 1.0, 0)
    });
    table.column("l", "ℓ", &rows, |(set, b)| Cell::number(set.l[*b], 1));
    table.column("true", "true", &rows, |(set, b)| {
        Cell::number(set.true_ee[*b], 9)
    });
    table.column("measured", "measured", &rows, |(set, b)| {
        let own = &set.results[place];
        measured((own.ee[*b], own.ee_error[*b]), 9)
    });
    table
}

/// Figs 10 and 11: M/2 or √A per set for the configurations at `places`.
pub fn bias_per_set(
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

/// Slope, scatter and offset of ellipticities at S/N 10, 20 and 40 with and without denoising: the
/// means over the sets of these kinds for the configurations at `places`.
pub fn denoising_table(results: &[SetResult], places: &[(usize, &str)]) -> Table {
    let kinds = [
        (10.0, ImageType::LowSnr),
        (20.0, ImageType::Fiducial),
        (40.0, ImageType::HighSnr),
    ];
    let mut rows: Vec<(f64, &str, Vec<Response>)> = Vec::new();
    for (snr, kind) in kinds {
        for &(place, name) in places {
            let own = |set: &&SetResult| SetKind::of(set.set).is_some_and(|own| own.image == kind);
            let responses = results.iter().filter(own);
            let responses: Vec<_> = responses.map(|set| set.results[place].response).collect();
            if !responses.is_empty() {
                rows.push((snr, name, responses));
            }
        }
    }
    let mut table = Table::titled("Ellipticities with and without denoising (simulated data)");
    table.column("snr", "S/N", &rows, |(snr, ..)| Cell::number(*snr, 0));
    table.column("submission", "Configuration", &rows, |(_, name, _)| {
        Cell::text(*name)
    });
    let mut mean = |key, label, of: &dyn Fn(&Response) -> (f64, f64), decimals| {
        table.column(key, label, &rows, |(_, _, responses)| {
            // Sets have the same number of galaxies, so that an unweighted mean is the best.
            let count = responses.len() as f64;
            let all = responses.iter().map(of);
            let (value, square) = all.fold((0.0, 0.0), |(value, square), (v, error)| {
                (value + v, square + error * error)
            });
            measured((value / count, square.sqrt() / count), decimals)
        });
    };
    mean("slope1", "slope e1", &|r| (r.slope[0], r.slope_error[0]), 3);
    mean("slope2", "slope e2", &|r| (r.slope[1], r.slope_error[1]), 3);
    let scatter = |r: &Response| (r.rms_scatter(), r.rms_scatter_error());
    mean("scatter", "scatter / slope", &scatter, 4);
    mean(
        "offset1",
        "offset e1",
        &|r| (r.offset[0], r.offset_error[0]),
        4,
    );
    mean(
        "offset2",
        "offset e2",
        &|r| (r.offset[1], r.offset_error[1]),
        4,
    );
    table.notes = vec![
        "Reported ellipticity against the true shear-type one of each galaxy; scatter per component about the line, divided by the slope.".into(),
    ];
    table
}
