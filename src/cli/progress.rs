//! A progress bar on standard error, none when it is not a terminal.

use std::io::IsTerminal;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::pipeline::Progress;

/// Galaxies done, rate and time left.
pub(super) struct Bar(ProgressBar);

impl Bar {
    /// A bar over `galaxies`, with `what` in front.
    pub(super) fn new(what: &'static str, galaxies: u64) -> Self {
        let target = if std::io::stderr().is_terminal() {
            ProgressDrawTarget::stderr_with_hz(5)
        } else {
            ProgressDrawTarget::hidden()
        };
        let bar = ProgressBar::with_draw_target(Some(galaxies), target);
        let template =
            "{prefix} {bar:30} {human_pos}/{human_len} galaxies, {per_sec}, {eta} left  {msg}";
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style);
        }
        bar.set_prefix(what);
        Bar(bar)
    }
}

impl Progress for Bar {
    fn advance(&mut self, galaxies: u64) {
        self.0.inc(galaxies);
    }

    fn note(&mut self, line: &str) {
        self.0.set_message(line.to_owned());
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.0.finish_and_clear();
    }
}
