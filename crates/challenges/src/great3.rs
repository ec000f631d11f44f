//! GREAT3 (Mandelbaum et al. 2014, ApJS 212, 5; results: 2015, MNRAS 450, 2963): branches, identities of galaxies, truth as
//! released, pre-submission and leaderboard.

mod files;
mod pack;
mod rules;
mod simulation;
mod simulator;

use std::path::Path;

use shearq_dataset::threads::{Pool, Progress};
use shearq_files::FileError;
use shearq_quantities::Shear;
use shearq_quantities::statistics::RunningMean;
use shearq_render::figure::{LinePlot, Series, Style};
use shearq_scoring::Line;
use shearq_scoring::aperture::{SEPARATION_BINS, separations};
use shearq_scoring::great3::{
    Bias, Branch, ConstantField, PlusCross, Q_V_BINS, REQUIRED_C, REQUIRED_M, SUBFIELDS, along,
    constant_score, position_angle, variable_score,
};

use self::files::Masses;
use self::pack::Galaxies;
use self::rules::Great3;
use crate::agreement::{MIN_SHEAR_SLOPE, Slope, disagreement, odd_fields};
use crate::columns::wrong;
use crate::{
    Entry, Figure, Presubmission, Presubmitting, PublicBranch, PublicChallenge, Score, Simulated,
    Simulation, SimulationError, Truth,
};

pub(crate) const CHALLENGE: PublicChallenge = PublicChallenge {
    name: "great3",
    branches: || Branch::all().map(|own| own.to_string()).collect(),
    simulated: || {
        let branches = simulator::simulated_branches();
        branches.map(|own| own.to_string()).collect()
    },
    branch: |name| Some(Box::new(Great3(Branch::named(name?)?))),
};

// The error of each field's shear against the true shear, along the PSF and at 45° to it, with the fit (c, m) and the requirement.
fn residual_plots(fields: &[ConstantField], biases: [(Bias, Bias); 2]) -> Vec<LinePlot> {
    let plots = [("₊", true), ("×", false)].into_iter().zip(biases);
    let plots = plots.map(|((name, is_plus), (c, m))| {
        let of = |g: Shear, field: &ConstantField| {
            let PlusCross { plus, cross } = along(g, position_angle(field.psf));
            if is_plus { plus } else { cross }
        };
        let x: Vec<f64> = fields.iter().map(|own| of(own.truth, own)).collect();
        let submitted = fields.iter().map(|own| of(own.submitted, own));
        let y = submitted
            .zip(&x)
            .map(|(g, truth)| 1e3 * (g - truth))
            .collect();
        let most = x.iter().fold(0.0_f64, |most, g| most.max(g.abs()));
        let ends = vec![-most, 0.0, most];
        let line = |name: &str, c: f64, m: f64, size: &dyn Fn(f64) -> f64, style| {
            let y = ends.iter().map(|g| 1e3 * (c + m * size(*g))).collect();
            Series::new(name, ends.clone(), y, style, 7)
        };
        LinePlot {
            title: format!(
                "m{name} = ({:.1} ± {:.1})·10⁻³, c{name} = ({:.1} ± {:.1})·10⁻⁴",
                1e3 * m.value,
                1e3 * m.error,
                1e4 * c.value,
                1e4 * c.error
            ),
            x_label: format!("true g{name}"),
            y_label: format!("g{name} − true g{name}, 10⁻³"),
            series: vec![
                Series::new("fields", x, y, Style::Points, 0),
                line("c + m g", c.value, m.value, &|g| g, Style::Line),
                line(
                    "requirement",
                    REQUIRED_C,
                    REQUIRED_M,
                    &f64::abs,
                    Style::Dashed,
                ),
                line("", -REQUIRED_C, -REQUIRED_M, &f64::abs, Style::Dashed),
            ],
            ..LinePlot::default()
        }
    });
    plots.collect()
}

