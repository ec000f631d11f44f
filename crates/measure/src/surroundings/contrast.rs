//! A stamp compared with itself turned about the galaxy's centre: galaxies look nearly the same turned by 180 degrees, and
//! neighbours do not.

use std::ops::Range;

use multiversion::multiversion;

/// Side of the cells that blocks are made of, two along each axis. See docs/constants.md.
const CELL: i32 = 3;
/// Least distance of a cell's centre from the galaxy's. See docs/constants.md.
const LEAST_DISTANCE: f32 = 9.0;
/// Half the side of the square whose sum is the galaxy's light. See docs/constants.md.
pub(super) const INNER: i32 = 8;

/// Weights of a cell and of those beside it, along an axis. See docs/constants.md.
const SMOOTHED: [f32; 3] = [0.5, 1.0, 0.5];

/// Blocks of 6 × 6 pixels away from a galaxy, against their opposites.
#[derive(Debug, Clone)]
pub(crate) struct Contrasts {
    n: i32,
    /// Sums of the pixels of [`CELL`] rows, column by column, with room for columns off the stamp: of cells and of their
    /// opposites.
    lines: [Vec<f32>; 2],
    cells: Vec<Cell>,
    /// Excess and pixels of a row, with those beside it along y, between zeros.
    across: [Vec<f32>; 2],
    /// What was found last.
    pub(crate) blocks: Vec<Block>,
    /// The galaxy's light.
    pub(crate) light: f32,
}

/// What a cell is brighter than its opposite, and the number of pixels of both.
#[derive(Debug, Clone, Copy)]
struct Cell {
    excess: f32,
    pixels: i32,
}

/// A block and its opposite, of which it is the brighter one.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Block {
    /// Difference of their light.
    pub(crate) excess: f32,
    /// Pixels of both.
    pub(crate) pixels: f32,
    /// Middle of the block from the galaxy's centre.
    pub(crate) place: [f32; 2],
}

/// What to take a pixel p from, along each axis, for its opposite about a galaxy centred at `centre`, which is
/// known to half a pixel then.
pub(crate) fn turn(centre: [f32; 2], n: usize) -> [i32; 2] {
    centre.map(|c| (2.0 * c).round() as i32 + n as i32 - 1)
}

/// The first pixel beyond the centre along each axis.
fn beyond(turn: [i32; 2]) -> [i32; 2] {
    turn.map(|turn| turn.div_euclid(2) + 1)
}

/// Cells from the centre of a stamp of `n` pixels a side to an edge.
fn along(n: i32) -> i32 {
    (n / 2 + CELL - 1) / CELL
}

/// The light of the opposite of a pixel (x, y) on a stamp of `n` pixels a side; `None` off the stamp.
pub(super) fn opposite(stamp: &[f32], n: usize, turn: [i32; 2], [x, y]: [usize; 2]) -> Option<f32> {
    let on_stamp = |at: i32| usize::try_from(at).ok().filter(|&at| at < n);
    let column = on_stamp(turn[0] - x as i32)?;
    let row = on_stamp(turn[1] - y as i32)?;
    Some(stamp[row * n + column])
}

impl Contrasts {
    pub(crate) fn new(n: usize) -> Self {
        Contrasts {
            n: n as i32,
            lines: std::array::from_fn(|_| vec![0.0; 3 * n]),
            cells: Vec::with_capacity(n * n / 8),
            across: std::array::from_fn(|_| vec![0.0; 2 * along(n as i32) as usize + 2]),
            blocks: Vec::with_capacity(n * n / 8),
            light: 0.0,
        }
    }

    /// Compares all blocks. Pixel p is opposite to `turn − p`.
    pub(crate) fn compare(&mut self, stamp: &[f32], turn: [i32; 2]) {
        let most = self.compare_cells(stamp, turn);
        let [x0, y0] = beyond(turn);
        let row = 2 * most as usize;
        for (at, pair) in self.cells.windows(row + 2).enumerate() {
            let (i, j) = ((at % row) as i32 - most, (at / row) as i32 - 1);
            // Not from the end of a row to the next one's beginning.
            if i + 1 == most {
                continue;
            }
            let middle = |first: i32, step: i32, turn: i32| {
                (first + (step + 1) * CELL) as f32 - 0.5 - turn as f32 / 2.0
            };
            let (x, y) = (middle(x0, i, turn[0]), middle(y0, j, turn[1]));
            if x * x + y * y < LEAST_DISTANCE * LEAST_DISTANCE {
                continue;
            }
            let cells = [pair[0], pair[1], pair[row], pair[row + 1]];
            let pixels: i32 = cells.iter().map(|cell| cell.pixels).sum();
            if pixels == 0 {
                continue;
            }
            let excess: f32 = cells.iter().map(|cell| cell.excess).sum();
            let side = excess.signum();
            self.blocks.push(Block {
                excess: excess.abs(),
                pixels: pixels as f32,
                place: [side * x, side * y],
            });
        }
    }

