//! Aperture masses of scored sets whose galaxies lie on a grid, and of their true shear.

use ndarray::Array2;
use shearq_dataset::threads::Pool;
use shearq_dataset::truth::ReadTruth;
use shearq_files::FileError;
use shearq_render::table::{Cell, Table};
use shearq_scoring::aperture::{ApertureMass, LatticeShear, SEPARATION_BINS};
use shearq_scoring::{Complex64, Convention, FieldSum, ScoringError, SetImages, TruthSign};

use crate::catalogues::Catalogues;
use crate::score::{ScoreError, ScoredSet};

/// ⟨M_ap²⟩ of the true shear and of the mean ellipticities over all images of a set.
#[derive(Debug)]
pub struct SetMasses {
    set: Option<u32>,
    // Nodes closer than this have no pairs.
    spacing: f64,
    truth: ApertureMass,
    measured: ApertureMass,
}

/// Of `scored` sets of `catalogues`, in the conventions in which they were scored, and of their `truth`.
pub fn masses(
    catalogues: &Catalogues,
    scored: &[ScoredSet],
    truth: impl Fn(u32) -> Result<ReadTruth, FileError>,
    threads: usize,
) -> Result<Vec<SetMasses>, ScoreError> {
    let pool = Pool::new(threads)?;
    let masses = scored.iter().map(|own| {
        let found = truth(own.record.set)?;
        // As in scoring: a sign that the truth does not state was determined by the catalogues.
        let by_catalogues = found.sign.is_none();
        let found = match own.sign {
            Some(sign) if by_catalogues && sign.of == TruthSign::Challenge => ReadTruth {
                shear: found.shear.flipped(),
                ..found
            },
            _ => found,
        };
        set_masses(catalogues, own, &found, &pool)
    });
    masses.collect()
}

fn set_masses(
    catalogues: &Catalogues,
    scored: &ScoredSet,
    ReadTruth { grid, shear, .. }: &ReadTruth,
    pool: &Pool,
) -> Result<SetMasses, ScoreError> {
    let (set, convention) = (scored.record.set, scored.score.chosen);
    let number = scored.number();
    let wrong = |source: ScoringError| ScoreError::Scoring {
        set: number,
        source,
    };
    let paths = catalogues.files.of_set(set).into_iter().map(|own| own.1);
    let mut images = SetImages::new(grid);
    for image in pool.in_order(paths, |path| catalogues.sum(grid, &path)) {
        images.add(&image?.0).map_err(wrong)?;
    }
    let mut total = images.total().clone();
    // A cell without a galaxy has no ellipticity and no weight.
    let count = (total.count).mapv(|count| if count > 0.0 { count } else { 1.0 });
    total.e1 /= &count;
    total.e2 /= &count;
    catalogues
        .calibration(set)?
        .shears(&mut total.e1, &mut total.e2);
    let FieldSum { e1, e2, .. } = &total;
    let measured = convention.apply(e1, e2).map_err(wrong)?;
    let standard = Convention::STANDARD;
    let truth = standard.apply(&shear.g1, &shear.g2).map_err(wrong)?;
    // The same weights in both, so that missing galaxies change both alike.
    let weights = match convention.transposes() {
        true => total.count.t(),
        false => total.count.view(),
    };
    let masses = |shear: &Array2<Complex64>| -> Result<_, ScoringError> {
        let galaxies = LatticeShear::on_grid(grid, shear, weights)?;
        Ok(galaxies.correlations().aperture_mass())
    };
    Ok(SetMasses {
        set: number,
        spacing: grid.field.0 / grid.n as f64,
        truth: masses(&truth).map_err(wrong)?,
        measured: masses(&measured).map_err(wrong)?,
    })
}

/// A row per set and radius.
pub fn table(title: String, sets: &[SetMasses]) -> Table {
    let rows: Vec<(&SetMasses, usize)> = sets
        .iter()
        .flat_map(|own| (0..SEPARATION_BINS).map(move |b| (own, b)))
        .filter(|(own, b)| own.truth.theta[*b] > own.spacing)
        .collect();
    let mut table = Table::titled(title);
    if sets.iter().any(|own| own.set.is_some()) {
        table.column("set", "Set", &rows, |(own, _)| {
            Cell::number(f64::from(own.set.unwrap_or(0)), 0)
        });
    }
    table.column("theta", "Radius [deg]", &rows, |(own, b)| {
        Cell::number(own.truth.theta[*b], 4)
    });
    // In 10⁻⁶, the order of cosmic shear.
    let scaled = |value: f64, error: f64| Cell::with_error(1e6 * value, Some(1e6 * error), 3);
    table.column("true_map_e_1e6", "true M_ap²×10⁶", &rows, |(own, b)| {
        Cell::number(1e6 * own.truth.map_e[*b], 3)
    });
    table.column("map_e_1e6", "M_ap²×10⁶", &rows, |(own, b)| {
        scaled(own.measured.map_e[*b], own.measured.error[*b])
    });
    table.column("map_b_1e6", "M_×²×10⁶", &rows, |(own, b)| {
        scaled(own.measured.map_b[*b], own.measured.error[*b])
    });
    table.notes.push("Exact sums over all pairs of cells in the 15 bins of GREAT3. Errors: scatter of the mean ellipticities, shear included. E and B modes mix at radii near the distance of neighbours and the field.".into());
    table
}