// ⟨M_ap²⟩ of the submission and of the truth, means over fields with the error by their scatter.
fn mass_plot(truth: &[[f64; SEPARATION_BINS]], submitted: &[[f64; SEPARATION_BINS]]) -> LinePlot {
    let theta: Vec<f64> = separations().iter().map(|centre| centre.0).collect();
    let mean = |fields: &[[f64; SEPARATION_BINS]], b: usize| {
        let mut mean = RunningMean::default();
        fields.iter().for_each(|own| mean.add(1e6 * own[b]));
        mean
    };
    let means = |fields| (0..SEPARATION_BINS).map(move |b| mean(fields, b));
    let error = |own: RunningMean| own.deviation() / (own.count() as f64).sqrt();
    let values = |fields| means(fields).map(|own| own.mean()).collect();
    LinePlot {
        title: "Aperture mass dispersion".into(),
        x_label: "θ, degrees".into(),
        y_label: "⟨M_ap²⟩, 10⁻⁶".into(),
        x_log: true,
        series: vec![
            Series::new("true", theta.clone(), values(truth), Style::Line, 2),
            Series::new("submitted", theta, values(submitted), Style::Points, 5)
                .with_errors(means(submitted).map(error).collect()),
        ],
        ..LinePlot::default()
    }
}

// Why aperture masses are not of the true shear. ⟨M_ap²⟩ follows from ξ₊ and ξ₋; a flipped or exchanged component leaves ξ₊ and
// averages ξ₋ to zero, so that E and B are both the mean of the true E and B.
fn disagreement_of_masses(submitted: &[Masses], truth: &[Masses], path: &Path) -> Option<String> {
    let e: Vec<(f64, f64)> = submitted
        .iter()
        .zip(truth)
        .flat_map(|(own, truth)| truth.e.into_iter().zip(own.e))
        .collect();
    let Some(found) = Slope::of(&e) else {
        return Some(format!(
            "whether map_E follows the true one cannot be determined, because that of {} is the same at all separations",
            path.display()
        ));
    };
    // Of a square of shears.
    if !found.is_clear(MIN_SHEAR_SLOPE * MIN_SHEAR_SLOPE) {
        return Some(format!(
            "map_E does not follow the true one (found a slope of {found}, expected about 1): it contains no measurable shear"
        ));
    }
    // Of sums over fields, as in Q_v: ξ₋ of one field is not zero by chance.
    let sum = |of: &dyn Fn(&Masses) -> f64, masses: &[Masses]| masses.iter().map(of).sum::<f64>();
    let (mut as_given, mut averaged) = (0.0, 0.0);
    for bin in 0..SEPARATION_BINS {
        let both = |masses| {
            [
                sum(&|own| own.e[bin], masses),
                sum(&|own| own.b[bin], masses),
            ]
        };
        let ([e, b], [true_e, true_b]) = (both(submitted), both(truth));
        let mean = 0.5 * (true_e + true_b);
        as_given += (e - true_e).powi(2) + (b - true_b).powi(2);
        averaged += (e - mean).powi(2) + (b - mean).powi(2);
    }
    // Chosen by hand: map_B of zero, as of a program that does not compute it, reaches one half.
    (averaged < 0.25 * as_given).then(|| {
        "map_E and map_B are both the mean of the true E and B: the sign of g1 or g2, or their order, is probably wrong".into()
    })
}

// Standard errors by which the correlation with the true differences between fields must exceed chance.
const MIN_ORDER_SIGNIFICANCE: f64 = 3.0;

