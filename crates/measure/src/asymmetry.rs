//! The asymmetry of a stamp under rotation by 180° about its galaxy: galaxies look nearly the same, and neighbours do not.

use std::ops::Range;

use multiversion::multiversion;

// Two cells along each axis make a block. Chosen by hand.
const CELL_SIDE: i32 = 3;
// In pixels, of the middle of a place from the galaxy's centre. Chosen by hand.
const MIN_DISTANCE: f32 = 9.0;

/// A place of a stamp that is brighter than the opposite one.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BrightPlace {
    /// Difference of their light.
    pub(crate) excess: f32,
    /// Pixels of both.
    pub(crate) pixels: f32,
    /// Middle (x, y) from the galaxy's centre.
    pub(crate) offset: [f32; 2],
}

impl BrightPlace {
    /// A place, or its opposite if the excess is negative.
    fn from_excess(excess: f32, pixels: f32, offset: [f32; 2]) -> Self {
        let side = excess.signum();
        BrightPlace {
            excess: excess.abs(),
            pixels,
            offset: offset.map(|at| side * at),
        }
    }
}

/// Compares places of stamps of one size with their opposites.
#[derive(Debug, Clone)]
pub(crate) struct Asymmetry {
    n: i32,
    /// Sums of the pixels of [`CELL_SIDE`] rows, column by column, with room for columns off the stamp: of cells and of
    /// their opposites.
    lines: [Vec<f32>; 2],
    cells: Vec<Cell>,
    /// Those found last.
    pub(crate) places: Vec<BrightPlace>,
}

/// Excess of a cell over its opposite, and the number of pixels of both.
#[derive(Debug, Clone, Copy)]
struct Cell {
    excess: f32,
    pixels: i32,
}

/// The first pixel beyond the centre along each axis.
fn beyond_centre(rotation: [i32; 2]) -> [i32; 2] {
    rotation.map(|sum| sum.div_euclid(2) + 1)
}

/// Cells from the centre of a stamp of `n` pixels a side to an edge.
fn cells_to_edge(n: i32) -> i32 {
    (n / 2 + CELL_SIDE - 1) / CELL_SIDE
}

impl Asymmetry {
    pub(crate) fn new(n: usize) -> Self {
        Asymmetry {
            n: n as i32,
            lines: std::array::from_fn(|_| vec![0.0; 3 * n]),
            cells: Vec::with_capacity(n * n / 8),
            places: Vec::with_capacity(n * n / 8),
        }
    }

    /// Compares blocks of 2 × 2 cells.
    pub(crate) fn compare(&mut self, stamp: &[f32], rotation: [i32; 2]) {
        let to_edge = self.compare_cells(stamp, rotation);
        let [x0, y0] = beyond_centre(rotation);
        let row = 2 * to_edge as usize;
        for (at, pair) in self.cells.windows(row + 2).enumerate() {
            let (i, j) = ((at % row) as i32 - to_edge, (at / row) as i32 - 1);
            // Not from the end of a row to the next one's beginning.
            if i + 1 == to_edge {
                continue;
            }
            let middle = |first: i32, step: i32, sum: i32| {
                (first + (step + 1) * CELL_SIDE) as f32 - 0.5 - sum as f32 / 2.0
            };
            let (x, y) = (middle(x0, i, rotation[0]), middle(y0, j, rotation[1]));
            if x * x + y * y < MIN_DISTANCE * MIN_DISTANCE {
                continue;
            }
            let cells = [pair[0], pair[1], pair[row], pair[row + 1]];
            let pixels: i32 = cells.iter().map(|cell| cell.pixels).sum();
            if pixels == 0 {
                continue;
            }
            let excess = cells.iter().map(|cell| cell.excess).sum();
            self.places
                .push(BrightPlace::from_excess(excess, pixels as f32, [x, y]));
        }
    }

    /// Compares all cells. Returns the number of cells from the centre to an edge.
    fn compare_cells(&mut self, stamp: &[f32], rotation: [i32; 2]) -> i32 {
        self.places.clear();
        self.cells.clear();
        let to_edge = cells_to_edge(self.n);
        let [x0, y0] = beyond_centre(rotation);
        let n = self.n as usize;
        let columns = |x: i32| cell_on_stamp(x, self.n).len() as i32;
        // One row of cells from the other half, for blocks on the line between both.
        for j in -1..to_edge {
            let y = y0 + j * CELL_SIDE;
            let opposite_y = rotation[1] - y - CELL_SIDE + 1;
            let rows = [y, opposite_y].map(|y| cell_on_stamp(y, self.n));
            for (line, rows) in self.lines.iter_mut().zip(&rows) {
                add_rows(stamp, rows.clone(), &mut line[n..2 * n]);
            }
            let [own, other] = rows.map(|rows| rows.len() as i32);
            for i in -to_edge..to_edge {
                let x = x0 + i * CELL_SIDE;
                let opposite_x = rotation[0] - x - CELL_SIDE + 1;
                let light = |line: &[f32], x: i32| -> f32 {
                    line[(self.n + x) as usize..][..CELL_SIDE as usize]
                        .iter()
                        .sum()
                };
                let [here, there] = &self.lines;
                self.cells.push(Cell {
                    excess: light(here, x) - light(there, opposite_x),
                    pixels: own * columns(x) + other * columns(opposite_x),
                });
            }
        }
        to_edge
    }
}

/// Of the [`CELL_SIDE`] pixels from `first` on along an axis, those on a stamp of `n` pixels.
fn cell_on_stamp(first: i32, n: i32) -> Range<usize> {
    let on_stamp = |at: i32| at.clamp(0, n) as usize;
    on_stamp(first)..on_stamp(first + CELL_SIDE)
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_rows(stamp: &[f32], rows: Range<usize>, line: &mut [f32]) {
    line.fill(0.0);
    let n = line.len();
    for row in rows {
        for (sum, value) in line.iter_mut().zip(&stamp[row * n..][..n]) {
            *sum += value;
        }
    }
}
