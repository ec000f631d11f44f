//! Progress of long work on standard error: a bar on a terminal, a line each minute in a log file, and a line when Ctrl-C stops the
//! work.

use std::fmt::Write;
use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use indicatif::{
    HumanCount, HumanDuration, ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle,
};

use crate::{is_quiet, tell};
use shearq_dataset::threads::{Progress, Quiet};

// Between two lines of a log file: a job of hours writes a few hundred.
const LOG_INTERVAL: Duration = Duration::from_secs(60);

pub(super) struct Bar {
    bar: ProgressBar,
    // When a log file gets its next line; none on a terminal.
    next_line: Option<Instant>,
    // What an earlier call did, without which the rate would be far too high after a resumption.
    skipped: Arc<AtomicU64>,
    unit: &'static str,
}

impl Bar {
    pub(super) fn new(what: &'static str, galaxies: u64) -> Self {
        Bar::of(what, "galaxies", galaxies)
    }

    /// Of work that is counted in a `unit`.
    pub(super) fn of(what: &'static str, unit: &'static str, all: u64) -> Self {
        let (target, next_line) = if is_quiet() {
            (ProgressDrawTarget::hidden(), None)
        } else if std::io::stderr().is_terminal() {
            (ProgressDrawTarget::stderr_with_hz(5), None)
        } else {
            // In log files a bar would be thousands of lines.
            (
                ProgressDrawTarget::hidden(),
                Some(Instant::now() + LOG_INTERVAL),
            )
        };
        let bar = ProgressBar::with_draw_target(Some(all), target);
        let skipped = Arc::new(AtomicU64::new(0));
        let template = "{prefix} {wide_bar} {percent}% of {human_len}{pace}{msg}";
        if let Ok(style) = ProgressStyle::with_template(template) {
            let skipped = Arc::clone(&skipped);
            let pace = move |state: &ProgressState, out: &mut dyn Write| {
                let left = state.len().unwrap_or(0).saturating_sub(state.pos());
                let done = state.pos().saturating_sub(skipped.load(Ordering::Relaxed));
                // A failed write cannot be reported from here.
                let _ = out.write_str(&pace(done, left, state.elapsed().as_secs_f64()));
            };
            bar.set_style(style.with_key("pace", pace));
        }
        bar.set_prefix(what);
        Bar {
            bar,
            next_line,
            skipped,
            unit,
        }
    }

    fn log(&mut self) {
        let now = Instant::now();
        if self.next_line.is_none_or(|next| now < next) {
            return;
        }
        self.next_line = Some(now + LOG_INTERVAL);
        tell(format_args!("{}", self.line()));
    }

    fn line(&self) -> String {
        let (done, all) = (self.bar.position(), self.bar.length().unwrap_or(0));
        let new = done.saturating_sub(self.skipped.load(Ordering::Relaxed));
        format!(
            "{}: {}% of {} {}{}",
            self.bar.prefix(),
            100 * done / all.max(1),
            HumanCount(all),
            self.unit,
            pace(
                new,
                all.saturating_sub(done),
                self.bar.elapsed().as_secs_f64()
            )
        )
    }
}

// Of catalogues that are read and summed.
pub(super) fn reading(catalogues: u64) -> Box<dyn Progress> {
    match catalogues {
        // The bar of one would be at 0 until the end.
        0 | 1 => Box::new(Quiet),
        _ => Box::new(Bar::of("reading", "catalogues", catalogues)),
    }
}

// Cells of a bar that shows how far the work is, and of the texts beside it: `measuring  100% of 48,000,000, 12,345/s, 59m left`.
const BAR_CELLS: usize = 12;
const TEXT_CELLS: usize = 50;

// The image of which the work is, if it leaves room for the bar.
fn message(line: &str, width: usize) -> String {
    let text = format!("  {line}");
    match TEXT_CELLS + BAR_CELLS + text.chars().count() <= width {
        true => text,
        false => String::new(),
    }
}

// Rate and remaining time after `done` galaxies in `seconds`.
fn pace(done: u64, left: u64, seconds: f64) -> String {
    if done == 0 || seconds <= 0.0 {
        return String::new();
    }
    let rate = done as f64 / seconds;
    let time = Duration::from_secs_f64((left as f64 / rate).min(1e9));
    format!(
        ", {}/s, {:#} left",
        HumanCount(rate.round() as u64),
        HumanDuration(time)
    )
}

impl Progress for Bar {
    fn advance(&mut self, galaxies: u64) {
        self.bar.inc(galaxies);
        self.log();
    }

    fn skip(&mut self, galaxies: u64) {
        self.skipped.fetch_add(galaxies, Ordering::Relaxed);
        self.bar.inc(galaxies);
    }

    fn note(&mut self, line: &str) {
        let terminal = terminal_size::terminal_size_of(std::io::stderr());
        let width = terminal.map_or(usize::MAX, |(width, _)| usize::from(width.0));
        self.bar.set_message(message(line, width));
    }

    fn warn(&mut self, line: &str) {
        self.bar.suspend(|| tell(format_args!("{line}")));
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}

// Whether the same command would resume the work, which the message after Ctrl-C then says. Static, because the handler of the
// signal has no other access to the command.
static RESUMABLE: AtomicBool = AtomicBool::new(false);

pub(super) fn mark_resumable() {
    RESUMABLE.store(true, Ordering::Relaxed);
}

// Exit code after Ctrl-C, as in shells.
const INTERRUPTED: i32 = 130;

// Ends the process at once instead of finishing its galaxies: files are written atomically, so that each is complete or absent.
pub(super) fn end_at_interrupt() {
    let handler = || {
        let resumable = RESUMABLE.load(Ordering::Relaxed);
        tell(format_args!(
            "\nstopped{}",
            match resumable {
                true => "; the same command resumes",
                false => "",
            }
        ));
        std::process::exit(INTERRUPTED);
    };
    // Without the handler, Ctrl-C ends the process silently.
    let _ = ctrlc::set_handler(handler);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_the_image_leaves_room_for_the_bar() {
        assert_eq!(message("set 01 image 002", 80), "  set 01 image 002");
        assert_eq!(message("measuring the first images", 80), "");
    }

    #[test]
    fn lines_of_a_log_name_what_is_counted() {
        let mut bar = Bar::of("reading", "catalogues", 12_000);
        bar.skip(1000);
        bar.advance(5000);
        let line = bar.line();
        assert!(
            line.starts_with("reading: 50% of 12,000 catalogues, "),
            "{line}"
        );
        assert!(line.ends_with(" left"), "{line}");
    }

    #[test]
    fn the_rate_counts_new_galaxies_only() {
        assert_eq!(pace(0, 10, 1.0), "");
        assert_eq!(pace(5506, 11012, 1.0), ", 5,506/s, 2s left");
    }
}
