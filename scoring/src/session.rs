//! One set of images: summed, examined and scored. Whoever scores a set does it here, so that all find the same faults.

use std::collections::HashMap;
use std::f64::consts::PI;
use std::hash::{DefaultHasher, Hash, Hasher};

use crate::catalogue::{FieldSum, RowCounts, SetImages, TrueShear};
use crate::convention::{Convention, ConventionMatch};
use crate::diagnosis::{Fault, ImageResponse, Repeated, repeated};
use crate::error::ScoringError;
use crate::grid::Grid;
use crate::score::{Choice, Options, SetScore, SetScorer};

// Chance that an image of a set is reported whose response differs by noise only. Over the 24 sets of the challenge
// this is at most 2.4 %, and less in fact, because the bound of the normal distribution below is not tight.
const FALSE_ALARM_PROBABILITY: f64 = 1e-3;
// Least relative difference of an image's response from that of the others. Images of one set with other PSFs or
// noise respond differently too, in S/N 10 against 20 by 0.2; a wrong order, sign or type changes it by 1 or more.
const MIN_RELATIVE_SLOPE_CHANGE: f64 = 0.4;
// Standard deviation of a normal distribution in median absolute deviations.
const SIGMA_OF_MAD: f64 = 1.4826;
// Side of the cells within which ellipticities count as equal. Chosen by hand: 1 % of the least scatter of a shape, 0.01.
const EQUAL_SHAPES: f64 = 1e-4;

/// A set to be scored: its grid, its true shear if it is known, and the options.
///
/// [`SetSession::examine`] takes the images in any order and thread, [`SetSession::begin`] collects them in the order of the
/// set. The memory is that of some twenty grids for any number of images.
#[derive(Debug, Clone)]
pub struct SetSession {
    grid: Grid,
    scorer: Option<SetScorer>,
}

/// An image of a set, on the grid and compared with the true shear.
#[derive(Debug, Clone)]
pub struct ExaminedImage {
    sum: FieldSum,
    rows: RowCounts,
    repeated: Option<Repeated<2>>,
    // Equal for copies. `None` if the image has no galaxy, or one value, which makes no copies.
    print: Option<u64>,
    // In each convention that the metrics may have.
    responses: Vec<(Convention, ImageResponse)>,
}

/// The images of a set that were added so far, in order.
#[derive(Debug, Clone)]
pub struct AddedImages<'s> {
    session: &'s SetSession,
    images: SetImages,
    rows: RowCounts,
    first_of_print: HashMap<u64, usize>,
    copies: Vec<(usize, usize)>,
    repeated: Vec<(usize, Repeated<2>)>,
    responses: Vec<(usize, Convention, ImageResponse)>,
}

/// A scored set, with its probable faults.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct ScoredImages {
    /// Spectra and metrics.
    pub score: SetScore,
    /// How the rows of the catalogues were used.
    pub rows: RowCounts,
    /// Faults of the whole set, most important first, without those that `odd` images explain.
    pub findings: Vec<Fault>,
    /// Faults of single images.
    pub odd: OddImages,
}

/// Images of a set with faults that the sum over images does not show. Images count from 0 in the order added.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct OddImages {
    /// Images with the ellipticities of an earlier one: the copy, and the first.
    pub copies: Vec<(usize, usize)>,
    /// Images in which galaxies share ellipticities that no measurement repeats.
    pub repeated: Vec<(usize, Repeated<2>)>,
    /// Images that follow the true shear differently from the others of the set. Those with repeated ellipticities are not
    /// among them.
    // One catalogue of several with x and y exchanged, or of another set, changed m by 0.17 to 0.33 without a warning.
    pub responses: Vec<OddResponse>,
}

/// An image that follows the true shear differently from the other images of its set.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OddResponse {
    /// Place of the image, from 0.
    pub place: usize,
    /// Its response.
    pub response: ImageResponse,
    /// Median slope of all images.
    pub slope: f64,
    /// Median correlation of all images.
    pub correlation: f64,
}

impl SetSession {
    /// A set of galaxies on `grid`. Without a true shear, images are summed and compared with each other only.
    ///
    /// # Errors
    /// As [`SetScorer::new`].
    pub fn new(
        grid: Grid,
        truth: Option<TrueShear>,
        options: Options,
    ) -> Result<Self, ScoringError> {
        let scorer = truth.map(|truth| SetScorer::new(grid, truth, options));
        Ok(SetSession {
            grid,
            scorer: scorer.transpose()?,
        })
    }

    /// The grid of the galaxies.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// What scores the set; `None` without a true shear.
    pub fn scorer(&self) -> Option<&SetScorer> {
        self.scorer.as_ref()
    }