// A warning about fields that are not clearly in the order of the truth. Q_v does not depend on it, but its jackknife does, and
// exchanged fields are a fault of a catalogue, such as galaxies with the identities of another subfield.
fn doubt_of_order(submitted: &[Masses], truth: &[Masses]) -> Option<String> {
    // The sum over separations, which noise affects least.
    let sum = |masses: &Masses| masses.e[Q_V_BINS].iter().sum::<f64>();
    let each = submitted.iter().zip(truth);
    let pairs: Vec<_> = each.map(|(own, truth)| (sum(truth), sum(own))).collect();
    let (count, correlation) = (pairs.len() as f64, Line::through(&pairs).correlation());
    // Fisher's transform of a correlation has the variance 1/(N − 3).
    let significance = correlation.atanh() * (count - 3.0).max(0.0).sqrt();
    if pairs.len() < 2 || significance >= MIN_ORDER_SIGNIFICANCE {
        return odd_fields(&[pairs]);
    }
    Some(format!(
        "whether the fields are in the order of the truth cannot be determined (found a correlation of {correlation:.2} of map_E of {count} fields, which is {:.1}σ above zero, expected {MIN_ORDER_SIGNIFICANCE}σ): they may be exchanged, or their noise is large",
        if significance.is_nan() {
            0.0
        } else {
            significance
        }
    ))
}

impl Great3 {
    // Fields of a branch of so many subfields, which is the whole branch unless the user states another number.
    fn fields(&self, subfields: Option<usize>) -> Result<usize, FileError> {
        let (found, per) = (subfields.unwrap_or(SUBFIELDS), self.0.subfields_per_field());
        match found > 0 && found % per == 0 {
            true => Ok(found / per),
            false => {
                let message = format!("found {found}, expected a multiple of {per} for {}", self.0);
                wrong(Path::new("--subfields"), message)
            }
        }
    }
}

impl Great3 {
    fn scored(
        &self,
        figures: Vec<Figure>,
        plots: Vec<LinePlot>,
        refusal: Option<String>,
        doubt: Option<String>,
    ) -> Score {
        Score {
            branch: Some(self.0.to_string()),
            figures,
            plots,
            refusal,
            warnings: doubt.into_iter().collect(),
        }
    }

    // Q_c of mean shears of fields.
    fn score_constant(&self, truth: Truth<'_>, submission: &Path) -> Result<Score, FileError> {
        let fields = self.fields(truth.subfields)?;
        let shears = self.true_shears(truth.path, fields)?;
        let psfs = self.psfs(truth, fields)?;
        let submitted = self.submitted_shears(submission, fields)?;
        let pairs: Vec<_> = shears
            .iter()
            .copied()
            .zip(submitted.iter().copied())
            .collect();
        let refusal = disagreement(&pairs, truth.path);
        let component = |of: fn(Shear) -> f64| pairs.iter().map(move |(g, own)| (of(*g), of(*own)));
        let components = [component(|g| g.e1), component(|g| g.e2)];
        let doubt = odd_fields(&components.map(Iterator::collect));
        let fields = shears.iter().zip(&submitted).zip(&psfs);
        let fields: Vec<ConstantField> = fields
            .map(|((&truth, &submitted), &psf)| ConstantField {
                truth,
                submitted,
                psf,
            })
            .collect();
        let found = constant_score(&fields, self.0.observation)
            .map_err(|error| FileError::new(submission, error))?;
        let plots = residual_plots(
            &fields,
            [(found.c.plus, found.m.plus), (found.c.cross, found.m.cross)],
        );
        let mut figures = vec![Figure {
            key: "Q_c",
            value: found.q,
            error: None,
            jackknife: found.jackknife,
            perfect: Some(self.0.observation.q_c([[0.0; 2]; 2])),
            requirement: None,
            decimals: 1,
        }];
        for (key, bias, requirement) in [
            ("c_plus", found.c.plus, REQUIRED_C),
            ("m_plus", found.m.plus, REQUIRED_M),
            ("c_cross", found.c.cross, REQUIRED_C),
            ("m_cross", found.m.cross, REQUIRED_M),
        ] {
            figures.push(Figure {
                key,
                value: bias.value,
                error: Some(bias.error),
                jackknife: bias.jackknife,
                perfect: None,
                requirement: Some(requirement),
                decimals: 6,
            });
        }
        Ok(self.scored(figures, plots, refusal, doubt))
    }

