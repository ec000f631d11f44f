//! Checks of baselines as a table and as JUnit.

use shearq_render::table::{Cell, Heading, Table};

use super::junit::{Case, document};
use crate::baseline::Checked;

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
    let suites = checks.chunk_by(|a, b| a.baseline == b.baseline);
    document(suites.map(|suite| {
        let baseline = suite[0].baseline.as_str();
        let cases = suite.iter().map(|check| Case {
            class: format!("baseline.{baseline}"),
            name: &check.configuration,
            failure: check.failed().then(|| {
                let lines = check.moved();
                (format!("{} moved", lines.len()), Some(lines.join("\n")))
            }),
        });
        (baseline, cases.collect())
    }))
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
        let totals = "name=\"small\" tests=\"2\" skipped=\"0\" errors=\"0\" failures=\"1\"";
        assert!(text.contains(totals), "{text}");
        assert!(text.contains("name=\"a&lt;b\"") && text.contains("+0.50 σ"));
        assert!(text.contains("name=\"c\" classname=\"baseline.small\"/>"));
    }
}
