//! The PSF's orientation: deconvolution undoes it, and a turned or flipped PSF does not.

use ndarray::{Array2, ArrayView2};
use shearq_measure::{ImageNoise, Measurer};
use shearq_quantities::PsfTransform;
use shearq_quantities::Shear;
use shearq_quantities::{FunctionalPsf, PsfProfile};
use shearq_simulate::galaxy::Galaxy;
use shearq_simulate::render::{RenderScratch, Renderer};
use shearq_submissions::{Denoise, Method, Registry, StepScale};

#[test]
fn a_round_galaxy_comes_out_round_only_with_its_own_psf() {
    let profile = PsfProfile::Moffat { beta: 3.0 };
    let psf = FunctionalPsf::new(profile, 3.4, Shear::new(0.12, 0.08)).unwrap();
    let transform = PsfTransform::new(profile).unwrap();
    let galaxy = Galaxy::bulge_and_disc(1e4, 0.0, 2.3, 2.5, Shear::ZERO).unwrap();
    let mut stamp = vec![0.0; 48 * 48];
    Renderer::new(48).render(
        &galaxy,
        &transform.of(&psf).unwrap(),
        (23.7, 23.4),
        &mut RenderScratch::new(),
        &mut stamp,
    );
    let mut submission = Registry::embedded()
        .unwrap()
        .get("29/den/func")
        .unwrap()
        .configuration;
    submission.psf.size = 25;
    let Method::Network(network) = &mut submission.method else {
        panic!("29/den/func has the network");
    };
    network.denoise = Denoise::None;
    network.deconvolution.step_scale = StepScale::Fixed;
    network.deconvolution.step = 1.5;
    network.deconvolution.max_iterations = 300;
    network.deconvolution.unit_divisor = 1e9;
    let measurer = Measurer::new(&submission, 48).unwrap();
    let own = psf.stamp(25);
    let stamp = ArrayView2::from_shape((48, 48), &stamp).unwrap();
    let measure = |psf: &Array2<f64>| {
        let mut worker = measurer.worker();
        let mut image = worker.image(ImageNoise::Unknown);
        let m = image.psf(psf.view()).unwrap().measure(stamp).unwrap();
        assert!(m.flags.is_empty());
        (m.e1, m.e2)
    };
    let (e1, e2) = measure(&own);
    // What is left is the start not yet forgotten and the PSF's wings beyond its stamp.
    assert!(e1.hypot(e2) < 0.02, "{e1} {e2}");
    let mut flipped = own.clone();
    flipped.invert_axis(ndarray::Axis(1));
    let (e1, e2) = measure(&flipped);
    assert!(e2 > 0.05 && e1.abs() < 0.03, "flipped in x: {e1} {e2}");
    let mut turned = own.t().to_owned();
    turned.invert_axis(ndarray::Axis(0));
    let (e1, e2) = measure(&turned);
    assert!(e1 > 0.08 && e2 > 0.05, "turned by 90°: {e1} {e2}");
}