    // Q_v of aperture masses of fields.
    fn score_variable(
        &self,
        truth: Truth<'_>,
        submission: &Path,
        pool: &Pool,
    ) -> Result<Score, FileError> {
        let of_submission = |error| FileError::new(submission, error);
        let fields = self.fields(truth.subfields)?;
        if let Some(psf) = truth.psf {
            let message = format!("--psf: Q_v of {} has no use for the PSF", self.0);
            return Err(FileError::new(psf, message).hint("without --psf"));
        }
        let masses = self.true_masses(truth.path, fields, pool)?;
        let submitted = self.submitted_masses(submission, fields)?;
        let refusal = disagreement_of_masses(&submitted, &masses, truth.path);
        let doubt = doubt_of_order(&submitted, &masses);
        let e = |masses: &[Masses]| masses.iter().map(|own| own.e).collect::<Vec<_>>();
        let true_e = e(&masses);
        let score = |submitted: &[_]| variable_score(submitted, &true_e, self.0.observation);
        let found = score(&e(&submitted)).map_err(of_submission)?;
        let perfect = score(&true_e).map_err(of_submission)?;
        let plots = vec![mass_plot(&true_e, &e(&submitted))];
        let figures = vec![Figure {
            key: "Q_v",
            value: found.q,
            error: None,
            jackknife: found.jackknife,
            perfect: Some(perfect.q),
            requirement: None,
            decimals: 1,
        }];
        Ok(self.scored(figures, plots, refusal, doubt))
    }
}

impl PublicBranch for Great3 {
    fn title(&self) -> String {
        format!("GREAT3 {}", self.0)
    }

    fn subfields(&self) -> Option<usize> {
        Some(SUBFIELDS)
    }

    fn score(&self, truth: Truth<'_>, submission: &Path, pool: &Pool) -> Result<Score, FileError> {
        match self.0.constant {
            true => self.score_constant(truth, submission),
            false => self.score_variable(truth, submission, pool),
        }
    }

    fn check(&self, submission: &Path, subfields: Option<usize>) -> Result<(), FileError> {
        let fields = self.fields(subfields)?;
        match self.0.constant {
            true => self.submitted_shears(submission, fields).map(|_| ()),
            false => self.submitted_masses(submission, fields).map(|_| ()),
        }
    }

    fn pack(
        &self,
        packing: &Presubmitting<'_>,
        pool: &Pool,
    ) -> Option<Result<Presubmission, FileError>> {
        let read = Galaxies::read(self.0, packing);
        Some(read.and_then(|galaxies| galaxies.summarise(packing, pool)))
    }

    fn simulate(
        &self,
        simulation: &Simulation<'_>,
        threads: usize,
        start: &dyn Fn(u64) -> Box<dyn Progress>,
    ) -> Option<Result<Simulated, SimulationError>> {
        let is_simulated = simulator::simulated_branches().any(|own| own == self.0);
        is_simulated.then(|| simulation::simulate(self.0, simulation, threads, start))
    }

    fn leaderboard(&self) -> Vec<Entry> {
        let branch = self.0.to_string();
        let entries = LEADERBOARD.lines().filter_map(|line| {
            let fields: Vec<&str> = line.split(',').collect();
            let [board, team, method, numbers @ ..] = fields.as_slice() else {
                return None;
            };
            let number = |k: usize| numbers[k].parse().unwrap_or(f64::NAN);
            (*board == branch).then(|| Entry {
                team: (*team).to_owned(),
                method: (*method).to_owned(),
                q: number(0),
                biases: [1, 2, 3, 4].map(number),
            })
        });
        entries.collect()
    }

    fn leaderboard_source(&self) -> Option<&'static str> {
        Some(
            "Source: public leaderboard of GREAT3 (2014) in github.com/barnabytprowe/great3-public; 120 of its entries, and the best of each branch. Teams sent many entries, and the best of many is partly luck.",
        )
    }
}

// board,team,method,Q_c,m_plus,m_cross,c_plus,c_cross. Rows without a team have the highest Q of a branch, whose biases are not given.
const LEADERBOARD: &str = include_str!("great3/leaderboard.csv");
