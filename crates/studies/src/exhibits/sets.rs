//! Sect. 5: Table 1, Figs 8 to 11, and the effect of denoising on ellipticities.

use shearq_scoring::Metrics;
use shearq_submissions::{Configuration, PsfForm, Published};

use crate::reproduce::SetResult;
use crate::response::Response;
use shearq_render::figure::{ColourMap, HeatMap, LinePlot, PanelGrid, Series, Style};
use shearq_render::table::{Cell, Heading, Table};
use shearq_results::views::spectrum;
use shearq_simulate::kinds::{ImageType, SetKind, shares};

/// A metric of one configuration over sets, with its errors.
pub(super) fn over_sets(
    results: &[SetResult],
    place: usize,
    metric: fn(&Metrics) -> f64,
) -> Vec<(f64, f64)> {
    results
        .iter()
        .map(|set| &set.results[place].score)
        .map(|score| (metric(&score.metrics), metric(&score.errors)))
        .collect()
}

/// Images per set of the challenge. The published metrics contain the noise of so many images.
const PUBLISHED_IMAGES: u32 = 200;

/// Mean of values with errors over the challenge's 24 sets: a kind counts as often as in the challenge.
pub(super) fn weighted(results: &[SetResult], values: &[(f64, f64)]) -> (f64, f64) {
    let sets: Vec<u32> = results.iter().map(|set| set.set).collect();
    let shares = shares(&sets);
    let weighted = values.iter().zip(&shares);
    let mean = weighted
        .clone()
        .map(|((value, _), share)| share * value)
        .sum();
    let variance: f64 = weighted
        .map(|((_, error), share)| (share * error).powi(2))
        .sum();
    (mean, variance.sqrt())
}

/// Mean of a metric of one configuration over the challenge's 24 sets, and its error.
pub(super) fn mean_of_24(
    results: &[SetResult],
    place: usize,
    metric: fn(&Metrics) -> f64,
) -> (f64, f64) {
    weighted(results, &over_sets(results, place, metric))
}

/// Table 1: our metrics beside the published ones.
pub fn table_one(results: &[SetResult], submissions: &[(Configuration, Published)]) -> Table {
    let as_published = results.iter().all(|set| set.images == PUBLISHED_IMAGES);
    let mut rows = Vec::new();
    for (place, (configuration, published)) in submissions.iter().enumerate() {
        let mean = |metric: fn(&Metrics) -> f64, decimals: usize| {
            let (value, error) = mean_of_24(results, place, metric);
            Cell::with_error(value, Some(error), decimals)
        };
        let given = |value: fn(&Published) -> f64, decimals: usize| {
            Cell::number(value(published), decimals)
        };
        let apart = |metric: fn(&Metrics) -> f64, value: fn(&Published) -> f64| {
            if !as_published {
                return Cell::Empty;
            }
            let (mean, error) = mean_of_24(results, place, metric);
            Cell::number((mean - value(published)) / error, 1)
        };
        let yes = |yes: bool| Cell::text(if yes { "Y" } else { "N" });
        rows.push(vec![
            Cell::text(&configuration.name),
            Cell::text(format!("{0}×{0}", configuration.stamp.size)),
            yes(configuration.wavelet().is_some()),
            Cell::text(match configuration.psf.form {
                PsfForm::Star => "Star",
                PsfForm::Functional => "Func",
            }),
            mean(|f| f.m_half, 4),
            given(|p| p.m_half, 4),
            apart(|f| f.m_half, |p| p.m_half),
            mean(|f| f.sqrt_a, 4),
            given(|p| p.sqrt_a, 4),
            apart(|f| f.sqrt_a, |p| p.sqrt_a),
            mean(|f| f.q, 2),
            given(|p| p.q, 2),
            apart(|f| f.q, |p| p.q),
            mean(|f| f.q_calibrated, 2),
            mean(|f| f.q_dn, 1),
            mean(|f| f.m_cross, 4),
        ]);
    }
    let apart = |key, label| Heading {
        detail: !as_published,
        ..Heading::new(key, label)
    };
    Table {
        title: "Table 1: configurations over all sets (simulated data)".into(),
        headings: vec![
            Heading::new("method", "Method"),
            Heading::new("size", "Size").detail(),
            Heading::new("denoised", "Den").detail(),
            Heading::new("psf", "PSF").detail(),
            Heading::new("m_half", "M/2"),
            Heading::new("m_half_published", "M/2 publ."),
            apart("m_half_apart", "M/2 apart"),
            Heading::new("sqrt_a", "√A×10⁴"),
            Heading::new("sqrt_a_published", "√A publ."),
            apart("sqrt_a_apart", "√A apart"),
            Heading::new("q", "Q"),
            Heading::new("q_published", "Q publ."),
            apart("q_apart", "Q apart"),
            Heading::new("q_calibrated", "Q calibrated"),
            Heading::new("q_dn", "Q_dn"),
            Heading::new("m_cross", "m (cross)"),
        ],
        rows,
        notes: vec![
            "Q calibrated: after dividing the bandpowers by (1 + m)², with m by cross-correlation with the truth; unknown if the response of a set is less than 3σ above zero.".into(),
            format!("Apart: our metric minus the published one, in our standard errors, if sets have {PUBLISHED_IMAGES} images as in the challenge."),
            "Means over sets: each kind of image counts as often as among the challenge's 24 sets; absent kinds do not count.".into(),
            "Standard convention, leaderboard definition. Errors come from the part of the spectra that the truth does not explain. Published metrics refer to the challenge's images, 200 per set.".into(),
        ],
    }
}

