//! Where the galaxy is on its stamp.

/// σ of the weight for the galaxy's centre, narrow so that it does not follow noise. See
/// docs/constants.md.
const WEIGHT: f32 = 2.0;
/// Half the side of the square of that weight. See docs/constants.md.
const WEIGHT_REACH: i32 = 6;
/// Steps to the centre. See docs/constants.md.
const STEPS: usize = 3;
/// Offset beyond which there are more steps before a galaxy is compared with itself and with others. See docs/constants.md.
const FAR: f32 = 2.0;
/// These steps. See docs/constants.md.
const MORE: usize = 12;
/// Step in units of the weighted centroid, which falls short of the centre. See docs/constants.md.
const STRIDE: f32 = 1.5;
/// Offset up to which the window stays in the middle of the stamp. See docs/constants.md.
const STAYS: f32 = 1.25;
/// Offset from which on the window is centred on the galaxy. See docs/constants.md.
const FOLLOWS: f32 = 2.0;

/// Centre (x, y) of the galaxy from the middle of its stamp, in pixels; (0, 0) where none is found.
pub(crate) fn centre(stamp: &[f32], n: usize) -> [f32; 2] {
    moved(stamp, n, [0.0; 2], STEPS)
}

/// The centre that `STEPS` steps found, and for a galaxy that is far off its stamp's middle more steps: those of a large one
/// fall short.
pub(super) fn refined(stamp: &[f32], n: usize, found: [f32; 2]) -> [f32; 2] {
    if found[0].hypot(found[1]) < FAR {
        found
    } else {
        moved(stamp, n, found, MORE)
    }
}

fn moved(stamp: &[f32], n: usize, from: [f32; 2], steps: usize) -> [f32; 2] {
    let n = n as i32;
    let middle = (n as f32 - 1.0) / 2.0;
    let most = middle / 2.0;
    let [mut x, mut y] = from;
    for _ in 0..steps {
        let (first_x, first_y) = (start(middle + x), start(middle + y));
        let along = weights(first_x as f32 - middle - x);
        let down = weights(first_y as f32 - middle - y);
        let mut sums = [0.0f32; 3];
        for (j, weight) in down.into_iter().enumerate() {
            let row = first_y + j as i32;
            if !(0..n).contains(&row) {
                continue;
            }
            let (mut all, mut first) = (0.0, 0.0);
            for (i, weight) in along.iter().enumerate() {
                let column = first_x + i as i32;
                if (0..n).contains(&column) {
                    let light = weight * stamp[(row * n + column) as usize];
                    all += light;
                    first += light * (column as f32 - middle - x);
                }
            }
            let dy = row as f32 - middle - y;
            sums[0] += weight * all;
            sums[1] += weight * first;
            sums[2] += weight * all * dy;
        }
        if sums[0] <= 0.0 {
            return [0.0; 2];
        }
        let step = |sum: f32| STRIDE * (sum / sums[0]).clamp(-WEIGHT, WEIGHT);
        x = (x + step(sums[1])).clamp(-most, most);
        y = (y + step(sums[2])).clamp(-most, most);
    }
    [x, y]
}

/// Where the window is for a galaxy centred at `centre`.
pub(crate) fn followed(centre: [f32; 2]) -> [f32; 2] {
    let away = centre[0].hypot(centre[1]);
    let share = ((away - STAYS) / (FOLLOWS - STAYS)).clamp(0.0, 1.0);
    centre.map(|c| share * c)
}

/// First of the pixels under the weight.
fn start(centre: f32) -> i32 {
    centre.floor() as i32 + 1 - WEIGHT_REACH
}

/// The weight at places one pixel apart, of which the first is at `first`.
fn weights(first: f32) -> [f32; (2 * WEIGHT_REACH) as usize] {
    // exp(−(x + 1)²/2σ²) is exp(−x²/2σ²) times exp(−(2x + 1)/2σ²), whose ratio from place to place is exp(−1/σ²).
    let square = WEIGHT * WEIGHT;
    let mut value = (-0.5 * first * first / square).exp();
    let mut step = (-(first + 0.5) / square).exp();
    let ratio = (-1.0 / square).exp();
    std::array::from_fn(|_| {
        let here = value;
        value *= step;
        step *= ratio;
        here
    })
}
