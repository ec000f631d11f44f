//! Checks of baselines as a table and as JUnit.

use std::fmt::Write;

use crate::baseline::Checked;
use shearq_render::escape::markup as escape;
use shearq_render::table::{Cell, Heading, Table};

/// The metrics of all checks, or only the moved ones.
pub fn shift_table(checks: &[Checked], all: bool) -> Table {
    let headings = [
        ("baseline", "Baseline"),
        ("submission", "Configuration"),
        ("set", "Set"),
        ("metric", "Metric"),
        ("before", "Before"),
        ("now", "Now"),
        ("difference", "Difference"),
        ("sigma", "in σ"),
        ("moved", "Moved"),
    ];
    let mut rows = Vec::new();
    for check in checks {
        for shift in check.shifts.iter().filter(|shift| all || shift.moved) {
            let cell = |[value, error]: [f64; 2]| {
                Cell::with_error(value, Some(error).filter(|e| e.is_finite()), 6)
            };
            rows.push(vec![
                Cell::text(&check.baseline),
                Cell::text(&check.configuration),
                Cell::number(f64::from(shift.set), 0),
                Cell::text(shift.metric),
                cell(shift.before),
                cell(shift.now),
                Cell::number(shift.now[0] - shift.before[0], 6),
                Cell::number(shift.sigma, 3),
                Cell::text(if shift.moved { "yes" } else { "no" }),
            ]);
        }
    }
    let compared: usize = checks.iter().map(|check| check.shifts.len()).sum();
    let moved = checks
        .iter()
        .flat_map(|check| &check.shifts)
        .filter(|shift| shift.moved)
        .count();
    let mut notes = vec![format!(
        "{moved} of {compared} metrics of {} configuration(s) moved by more than rounding or noise. In σ: difference over the standard error of the metric.",
        checks.len()
    )];
    for check in checks {
        let name = format!("{}, {}", check.baseline, check.configuration);
        for line in &check.settings {
            notes.push(format!("{name}: the setting changed: {line}"));
        }
        for line in &check.notes {
            notes.push(format!("{name}: {line}"));
        }
    }
    Table {
        title: "Shifts from baselines".into(),
        headings: headings.map(|(key, label)| Heading::new(key, label)).into(),
        rows,
        notes,
    }
}

/// The checks as JUnit: a suite per baseline, a case per configuration.
pub fn junit(checks: &[Checked]) -> String {
    let mut text = String::from("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuites>\n");
    for suite in checks.chunk_by(|a, b| a.baseline == b.baseline) {
        let failures = suite.iter().filter(|check| check.failed()).count();
        let name = escape(&suite[0].baseline);
        // Writing to a `String` cannot fail.
        let _ = writeln!(
            text,
            "  <testsuite name=\"{name}\" tests=\"{}\" failures=\"{failures}\">",
            suite.len()
        );
        for check in suite {
            let configuration = escape(&check.configuration);
            let _ = write!(
                text,
                "    <testcase classname=\"baseline.{name}\" name=\"{configuration}\""
            );
            if check.failed() {
                let lines = check.moved();
                let _ = writeln!(
                    text,
                    ">\n      <failure message=\"{} moved\">{}</failure>\n    </testcase>",
                    lines.len(),
                    escape(&lines.join("\n"))
                );
            } else {
                text.push_str("/>\n");
            }
        }
        text.push_str("  </testsuite>\n");
    }
    text.push_str("</testsuites>\n");
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::baseline::Shift;

    #[test]
    fn junit_counts_failures_and_escapes_names() {
        let shift = Shift {
            set: 2,
            metric: "q",
            before: [80.0, 2.0],
            now: [81.0, 2.0],
            sigma: 0.5,
            moved: true,
        };
        let check = |configuration: &str, shifts: Vec<Shift>| Checked {
            baseline: "small".into(),
            configuration: configuration.into(),
            shifts,
            settings: Vec::new(),
            stored: false,
            notes: Vec::new(),
        };
        let text = junit(&[check("a<b", vec![shift]), check("c", Vec::new())]);
        assert!(text.contains("tests=\"2\" failures=\"1\""), "{text}");
        assert!(text.contains("name=\"a&lt;b\"") && text.contains("+0.50 σ"));
        assert!(text.contains("name=\"c\"/>"));
    }
}