    /// Examines one image, whose ellipticities are divided by their response already, with the counts of its `rows`.
    ///
    /// # Errors
    /// If the shape of one of its arrays differs from the grid.
    pub fn examine(&self, sum: FieldSum, rows: RowCounts) -> Result<ExaminedImage, ScoringError> {
        sum.check_shape(self.grid.n)?;
        let shapes = shapes(&sum);
        let repeated = repeated(&shapes, EQUAL_SHAPES);
        let constant = repeated.is_some_and(|found| found.is_constant());
        let print = (!shapes.is_empty() && !constant).then(|| print_of(&sum));
        let responses = self.scorer.as_ref().map_or_else(Vec::new, |scorer| {
            // Until all images are added, the matched convention is not known. To compare in all eight costs less than to
            // read the catalogues twice, and all images of a set would need gigabytes.
            let conventions = match scorer.choice() {
                Choice::Insist(convention) => vec![convention],
                Choice::Matched | Choice::Best => Convention::ALL.into(),
            };
            let of = |convention| Some((convention, scorer.response(&sum, convention)?));
            conventions.into_iter().filter_map(of).collect()
        });
        Ok(ExaminedImage {
            sum,
            rows,
            repeated,
            print,
            responses,
        })
    }

    /// Starts to add images.
    pub fn begin(&self) -> AddedImages<'_> {
        AddedImages {
            session: self,
            images: SetImages::new(&self.grid),
            rows: RowCounts::default(),
            first_of_print: HashMap::new(),
            copies: Vec::new(),
            repeated: Vec::new(),
            responses: Vec::new(),
        }
    }
}

impl ExaminedImage {
    /// Ellipticities that several galaxies share, as placeholders do.
    pub fn repeated(&self) -> Option<&Repeated<2>> {
        self.repeated.as_ref()
    }
}

impl AddedImages<'_> {
    /// Adds the next image.
    ///
    /// # Errors
    /// If it is a sum of no image or of several.
    pub fn add(&mut self, image: &ExaminedImage) -> Result<(), ScoringError> {
        let place = self.images.total().images;
        self.images.add(&image.sum)?;
        self.rows += image.rows;
        self.repeated
            .extend(image.repeated.map(|found| (place, found)));
        if let Some(print) = image.print {
            let first = *self.first_of_print.entry(print).or_insert(place);
            if first != place {
                self.copies.push((place, first));
            }
        }
        let responses = image.responses.iter();
        self.responses
            .extend(responses.map(|&(convention, found)| (place, convention, found)));
        Ok(())
    }

    /// The sums of the images.
    pub fn images(&self) -> &SetImages {
        &self.images
    }

    /// How the rows of all images were used.
    pub fn rows(&self) -> &RowCounts {
        &self.rows
    }

    /// How well each convention correlates with the true shear.
    ///
    /// # Errors
    /// If there is no image or no true shear.
    pub fn match_convention(&self) -> Result<ConventionMatch, ScoringError> {
        self.scored_by()?.match_convention(&self.images)
    }

    /// Faults of single images, whose responses are those in `convention`.
    pub fn odd(&self, convention: Convention) -> OddImages {
        OddImages {
            copies: self.copies.clone(),
            repeated: self.repeated.clone(),
            responses: self.odd_responses(convention),
        }
    }

    /// Scores the images and looks for probable faults.
    ///
    /// # Errors
    /// If there is no image or no true shear.
    pub fn finish(&self) -> Result<ScoredImages, ScoringError> {
        let scorer = self.scored_by()?;
        let score = scorer.score(&self.images)?;
        // The convention with the highest Q may be wrong, so that faults are sought in the matched one.
        let convention = match scorer.choice() {
            Choice::Best => score.matching.convention(),
            Choice::Matched | Choice::Insist(_) => score.chosen,
        };
        let odd = self.odd(convention);
        let mut findings = scorer.diagnose(&self.images, &score, convention)?;
        findings.retain(|fault| !odd.explain(fault));
        Ok(ScoredImages {
            score,
            rows: self.rows,
            findings,
            odd,
        })
    }

    fn scored_by(&self) -> Result<&SetScorer, ScoringError> {
        self.session.scorer.as_ref().ok_or(ScoringError::NoTruth)
    }

    // An image differs if its slope s is farther from the median s₀ than `MIN_RELATIVE_SLOPE_CHANGE` × |s₀| and than
    // √(2 ln(K/p)) σ for K images and a chance p of a false alarm, because 2Q(z) ≤ exp(−z²/2). σ contains the errors of s and
    // s₀, or the scatter of all slopes if that is larger.
    fn odd_responses(&self, convention: Convention) -> Vec<OddResponse> {
        let own = self.responses.iter().filter(|own| own.1 == convention);
        let all: Vec<(usize, ImageResponse)> = own.map(|own| (own.0, own.2)).collect();
        if all.len() < 2 {
            return Vec::new();
        }
        let of = |value: fn(&ImageResponse) -> f64| all.iter().map(move |(_, own)| value(own));
        let slope = median(of(|own| own.slope), 1.0);
        let correlation = median(of(|own| own.correlation), 1.0);
        let apart = of(|own| own.slope).map(|own| (own - slope).abs());
        let images = all.len() as f64;
        // The median deviation of few images is noisy: its relative error is 1.17/√K (Rousseeuw & Croux 1993). Only what
        // exceeds twice this error is scatter that the noise of the images does not explain.
        let scatter = SIGMA_OF_MAD * median(apart, 0.0) / (1.0 + 2.0 * 1.17 / images.sqrt());
        // The variance of a median is π/2 times that of a mean; of two slopes it is that of one.
        let error = median(of(|own| own.error), 0.0);
        let of_median = error * (0.5 * PI / (images - 1.0)).sqrt().min(1.0);
        let clear = (2.0 * (images / FALSE_ALARM_PROBABILITY).ln()).sqrt();
        let differs = |(place, own): &&(usize, ImageResponse)| {
            let sigma = own.error.hypot(of_median).max(scatter);
            let apart = (own.slope - slope).abs();
            apart > MIN_RELATIVE_SLOPE_CHANGE * slope.abs()
                && apart > clear * sigma
                && !self.repeated.iter().any(|(repeated, _)| repeated == place)
        };
        let odd = all
            .iter()
            .filter(differs)
            .map(|&(place, response)| OddResponse {
                place,
                response,
                slope,
                correlation,
            });
        odd.collect()
    }
}

