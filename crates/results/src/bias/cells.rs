//! Bins of one or more quantities.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use shearq_catalogue::expression::{Expression, has_long_integers, integers_of, is_long, texts_of};
use shearq_catalogue::request::{Binning, Edges, MAX_AXES, MAX_BINS, Request};
use shearq_catalogue::rows::rows;
use shearq_catalogue::source::{Reading, Source, each_part, sources};
use shearq_files::FileError;
use shearq_files::frames::polars::DataFrame;
use shearq_files::table::{self, Place};

use super::error::BiasFailure;

/// Half-open bins of a quantity, which contain their lower edge.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Axis {
    /// The quantity, as the user wrote it.
    pub of: String,
    /// Increasing.
    pub edges: Vec<f64>,
    /// The names of bins that contain one number or text each.
    pub classes: Option<Vec<String>>,
}

impl Axis {
    fn count(&self) -> usize {
        self.edges.len() - 1
    }

    fn bin_of(&self, value: f64) -> Option<usize> {
        let above = self.edges.partition_point(|edge| *edge <= value);
        (1..=self.count()).contains(&above).then(|| above - 1)
    }

    fn label(&self, bin: usize) -> String {
        let of = &self.of;
        if let Some(classes) = &self.classes {
            return format!("{of} {}", classes[bin]);
        }
        // Four significant digits.
        let edge = |edge: f64| {
            let rounded = format!("{edge:.3e}").parse::<f64>();
            rounded.unwrap_or(edge).to_string()
        };
        let [low, high] = [self.edges[bin], self.edges[bin + 1]];
        match (low == f64::MIN, high == f64::MAX) {
            (true, _) => format!("{of} below {}", edge(high)),
            (false, true) => format!("{of} from {}", edge(low)),
            _ => format!("{of} {} to {}", edge(low), edge(high)),
        }
    }
}

/// All combinations of the bins of up to three quantities, and one cell of galaxies outside of them.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Cells {
    pub axes: Vec<Axis>,
}

impl Cells {
    /// Number of cells; 0 without binned quantities.
    pub fn count(&self) -> usize {
        match self.axes.is_empty() {
            true => 0,
            false => self.axes.iter().map(Axis::count).product(),
        }
    }

    /// The cell of galaxies outside of all bins, or of all without bins.
    pub fn outside(&self) -> usize {
        self.count()
    }

    /// The cell of some values. `None` if a number is missing.
    pub fn of(&self, values: &[f64; MAX_AXES]) -> Option<usize> {
        let binned = self.axes.iter().zip(values);
        if binned.clone().any(|(_, value)| value.is_nan()) {
            return None;
        }
        let mut cell = 0;
        for (axis, value) in binned {
            match axis.bin_of(*value) {
                Some(bin) => cell = cell * axis.count() + bin,
                None => return Some(self.outside()),
            }
        }
        Some(cell)
    }

    // The bin of each quantity.
    fn bins(&self, cell: usize) -> Vec<usize> {
        let mut rest = cell;
        let mut bins = Vec::new();
        for axis in self.axes.iter().rev() {
            bins.push(rest % axis.count());
            rest /= axis.count();
        }
        bins.reverse();
        bins
    }

    pub fn label(&self, cell: usize) -> String {
        let bins = self.axes.iter().zip(self.bins(cell));
        let labels: Vec<String> = bins.map(|(axis, bin)| axis.label(bin)).collect();
        labels.join(", ")
    }

    /// Lower and upper edge of each quantity.
    pub fn ranges(&self, cell: usize) -> Vec<[f64; 2]> {
        let bins = self.axes.iter().zip(self.bins(cell));
        // The upper edge of the last bin is the number above its largest value: 4.000000000000001 above 4.
        let high = |edge: f64| {
            let below = edge.next_down();
            match below.to_string().len() < edge.to_string().len() {
                true => below,
                false => edge,
            }
        };
        bins.map(|(axis, bin)| [axis.edges[bin], high(axis.edges[bin + 1])])
            .collect()
    }

    /// The binned quantities.
    pub fn names(&self) -> String {
        let names: Vec<&str> = self.axes.iter().map(|axis| axis.of.as_str()).collect();
        names.join(", ")
    }

    /// Whether the user stated edges, so that a cell without galaxies is a mistake.
    pub fn are_stated(&self) -> bool {
        self.axes.iter().all(|axis| axis.classes.is_none())
    }
}

// Values from which the edges of bins with equally many galaxies are determined, at most: 8 MB, and edges to 0.1 % of the
// galaxies.
const SAMPLE: usize = 1 << 20;
// A column of fewer different whole numbers below 100 is one of classes, such as tomographic bins, which have different numbers
// of galaxies. Positions of stamps have few values, too. Chosen by hand.
const MAX_CLASSES: usize = 20;
const MAX_CLASS_NUMBER: f64 = 100.0;

