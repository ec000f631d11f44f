//! Phases of displaced images.

use shearq_quantities::fourier::{Complex32, Complex64};

/// e^{−ik·x} of a shift along both axes, of wavenumbers from 0.
#[derive(Debug, Default)]
pub(super) struct Phases {
    pub(super) x_re: Vec<f32>,
    pub(super) x_im: Vec<f32>,
    pub(super) y: Vec<Complex32>,
}

impl Phases {
    pub(super) fn set(&mut self, step: f64, count: usize, x: f64, y: f64) {
        let powers = |shift: f64| {
            let turn = Complex64::from_polar(1.0, -step * shift);
            std::iter::successors(Some(Complex64::ONE), move |phase| Some(phase * turn))
                .take(count)
                .map(|phase| Complex32::new(phase.re as f32, phase.im as f32))
        };
        self.x_re.clear();
        self.x_im.clear();
        for phase in powers(x) {
            self.x_re.push(phase.re);
            self.x_im.push(phase.im);
        }
        self.y.clear();
        self.y.extend(powers(y));
    }
}
