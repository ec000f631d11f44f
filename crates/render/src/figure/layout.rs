//! Where titles and labels stand, the same in every plot with axes.

use super::colour::INK;
use super::scene::{Anchor, Point, Scene};
use super::{LABEL_SIZE, MARGIN, TITLE_SIZE};

/// Height of a label with the space beside it; zero for an empty label.
pub fn label_room(label: &str) -> f64 {
    if label.is_empty() {
        0.0
    } else {
        LABEL_SIZE + 6.0
    }
}

/// Height of a title with the space below it; zero for an empty title.
pub fn title_room(title: &str) -> f64 {
    if title.is_empty() {
        0.0
    } else {
        TITLE_SIZE + 10.0
    }
}

/// Draws the title at the top, centred at x = `middle`.
pub fn draw_title(scene: &mut Scene, title: &str, middle: f64) {
    let baseline = (middle, MARGIN + TITLE_SIZE);
    scene.text(title, baseline, TITLE_SIZE, INK, Anchor::Middle);
}

/// Draws a label centred at `baseline`.
pub fn draw_label(scene: &mut Scene, label: &str, baseline: Point) {
    scene.text(label, baseline, LABEL_SIZE, INK, Anchor::Middle);
}

/// Draws a label that runs upwards, centred at `baseline`.
pub fn draw_label_upwards(scene: &mut Scene, label: &str, baseline: Point) {
    scene.text_upwards(label, baseline, LABEL_SIZE, INK, Anchor::Middle);
}