// The different values of a quantity, and a sample of all.
#[derive(Default)]
struct Values {
    sample: Vec<f64>,
    different: BTreeSet<u64>,
}

// Numbers that sort as the real numbers do.
pub(super) fn key(value: f64) -> u64 {
    let bits = (value + 0.0).to_bits();
    if bits >> 63 == 1 {
        !bits
    } else {
        bits | 1 << 63
    }
}

fn of_key(key: u64) -> f64 {
    f64::from_bits(if key >> 63 == 1 {
        key & !(1 << 63)
    } else {
        !key
    })
}

/// The bins of a request. Edges that the user does not state follow from the galaxies without artificial shear.
pub(super) fn cells(reading: &Reading<'_>, all: &[Vec<Source>]) -> Result<Cells, BiasFailure> {
    let request = reading.request;
    let is_open = |binning: &Binning| !matches!(binning.edges, Edges::Given(_));
    let mut values: Vec<Values> = request.bins.iter().map(|_| Values::default()).collect();
    let (mut stride, mut number) = (1u64, 0u64);
    if request.bins.iter().any(is_open) {
        for (input, sources) in request.catalogues.iter().zip(all) {
            rows(&input.name, reading, sources, |item| {
                let (0, Ok(own)) = (item.sheared, item.selected.of(0).binned) else {
                    return;
                };
                for (values, value) in values.iter_mut().zip(own) {
                    if values.different.len() <= MAX_BINS {
                        values.different.insert(key(value));
                    }
                    if number.is_multiple_of(stride) {
                        values.sample.push(value);
                    }
                }
                number += 1;
                if values[0].sample.len() > SAMPLE {
                    // Every second value of the sample remains.
                    for values in &mut values {
                        let mut odd = false;
                        values.sample.retain(|_| {
                            odd = !odd;
                            odd
                        });
                    }
                    stride *= 2;
                }
            })?;
        }
    }
    let mut axes = Vec::new();
    for (binning, values) in request.bins.iter().zip(values) {
        axes.push(axis(binning, values, stride > 1)?);
    }
    let cells = Cells { axes };
    match cells.count() > MAX_BINS {
        true => Err(BiasFailure::ManyBins(cells.count())),
        false => Ok(cells),
    }
}

fn axis(binning: &Binning, mut values: Values, is_sample: bool) -> Result<Axis, BiasFailure> {
    let of = binning.of.text().to_owned();
    let classes = match &binning.edges {
        Edges::Given(edges) => {
            return Ok(Axis {
                of,
                edges: edges.clone(),
                classes: None,
            });
        }
        Edges::Values => true,
        Edges::Equal(count) => values.different.len() <= *count,
    };
    let different = values.different.len();
    if classes && different > MAX_BINS {
        return Err(BiasFailure::ManyValues { of });
    }
    if different == 0 {
        return Err(shearq_bias::BiasError::NoGalaxies.into());
    }
    if classes {
        let mut edges: Vec<f64> = values.different.iter().map(|key| of_key(*key)).collect();
        let names = edges.iter().map(f64::to_string).collect();
        edges.extend(edges.last().copied().map(f64::next_up));
        return Ok(Axis {
            of,
            edges,
            classes: Some(names),
        });
    }
    let Edges::Equal(count) = binning.edges else {
        return Err(BiasFailure::ManyValues { of });
    };
    let sample = &mut values.sample;
    sample.sort_unstable_by(f64::total_cmp);
    let is_class = |value: f64| value.fract() == 0.0 && value.abs() < MAX_CLASS_NUMBER;
    let few = different <= MAX_CLASSES
        && sample.len() >= MAX_CLASSES * different
        && values.different.iter().all(|key| is_class(of_key(*key)));
    let mut edges = vec![sample[0]];
    edges.extend((1..count).map(|k| sample[k * sample.len() / count]));
    edges.extend(sample.last().copied().map(f64::next_up));
    if few || !edges.windows(2).all(|pair| pair[0] < pair[1]) {
        return Err(BiasFailure::FewValues {
            of,
            bins: count,
            different,
        });
    }
    // A sample may lack the extreme values.
    if is_sample {
        edges[0] = f64::MIN;
        edges[count] = f64::MAX;
    }
    Ok(Axis {
        of,
        edges,
        classes: None,
    })
}

// Whether a file with types has texts in a column: '9' and '10' of a Parquet file are names of bins.
fn has_texts_in(place: &Place, name: &str) -> Result<bool, FileError> {
    if !table::has_types(&place.path) {
        return Ok(false);
    }
    let texts = table::first_texts(place)?;
    Ok(texts.iter().any(|(own, _)| own == name))
}

// A request, and the names of the bins of each of its quantities of texts.
type Numbered = (Request, Vec<Option<Axis>>);

