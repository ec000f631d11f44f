//! Checks as JUnit, which systems of continuous integration read.

use quick_junit::{NonSuccessKind, Report, TestCase, TestCaseStatus, TestSuite};
use shearq_render::escape::visible;

pub(crate) struct Case<'a> {
    pub class: String,
    pub name: &'a str,
    /// One line and, if there is more to say, details of a failure.
    pub failure: Option<(String, Option<String>)>,
}

pub(crate) fn document<'a>(suites: impl IntoIterator<Item = (&'a str, Vec<Case<'a>>)>) -> String {
    let mut report = Report::new("shearq");
    for (name, cases) in suites {
        let mut suite = TestSuite::new(visible(name));
        for case in cases {
            let status = match case.failure {
                None => TestCaseStatus::success(),
                Some((message, details)) => {
                    let mut status = TestCaseStatus::non_success(NonSuccessKind::Failure);
                    status.set_message(visible(&message));
                    if let Some(details) = details {
                        status.set_description(details);
                    }
                    status
                }
            };
            let mut test = TestCase::new(visible(case.name), status);
            test.set_classname(visible(&case.class));
            suite.add_test_case(test);
        }
        report.add_test_suite(suite);
    }
    // Writing to a `String` cannot fail.
    report.to_string().unwrap_or_default()
}
