//! How many stamps of an image contain the position of another one.

// Two detections this far apart are on each other's stamps of 48 px.
pub const CLOSE_PX: f64 = 24.0;

/// Positions that have another one within [`CLOSE_PX`].
pub fn crowded(x: &[f64], y: &[f64]) -> usize {
    let mut order: Vec<usize> = (0..x.len())
        .filter(|k| x[*k].is_finite() && y[*k].is_finite())
        .collect();
    order.sort_by(|a, b| y[*a].total_cmp(&y[*b]));
    let mut is_close = vec![false; x.len()];
    for (place, &own) in order.iter().enumerate() {
        let near = order[place + 1..]
            .iter()
            .take_while(|other| y[**other] - y[own] < CLOSE_PX);
        for &other in near {
            if (x[other] - x[own]).hypot(y[other] - y[own]) < CLOSE_PX {
                is_close[own] = true;
                is_close[other] = true;
            }
        }
    }
    is_close.iter().filter(|close| **close).count()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_near_each_other_are_counted_once_each() {
        let (x, y) = (
            [10.0, 30.0, 10.0, 100.0, f64::NAN],
            [10.0, 10.0, 33.0, 10.0, 10.0],
        );
        // The first is near the second and the third, which are 30.5 px apart.
        assert_eq!(crowded(&x, &y), 3);
        assert_eq!(crowded(&x[..1], &y[..1]), 0);
        // 24 px apart: on no stamp of 48 px.
        assert_eq!(crowded(&[0.0, 24.0], &[0.0, 0.0]), 0);
    }
}