/// The request with numbers in place of texts: bins of a column of texts are those of its number among them. Also the names of
/// the bins, by place.
pub(super) fn with_numbers(
    request: &Request,
    reading: &Reading<'_>,
) -> Result<Option<Numbered>, BiasFailure> {
    let is_class = |binning: &&Binning| binning.edges == Edges::Values;
    if !request.bins.iter().any(|own| is_class(&own)) {
        return Ok(None);
    }
    let plain = Request {
        bins: Vec::new(),
        ..request.clone()
    };
    let reading = Reading {
        request: &plain,
        truth: reading.truth.clone(),
        flip_g2: false,
    };
    let mut own = request.clone();
    let mut axes = vec![None; request.bins.len()];
    for (at, binning) in request
        .bins
        .iter()
        .enumerate()
        .filter(|(_, own)| is_class(own))
    {
        let Some(name) = binning.of.column() else {
            continue;
        };
        let (mut texts, mut integers) = (BTreeSet::new(), BTreeSet::new());
        let mut has_long = false;
        let mut add = |frame: &DataFrame| {
            match (texts_of(frame, name), integers_of(frame, name)) {
                (Some(values), _) if texts.len() <= MAX_BINS => {
                    texts.extend(values.flatten().map(str::to_owned));
                }
                (None, Some(values)) if integers.len() <= MAX_BINS => {
                    has_long |= has_long_integers(frame, name);
                    integers.extend(values.flatten());
                }
                _ => {}
            }
            Ok(())
        };
        // Numbers of a text table are read as texts, too.
        let mut has_texts = false;
        for input in &request.catalogues {
            for source in sources(input, &reading)? {
                let frame = source.frame.as_ref();
                each_part(&source.place, frame, &[name], &[name], &mut add)?;
                has_texts |= match frame {
                    Some(frame) => texts_of(frame, name).is_some(),
                    None => has_texts_in(&source.place, name)?,
                };
            }
        }
        let are_numbers = texts.iter().all(|text| text.trim().parse::<f64>().is_ok());
        // Floats would merge them.
        let mut long = texts.iter().filter_map(|text| text.trim().parse().ok());
        let by_texts = !texts.is_empty() && (has_texts || !are_numbers || long.any(is_long));
        if !by_texts && !has_long {
            continue;
        }
        if texts.len().max(integers.len()) > MAX_BINS {
            let of = binning.of.text().to_owned();
            return Err(BiasFailure::ManyValues { of });
        }
        let (classes, of): (Vec<String>, _) = match by_texts {
            true => {
                let texts: Vec<String> = texts.into_iter().collect();
                (texts.clone(), Expression::of_texts(name, texts))
            }
            false => {
                let names = integers.iter().map(i128::to_string).collect();
                let integers = integers.into_iter().collect();
                (names, Expression::of_integers(name, integers))
            }
        };
        let edges: Vec<f64> = (0..=classes.len()).map(|k| k as f64 + 0.5).collect();
        own.bins[at] = Binning {
            of,
            edges: Edges::Given(edges.clone()),
        };
        axes[at] = Some(Axis {
            of: binning.of.text().to_owned(),
            edges,
            classes: Some(classes),
        });
    }
    Ok(Some((own, axes)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn axis(edges: &[f64]) -> Axis {
        Axis {
            of: "x".into(),
            edges: edges.to_vec(),
            classes: None,
        }
    }

    #[test]
    fn bins_contain_their_lower_edges_only() {
        let cells = Cells {
            axes: vec![axis(&[1.0, 2.0, 4.0])],
        };
        let found = [0.5, 1.0, 1.9, 2.0, 3.9, 4.0].map(|value| cells.of(&[value, 0.0, 0.0]));
        assert_eq!(found, [2, 0, 0, 1, 1, 2].map(Some));
        assert_eq!(cells.of(&[f64::NAN, 0.0, 0.0]), None);
        assert_eq!(Cells::default().of(&[3.0; 3]), Some(0));
    }

    #[test]
    fn cells_of_two_quantities_have_an_edge_of_each() {
        let mut second = axis(&[0.0, 1.0, 2.0, 3.0]);
        second.of = "y".into();
        let cells = Cells {
            axes: vec![axis(&[1.0, 2.0, 4.0]), second],
        };
        assert_eq!(cells.count(), 6);
        let cell = cells.of(&[2.5, 1.5, 0.0]).unwrap();
        assert_eq!(cells.ranges(cell), [[2.0, 4.0], [1.0, 2.0]]);
        assert_eq!(cells.label(cell), "x 2 to 4, y 1 to 2");
        assert_eq!(cells.of(&[2.5, 3.0, 0.0]), Some(6));
        assert_eq!(cells.of(&[9.0, f64::NAN, 0.0]), None);
    }

    #[test]
    fn numbers_sort_as_their_keys() {
        let values = [-1e20, -2.0, -0.5, 0.0, 0.5, 1.0, 1e20];
        assert!(values.windows(2).all(|pair| key(pair[0]) < key(pair[1])));
        assert!(values.iter().all(|value| of_key(key(*value)) == *value));
        assert_eq!(key(-0.0), key(0.0));
    }
}