fn set_labels(results: &[SetResult]) -> Vec<String> {
    results.iter().map(|set| set.set.to_string()).collect()
}

/// Fig. 8: Q per set and configuration.
pub fn q_per_set(results: &[SetResult], names: &[String]) -> HeatMap {
    let mut columns = set_labels(results);
    columns.push("mean".into());
    let values = ndarray::Array2::from_shape_fn((names.len(), columns.len()), |(place, k)| {
        let over = over_sets(results, place, |f| f.q);
        over.get(k)
            .map_or_else(|| mean_of_24(results, place, |f| f.q).0, |value| value.0)
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
    let mut rows = Vec::new();
    for set in results {
        for result in &set.results {
            let cell = |metric: fn(&Metrics) -> f64, decimals: usize| {
                Cell::with_error(
                    metric(&result.score.metrics),
                    Some(metric(&result.score.errors)),
                    decimals,
                )
            };
            rows.push(vec![
                Cell::number(f64::from(set.set), 0),
                Cell::text(SetKind::of(set.set).map_or("", |kind| kind.image.label())),
                Cell::text(&result.configuration),
                cell(|f| f.q, 2),
                Cell::number(result.score.q_leaderboard, 2),
                cell(|f| f.q_dn, 1),
                cell(|f| f.m_half, 4),
                cell(|f| f.sqrt_a, 4),
                cell(|f| f.m_cross, 4),
                Cell::text(format!(
                    "{}/{}",
                    result.convention_matched, result.score.convention_leaderboard
                )),
                cell(|f| f.q_calibrated, 2),
                Cell::with_error(
                    result.response.slope[0],
                    Some(result.response.slope_error[0]),
                    3,
                ),
                Cell::with_error(
                    result.response.slope[1],
                    Some(result.response.slope_error[1]),
                    3,
                ),
                Cell::with_error(
                    result.response.rms_scatter(),
                    Some(result.response.rms_scatter_error()),
                    4,
                ),
                Cell::number(result.response.flagged as f64, 0),
            ]);
        }
    }
    Table {
        title: "Every set and configuration".into(),
        headings: vec![
            Heading::new("set", "Set"),
            Heading::new("kind", "Kind"),
            Heading::new("submission", "Configuration"),
            Heading::new("q", "Q"),
            Heading::new("q_leaderboard", "Q leaderboard"),
            Heading::new("q_dn", "Q_dn"),
            Heading::new("m_half", "M/2"),
            Heading::new("sqrt_a", "√A×10⁴"),
            Heading::new("m_cross", "m (cross)"),
            Heading::new("conventions", "Conv. matched/best"),
            Heading::new("q_calibrated", "Q calibrated"),
            Heading::new("slope1", "slope e1"),
            Heading::new("slope2", "slope e2"),
            Heading::new("scatter", "scatter / slope"),
            Heading::new("flagged", "Flagged"),
        ],
        rows,
        notes: Vec::new(),
    }
}

/// Fig. 9: true and measured shear power spectra, a panel per set.
pub fn power_spectra(results: &[SetResult], place: usize, name: &str) -> PanelGrid {
    let plots = results
        .iter()
        .map(|set| {
            let own = &set.results[place];
            let powers = [&set.l, &set.true_ee, &own.ee, &own.ee_error];
            spectrum::panel(Some(set.set), SetKind::of(set.set), powers, None)
        })
        .collect();
    PanelGrid {
        title: format!("Shear power spectra of {name}"),
        columns: 4,
        plots,
    }
}

/// The data of Fig. 9.
pub fn power_spectra_table(results: &[SetResult], place: usize) -> Table {
    let mut rows = Vec::new();
    for set in results {
        for b in spectrum::bins(&set.l) {
            rows.push(vec![
                Cell::number(f64::from(set.set), 0),
                Cell::number(b as f64 + 1.0, 0),
                Cell::number(set.l[b], 1),
                Cell::number(set.true_ee[b], 9),
                Cell::with_error(
                    set.results[place].ee[b],
                    Some(set.results[place].ee_error[b]),
                    9,
                ),
            ]);
        }
    }
    Table {
        title: "Shear power spectra".into(),
        headings: vec![
            Heading::new("set", "Set"),
            Heading::new("bin", "Bin"),
            Heading::new("l", "ℓ"),
            Heading::new("true", "true"),
            Heading::new("measured", "measured"),
        ],
        rows,
        notes: Vec::new(),
    }
}

/// Figs 10 and 11: M/2 or √A per set for the configurations at `places`.
pub fn bias_per_set(
    results: &[SetResult],
    places: &[(usize, &str)],
    metric: fn(&Metrics) -> f64,
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
    let mut rows = Vec::new();
    for (snr, kind) in kinds {
        for &(place, name) in places {
            let responses: Vec<Response> = results
                .iter()
                .filter(|set| SetKind::of(set.set).is_some_and(|own| own.image == kind))
                .map(|set| set.results[place].response)
                .collect();
            if responses.is_empty() {
                continue;
            }
            // All sets have the same number of galaxies.
            let count = responses.len() as f64;
            let mean = |of: &dyn Fn(&Response) -> (f64, f64), decimals| {
                let (mut value, mut square) = (0.0, 0.0);
                for (v, error) in responses.iter().map(of) {
                    value += v;
                    square += error * error;
                }
                Cell::with_error(value / count, Some(square.sqrt() / count), decimals)
            };
            let slope = |k: usize| mean(&|r| (r.slope[k], r.slope_error[k]), 3);
            let offset = |k: usize| mean(&|r| (r.offset[k], r.offset_error[k]), 4);
            rows.push(vec![
                Cell::number(snr, 0),
                Cell::text(name),
                slope(0),
                slope(1),
                mean(&|r| (r.rms_scatter(), r.rms_scatter_error()), 4),
                offset(0),
                offset(1),
            ]);
        }
    }
    Table {
        title: "Ellipticities with and without denoising (simulated data)".into(),
        headings: vec![
            Heading::new("snr", "S/N"),
            Heading::new("submission", "Configuration"),
            Heading::new("slope1", "slope e1"),
            Heading::new("slope2", "slope e2"),
            Heading::new("scatter", "scatter / slope"),
            Heading::new("offset1", "offset e1"),
            Heading::new("offset2", "offset e2"),
        ],
        rows,
        notes: vec![
            "Reported ellipticity against the true shear-type one of each galaxy; scatter per component about the line, divided by the slope.".into(),
        ],
    }
}
