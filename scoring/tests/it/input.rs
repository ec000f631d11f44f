//! Rows, truth and arguments: what is counted, and what is refused.

use shearq_scoring::{
    Convention, Grid, Noise, Options, Row, RowCounts, RowFault, SetImages, SetScorer, TrueShear,
    TruthSign,
};

use crate::common::{Content, field, rows, sum_of, truth};

#[test]
fn every_row_is_counted_once() {
    let grid = Grid::great10(8).unwrap();
    let row = |cell: usize, e1: f64, e2: f64| {
        let (x, y) = grid.centre(cell % 8, cell / 8);
        Row { x, y, e1, e2 }
    };
    let mut rows = vec![
        row(0, 0.1, 0.0),
        row(0, 0.2, 0.0),
        Row {
            x: -50.0,
            ..row(1, 0.1, 0.1)
        },
        row(2, f64::NAN, 0.1),
        row(3, 0.1, f64::INFINITY),
        row(4, 0.8, 0.7),
        row(5, 0.6, -0.8),
        row(6, 3.0, 4.0),
        row(7, -99.0, 0.0),
        row(8, 5.0, 0.1),
    ];
    let (sum, counts) = sum_of(&grid, &rows);
    let expected = RowCounts {
        used: 7,
        outside: 1,
        excess: 0,
        not_finite: 2,
        repeated: 1,
        missing: 64 - 8,
        above_one: 4,
        absurd: 2,
        first_absurd: Some((9, -99.0, 0.0)),
        sentinels: 1,
        first_sentinel: Some((9, -99.0, 0.0)),
    };
    assert_eq!(counts, expected);
    assert_eq!((sum.count[(0, 0)], sum.e1[(0, 0)]), (2.0, 0.1 + 0.2));
    // Rows after the first n² are not read.
    rows.extend((0..64).map(|k| row(k, 0.0, 0.0)));
    let (_, more) = sum_of(&grid, &rows);
    assert_eq!((more.excess, more.used), (10, 7 + 54));
    let mut both = counts;
    both += more;
    let expected = RowCounts {
        used: 7 + 61,
        outside: 2,
        excess: 10,
        not_finite: 4,
        repeated: counts.repeated + more.repeated,
        missing: counts.missing + more.missing,
        above_one: 8,
        absurd: 4,
        sentinels: 2,
        ..counts
    };
    assert_eq!(both, expected);
    let mut none = RowCounts::default();
    none += counts;
    assert_eq!(none, counts);
}

#[test]
fn rows_that_are_not_ellipticities_are_a_fault() {
    let first = (7, -99.0, 99.0);
    let fault = |edit: &dyn Fn(&mut RowCounts)| {
        let mut counts = RowCounts {
            used: 64,
            ..RowCounts::default()
        };
        edit(&mut counts);
        counts.fault()
    };
    assert_eq!(fault(&|_| {}), None);
    let sentinels = fault(&|c| (c.sentinels, c.first_sentinel) = (3, Some(first)));
    assert_eq!(sentinels, Some(RowFault::Sentinels { rows: 3, first }));
    // A twentieth may be outliers, and half of the galaxies there twice.
    let outliers = |rows, used| {
        fault(&move |c| (c.used, c.absurd, c.first_absurd) = (used, rows, Some(first)))
    };
    assert_eq!([outliers(3, 64), outliers(3, 60)], [None, None]);
    for (rows, used) in [(3, 59), (4, 64)] {
        let expected = RowFault::Absurd { rows, used, first };
        assert_eq!(outliers(rows, used), Some(expected));
    }
    let repeated = |rows| fault(&move |c| c.repeated = rows);
    assert_eq!(repeated(32), None);
    let (rows, used) = (33, 64);
    assert_eq!(repeated(33), Some(RowFault::Repeated { rows, used }));
}

#[test]
fn truth_must_fill_the_grid_once_and_may_be_constant() {
    let grid = Grid::great10(8).unwrap();
    let all = rows(&grid, &field(&grid, Content::E, 1));
    let read = |rows: Vec<Row>| TrueShear::from_rows(&grid, TruthSign::Challenge, rows);
    let truth = read(all.clone()).unwrap();
    assert_eq!(truth.g2[(0, 0)], -all[0].e2);
    assert_eq!(truth.constant(), None);
    assert!(read(all[1..].to_vec()).is_err());
    let mut twice = all.clone();
    twice[1] = twice[0];
    assert!(read(twice).is_err());
    let mut odd = all.clone();
    odd[9].e2 = f64::NAN;
    let error = read(odd).unwrap_err().to_string();
    assert!(error.contains("cell (2, 2)"), "{error}");
    let constant = |edit: &dyn Fn(&mut [Row])| {
        let same = |r: &Row| Row {
            e1: 0.03,
            e2: 0.02,
            ..*r
        };
        let mut rows: Vec<Row> = all.iter().map(same).collect();
        edit(&mut rows);
        read(rows).unwrap().constant()
    };
    assert_eq!(constant(&|_| {}), Some([0.03, -0.02]));
    assert_eq!(constant(&|rows| rows[5].e1 += 1e-9), None);
    assert_eq!(constant(&|rows| rows[6].e2 -= 1e-9), None);
}

#[test]
fn invalid_input_is_refused() {
    let grid = Grid::great10(8).unwrap();
    let shear = truth(&field(&grid, Content::E, 1));
    for variance in [-1e-9, f64::NAN, f64::INFINITY] {
        let options = Options {
            noise: Noise::Given(variance),
            ..Options::default()
        };
        assert!(SetScorer::new(grid, shear.clone(), options).is_err());
    }
    let zero = Options {
        noise: Noise::Given(0.0),
        ..Options::default()
    };
    let scorer = SetScorer::new(grid, shear, zero).unwrap();
    assert!(scorer.score(&SetImages::new(&grid)).is_err());
}

#[test]
fn conventions_have_different_descriptions() {
    let mut words: Vec<&str> = Convention::ALL.iter().map(|k| k.describe()).collect();
    assert_eq!(words[4], "standard");
    assert_eq!(words[5], "e2 flipped");
    assert_eq!(words[1], "x and y swapped, e2 flipped");
    words.sort_unstable();
    words.dedup();
    assert_eq!(words.len(), 8);
    assert!(Convention::try_from(0).is_err() && Convention::try_from(9).is_err());
    assert_eq!(u8::from(Convention::try_from(7).unwrap()), 7);
}
