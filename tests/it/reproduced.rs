//! The paper's qualitative findings on small simulated sets, where their noise allows.

use shearq::pipeline::Quiet;
use shearq::simulate::set::SimulationSettings;
use shearq::study::calibration::calibrate;
use shearq::study::exhibits::{Finding, findings, lambda_findings};
use shearq::study::reproduce::{Plan, Study, run_sets};
use shearq_submissions::Registry;

/// Whether the finding that begins with `paper` agrees.
fn agrees(findings: &[Finding], paper: &str) -> bool {
    let finding = findings.iter().find(|f| f.paper.starts_with(paper));
    let finding = finding.unwrap_or_else(|| panic!("no finding `{paper}`"));
    eprintln!("{paper}: {}", finding.here);
    finding.agrees == Some(true)
}

#[test]
fn submissions_compare_as_the_paper_found() {
    let registry = Registry::embedded().unwrap();
    let (submissions, names) = registry
        .published()
        .unwrap()
        .into_iter()
        .map(|(submission, _)| (submission.clone(), submission.name))
        .unzip::<_, _, Vec<_>, Vec<_>>();
    let plan = Plan {
        version: "test".into(),
        simulation: SimulationSettings::new(5, 16),
        images: 6,
        submissions,
    };
    let folder = tempfile::tempdir().unwrap();
    // Fiducial, low S/N, high S/N, small galaxies: 1,536 galaxies each. The differences are many
    // times their errors: denoising 30 %, S/N and size factors of two, PSF form below 1 %.
    let study = Study::open(&plan, folder.path()).unwrap();
    let results = run_sets(&study, &[2, 5, 8, 14], 2, &mut Quiet).unwrap();
    let found = findings(&results, &names);
    for paper in [
        "Denoising improves Q (star PSF)",
        "Denoising improves Q (functional PSF)",
        "Star and functional PSF",
        "Q is poor at low S/N",
        "Q is poor for small galaxies",
    ] {
        assert!(agrees(&found, paper), "{paper}");
    }
    // Denoising lowers the scatter of calibrated ellipticities at S/N 10, 20 and 40: by 15 to 25 %,
    // with errors of 1.3 % each.
    let place = |name: &str| names.iter().position(|n| n == name).unwrap();
    let (raw, den) = (place("23/raw/star"), place("23/den/star"));
    for set in &results[..3] {
        let scatter = |k: usize| set.results[k].response.rms_scatter();
        let (raw, den) = (scatter(raw), scatter(den));
        assert!(den < 0.95 * raw, "set {}: {den} of {raw}", set.set);
    }
}

#[test]
fn updates_compare_as_the_paper_found() {
    let submission = Registry::embedded()
        .unwrap()
        .get("paper")
        .unwrap()
        .submission;
    // CTR rests on 10⁴ transitions a galaxy; 1/RMSD of both rules on the same galaxies.
    let curves = calibrate(&submission, 40, 3, 2, &mut Quiet).unwrap();
    let found = lambda_findings(&curves);
    for paper in [
        "Whatever the S/N, the adaptive update has the higher CTR",
        "dSNR is higher for higher S/N and decreases with λ",
        "1/RMSD of the adaptive update is the better one for λ ≤ 10⁻⁴",
    ] {
        assert!(agrees(&found, paper), "{paper}");
    }
}