impl OddImages {
    /// Whether such images are the probable cause of a fault of the whole set: copies appear to have no noise, so that any
    /// correlation seems too low, and images of one value have no response.
    pub fn explain(&self, fault: &Fault) -> bool {
        match fault {
            Fault::Uncorrelated { .. } => !self.copies.is_empty(),
            Fault::Biased { .. } => self.repeated.iter().any(|(_, found)| found.is_constant()),
            _ => false,
        }
    }
}

// The median; of the two middle values of an even number the one nearer to `expected`, so that two images of which one is
// wrong do not meet halfway.
fn median(values: impl Iterator<Item = f64>, expected: f64) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    let (below, above) = (values[(values.len() - 1) / 2], values[values.len() / 2]);
    match (below - expected).abs() < (above - expected).abs() {
        true => below,
        false => above,
    }
}

// Ellipticities of the galaxies of an image.
fn shapes(image: &FieldSum) -> Vec<[f64; 2]> {
    let cells = image.e1.iter().zip(&image.e2).zip(&image.count);
    let filled = cells.filter(|(_, count)| **count > 0.0);
    filled
        .map(|((e1, e2), count)| [e1 / count, e2 / count])
        .collect()
}

fn print_of(image: &FieldSum) -> u64 {
    let mut hasher = DefaultHasher::new();
    for values in [&image.e1, &image.e2, &image.count] {
        // Adding zero removes the sign of a negative zero.
        values
            .iter()
            .for_each(|v| (v + 0.0).to_bits().hash(&mut hasher));
    }
    hasher.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid() -> Grid {
        Grid::great10(8).unwrap()
    }

    fn image(value: impl Fn(usize) -> (f64, f64)) -> FieldSum {
        let mut sum = blank();
        for k in 0..64 {
            let at = (k % 8, k / 8);
            (sum.e1[at], sum.e2[at]) = value(k);
            sum.count[at] = 1.0;
        }
        sum
    }

    fn blank() -> FieldSum {
        FieldSum {
            images: 1,
            ..FieldSum::new(&grid())
        }
    }

    #[test]
    fn copies_and_constant_images_are_found() {
        let session = SetSession::new(grid(), None, Options::default()).unwrap();
        let mut added = session.begin();
        let varied = |k: usize| (k as f64, -(k as f64));
        for sum in [
            image(varied),
            blank(),
            image(|_| (0.0, 0.0)),
            image(|k| (-(k as f64), k as f64)),
            image(varied),
            blank(),
            image(|_| (0.1, 0.2)),
        ] {
            let image = session.examine(sum, RowCounts::default()).unwrap();
            added.add(&image).unwrap();
        }
        let odd = added.odd(Convention::STANDARD);
        assert_eq!(odd.copies, [(4, 0)]);
        let places: Vec<usize> = odd.repeated.iter().map(|(place, _)| *place).collect();
        assert_eq!(places, [2, 6]);
        assert!(matches!(added.finish(), Err(ScoringError::NoTruth)));
    }
}
