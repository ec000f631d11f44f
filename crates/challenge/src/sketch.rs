//! The few mean shapes by which entries are compared later, when their catalogues are gone.

use shearq_scoring::FieldSum;

// Cells of a set whose mean shapes a store keeps. Two methods that share all galaxies differ by far more than the
// criterion in any dozen of them.
const CELLS: usize = 32;
// Shapes are kept as multiples of this.
const STEP: f64 = 1e-7;

/// Mean shapes of some cells, which spread over the field.
pub fn sketch(total: &FieldSum) -> Vec<i32> {
    let (side, cells) = (total.e1.ncols(), total.e1.len());
    let kept = CELLS.min(cells);
    let mean = |sum: f64, count: f64| (sum / count.max(1.0) / STEP).round() as i32;
    (0..kept)
        .map(|k| k * cells / kept)
        .map(|cell| (cell / side, cell % side))
        .flat_map(|cell| [total.e1[cell], total.e2[cell]].map(|sum| mean(sum, total.count[cell])))
        .collect()
}