    /// Compares places under a weight as wide as a galaxy behind its PSF: a cell has a weight of 1, those beside it 1/2
    /// and those at its corners 1/4. A weight w counts as w² pixels. Those of which `is_hit` is true, by the galaxy's light,
    /// the excess and the number of pixels, are in `self.blocks`.
    pub(super) fn compare_smoothed(
        &mut self,
        stamp: &[f32],
        turn: [i32; 2],
        is_hit: impl Fn(f32, f32, f32) -> bool,
    ) {
        let most = self.compare_cells(stamp, turn);
        let [x0, y0] = beyond(turn);
        let middle = |first: i32, step: i32, turn: i32| {
            (first + step * CELL) as f32 + 0.5 * (CELL - 1) as f32 - 0.5 * turn as f32
        };
        let row = 2 * most as usize;
        let [excesses, counts] = &mut self.across;
        for j in 0..most {
            let y = middle(y0, j, turn[1]);
            // Nothing beside the first and the last one.
            let lines = self.cells[j as usize * row..].chunks_exact(row).take(3);
            excesses.fill(0.0);
            counts.fill(0.0);
            for (line, weight) in lines.zip(SMOOTHED) {
                let sums = excesses[1..].iter_mut().zip(&mut counts[1..]);
                for ((excess, pixels), cell) in sums.zip(line) {
                    *excess += weight * cell.excess;
                    *pixels += weight * weight * cell.pixels as f32;
                }
            }
            let [beside, _, _] = SMOOTHED;
            for i in 0..row {
                let excess = excesses[i + 1] + beside * (excesses[i] + excesses[i + 2]);
                let pixels = counts[i + 1] + beside * beside * (counts[i] + counts[i + 2]);
                let x = middle(x0, i as i32 - most, turn[0]);
                let near = x * x + y * y < LEAST_DISTANCE * LEAST_DISTANCE;
                if near || !is_hit(self.light, excess.abs(), pixels) {
                    continue;
                }
                let side = excess.signum();
                self.blocks.push(Block {
                    excess: excess.abs(),
                    pixels,
                    place: [side * x, side * y],
                });
            }
        }
    }

    /// Compares all cells, and takes the galaxy's light. Returns the number of cells from the centre to an edge.
    fn compare_cells(&mut self, stamp: &[f32], turn: [i32; 2]) -> i32 {
        self.blocks.clear();
        self.cells.clear();
        let most = along(self.n);
        let [x0, y0] = beyond(turn);
        self.light = self.inner(stamp, turn);
        let n = self.n as usize;
        let columns = |x: i32| on_stamp(x, self.n).len() as i32;
        // One row of cells from the other half, for blocks on the line between both.
        for j in -1..most {
            let y = y0 + j * CELL;
            let rows = [y, turn[1] - y - CELL + 1].map(|y| on_stamp(y, self.n));
            for (line, rows) in self.lines.iter_mut().zip(&rows) {
                add_rows(stamp, rows.clone(), &mut line[n..2 * n]);
            }
            let [own, other] = rows.map(|rows| rows.len() as i32);
            for i in -most..most {
                let x = x0 + i * CELL;
                let opposite = turn[0] - x - CELL + 1;
                let light = |line: &[f32], x: i32| -> f32 {
                    line[(self.n + x) as usize..][..CELL as usize].iter().sum()
                };
                let [here, there] = &self.lines;
                self.cells.push(Cell {
                    excess: light(here, x) - light(there, opposite),
                    pixels: own * columns(x) + other * columns(opposite),
                });
            }
        }
        most
    }

    /// The light of 16 × 16 pixels around the centre.
    pub(super) fn inner(&self, stamp: &[f32], turn: [i32; 2]) -> f32 {
        let [x0, y0] = beyond(turn);
        let range = |first: i32| {
            let on = |at: i32| at.clamp(0, self.n) as usize;
            on(first - INNER)..on(first + INNER)
        };
        let (columns, rows) = (range(x0), range(y0));
        let lines = stamp.chunks_exact(self.n as usize);
        let lines = lines.skip(rows.start).take(rows.len());
        lines
            .map(|line| line[columns.clone()].iter().sum::<f32>())
            .sum()
    }
}

/// Of the [`CELL`] pixels from `first` on along an axis, those on a stamp of `n` pixels.
fn on_stamp(first: i32, n: i32) -> Range<usize> {
    let on = |at: i32| at.clamp(0, n) as usize;
    on(first)..on(first + CELL)
}

/// Writes the sum of rows of a stamp.
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
