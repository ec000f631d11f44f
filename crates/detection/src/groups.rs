//! Pixels with a weight that touch each other are one detection.

use crate::pixel::{DetectedPixel, Detection};

/// Detections of an exposure, from its pixels row by row.
///
/// Sums over detections are those over pixels: which pixels belong together changes no mean shear, only the scatter from which
/// errors follow.
#[derive(Debug, Default)]
pub struct Detections {
    /// Sums of groups of pixels. A group that was joined to another one names it.
    groups: Vec<Group>,
    /// Columns and groups of pixels of the last row with pixels, and of the row before if that was its neighbour.
    row: usize,
    current: Vec<(usize, usize)>,
    previous: Vec<(usize, usize)>,
}

#[derive(Debug)]
struct Group {
    sum: Detection,
    joined_to: Option<usize>,
}

impl Detections {
    /// Adds a pixel. Pixels come in the order of rows, and of columns in a row.
    pub fn add(&mut self, pixel: &DetectedPixel) {
        let [x, y] = pixel.place;
        if y != self.row {
            let is_next = y == self.row + 1;
            std::mem::swap(&mut self.current, &mut self.previous);
            if !is_next {
                self.previous.clear();
            }
            self.current.clear();
            self.row = y;
        }
        let near = |(column, _): &&(usize, usize)| column.abs_diff(x) <= 1;
        let left = self.current.last().filter(near);
        let first = self.previous.partition_point(|own| own.0 + 1 < x);
        let above = self.previous[first..].iter().take_while(near);
        // At most three above and one to the left.
        let mut touched = [None; 4];
        for (to, own) in touched.iter_mut().zip(above.chain(left)) {
            *to = Some(own.1);
        }
        let mut group = None;
        for other in touched.into_iter().flatten() {
            group = Some(match group {
                None => self.root(other),
                Some(group) => self.join(group, other),
            });
        }
        let sum = Detection::of(pixel);
        let group = match group {
            None => {
                self.groups.push(Group {
                    sum,
                    joined_to: None,
                });
                self.groups.len() - 1
            }
            Some(group) => {
                self.groups[group].sum.add(&sum);
                group
            }
        };
        self.current.push((x, group));
    }

    fn root(&self, mut group: usize) -> usize {
        while let Some(other) = self.groups[group].joined_to {
            group = other;
        }
        group
    }

    /// Joins two groups to the earlier one, which is returned.
    fn join(&mut self, one: usize, other: usize) -> usize {
        let (a, b) = (self.root(one), self.root(other));
        let (first, second) = (a.min(b), a.max(b));
        if first != second {
            let sum = self.groups[second].sum;
            self.groups[first].sum.add(&sum);
            self.groups[second].joined_to = Some(first);
        }
        first
    }

    /// All detections, in the order of their first pixels.
    pub fn finish(self) -> Vec<Detection> {
        let groups = self.groups.into_iter();
        let roots = groups.filter(|group| group.joined_to.is_none());
        roots.map(|group| group.sum.centred()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pixel(x: usize, y: usize) -> DetectedPixel {
        DetectedPixel {
            place: [x, y],
            weight: 0.5,
            e: [x as f64, y as f64],
            response: [[1.0, 0.0], [0.0, 2.0]],
            snr: (x + y) as f64,
        }
    }

    fn count(rows: &[&str]) -> Vec<usize> {
        let mut found = Detections::default();
        for (y, row) in rows.iter().enumerate() {
            for (x, _) in row.match_indices('#') {
                found.add(&pixel(x, y));
            }
        }
        found.finish().iter().map(|own| own.pixels).collect()
    }

    #[test]
    fn touching_pixels_are_one_detection() {
        assert_eq!(count(&["##.#", "....", "#..#"]), [2, 1, 1, 1]);
        assert_eq!(count(&["#.#", ".#."]), [3]);
        assert_eq!(count(&["#...#", "#...#", ".###."]), [7]);
        assert_eq!(count(&["#", ".", "#"]), [1, 1]);
        assert_eq!(count(&["..#.#", ".#.#.", "#...#"]), [6]);
        assert_eq!(count(&[]), [] as [usize; 0]);
    }

    #[test]
    fn a_detection_has_the_sums_of_its_pixels() {
        let mut found = Detections::default();
        for (x, y) in [(3, 5), (4, 5), (3, 6)] {
            found.add(&pixel(x, y));
        }
        let [one] = found.finish()[..] else { panic!() };
        assert_eq!((one.weight, one.e, one.snr), (1.5, [10.0, 16.0], 9.0));
        assert_eq!(one.response, [[3.0, 0.0], [0.0, 6.0]]);
        assert!((one.centre[0] - 10.0 / 3.0).abs() < 1e-12);
        assert!((one.centre[1] - 16.0 / 3.0).abs() < 1e-12);
    }
}
