//! Ranges of settings, and conditions between settings.

use crate::error::OutOfRange;
use crate::limits::{MAX_CUT, MAX_PSF, MAX_ROUGHNESS, MAX_TARGET, MIN_TARGET, WINDOWS};
use crate::name::{EXPECTED, check_name, shown};
use crate::settings::{
    Clipping, Configuration, Denoise, LinearDeconvolution, LinearMethod, Method,
    NetworkDeconvolution, NetworkMethod, NoiseSource, Update,
};
use serde::Serialize;

/// Checks a value.
fn need(
    good: bool,
    key: &'static str,
    found: &impl Serialize,
    expected: &'static str,
) -> Result<(), OutOfRange> {
    if good {
        return Ok(());
    }
    // As a settings file has it.
    let found = toml::Value::try_from(found).map_or_else(|e| e.to_string(), |v| v.to_string());
    Err(OutOfRange {
        key,
        found,
        expected,
    })
}

/// Checks a number that has to be finite.
fn real(
    good: bool,
    key: &'static str,
    found: f64,
    expected: &'static str,
) -> Result<(), OutOfRange> {
    if good && found.is_finite() {
        return Ok(());
    }
    Err(OutOfRange {
        key,
        found: found.to_string(),
        expected,
    })
}

impl Configuration {
    /// Checks every setting against its range, and against the settings that it must agree with.
    ///
    /// Files are checked when they are read. A configuration that is made or changed in code is checked here.
    ///
    /// # Errors
    /// The first setting that is out of range.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        let Configuration {
            name,
            description: _,
            stamp,
            psf,
            noise,
            method,
        } = self;
        if check_name(name).is_err() {
            return Err(OutOfRange {
                key: "name",
                found: shown(name),
                expected: EXPECTED,
            });
        }
        let n = stamp.size;
        let good = (5..=MAX_CUT).contains(&n);
        need(good, "stamp.size", &n, "5 to 64 pixels")?;
        let p = psf.size;
        let good = (3..=MAX_PSF).contains(&p);
        need(good, "psf.size", &p, "3 to 48 pixels")?;
        if let NoiseSource::Border { border } = noise {
            let good = (1..=16).contains(border);
            need(good, "noise.border", border, "1 to 16 pixels")?;
        }
        if let NoiseSource::Image { correlation, .. } = noise {
            let good = *correlation <= 4;
            need(good, "noise.correlation", correlation, "0 to 4 pixels")?;
        }
        match method {
            Method::Network(network) => network.validate(),
            Method::Linear(linear) => linear.validate(n, p),
        }
    }
}

fn step(step: f64) -> Result<(), OutOfRange> {
    real(step > 0.0, "deconvolution.step", step, "a positive number")
}

fn lambda(lambda: f64) -> Result<(), OutOfRange> {
    let expected = "zero or a positive number";
    real(lambda >= 0.0, "deconvolution.lambda", lambda, expected)
}

fn iterations(most: usize) -> Result<(), OutOfRange> {
    let good = (1..=100_000).contains(&most);
    need(good, "deconvolution.max_iterations", &most, "1 to 100000")
}

impl NetworkMethod {
    fn validate(&self) -> Result<(), OutOfRange> {
        let NetworkMethod {
            denoise,
            deconvolution,
            shape,
        } = self;
        if let Denoise::WaveletWiener(d) = denoise {
            let good = (1..=4).contains(&d.levels);
            need(good, "denoise.levels", &d.levels, "1 to 4")?;
            let good = d.window <= 8;
            need(good, "denoise.window", &d.window, "0 to 8 pixels")?;
            let k = d.strength;
            real(k > 0.0, "denoise.strength", k, "a positive number")?;
        }
        let NetworkDeconvolution {
            update,
            step: c,
            step_scale: _,
            constant_step,
            lambda: l,
            max_iterations,
            start: _,
            clipping,
            kept: _,
            brightness_unit: _,
            unit_divisor,
            psf_scale: _,
            high_pass_divisor,
        } = deconvolution;
        step(*c)?;
        let (key, c) = ("deconvolution.constant_step", *constant_step);
        real(c > 0.0, key, c, "a positive number")?;
        lambda(*l)?;
        iterations(*max_iterations)?;
        let (key, u) = ("deconvolution.unit_divisor", *unit_divisor);
        real(u > 0.0, key, u, "a positive number")?;
        let (key, d) = ("deconvolution.high_pass_divisor", *high_pass_divisor);
        let good = (1e-3..=1e6).contains(&d);
        real(good, key, d, "0.001 to 1e6")?;
        // Momentum goes on from a state of its own, which nothing would clip.
        need(
            !(*clipping == Clipping::AfterTest && *update == Update::Accelerated),
            "deconvolution.clipping",
            clipping,
            "\"before-test\" or \"never\" with update = \"accelerated\"",
        )?;
        let a = shape.acf_share;
        let good = a > 0.0 && a <= 1.0;
        real(good, "shape.acf_share", a, "above 0 and at most 1")
    }
}

impl LinearMethod {
    /// Checks the settings for stamps of `n` pixels a side and PSFs of `p`.
    fn validate(&self, n: usize, p: usize) -> Result<(), OutOfRange> {
        let LinearDeconvolution {
            step: c,
            lambda: l,
            max_iterations,
            target_sigma: target,
            window_sigma: window,
            reference_extent: extent,
            reference_area: area,
        } = self.deconvolution;
        let (scale, half) = (self.shape.weight_scale, self.shape.half_snr);
        step(c)?;
        lambda(l)?;
        iterations(max_iterations)?;
        let good = (MIN_TARGET..=MAX_TARGET).contains(&target);
        real(good, "deconvolution.target_sigma", target, "1 to 6 pixels")?;
        let good = WINDOWS.contains(&window);
        real(good, "deconvolution.window_sigma", window, "2 to 16 pixels")?;
        let good = extent == 0.0 || (0.1..=1e3).contains(&extent);
        real(
            good,
            "deconvolution.reference_extent",
            extent,
            "0, or 0.1 to 1000 px²",
        )?;
        let good = area == 0.0 || (1.0..=1e4).contains(&area);
        real(
            good,
            "deconvolution.reference_area",
            area,
            "0, or 1 to 10000 px²",
        )?;
        let good = (0.5..=10.0).contains(&scale);
        real(good, "shape.weight_scale", scale, "0.5 to 10 pixels")?;
        let good = (0.0..=1e3).contains(&half);
        real(good, "shape.half_snr", half, "0 to 1000")?;
        let h = self.shape.sheared_step;
        let good = h == 0.0 || (1e-3..=0.05).contains(&h);
        real(good, "shape.sheared_step", h, "0, or 0.001 to 0.05")?;
        // The largest eigenvalue of W is 1 for a PSF of sum one.
        need(
            c * (1.0 + MAX_ROUGHNESS * l) < 2.0,
            "deconvolution.step",
            &c,
            "step·(1 + 0.0093 lambda) below 2 with the linear method, which diverges beyond",
        )?;
        // Lags are up to 0.95 target_sigma apart; of a sharper weight their sums depend on where they lie.
        need(
            scale >= target,
            "shape.weight_scale",
            &scale,
            "at least deconvolution.target_sigma",
        )?;
        need(
            n % 2 == p % 2,
            "psf.size",
            &p,
            "even with an even stamp.size and odd with an odd one, with the linear method, whose window is centred on the stamp",
        )?;
        // A wider one sees a galaxy that is beyond the stamp, and what wraps around.
        need(
            4.0 * window <= n as f64,
            "deconvolution.window_sigma",
            &window,
            "at most a quarter of stamp.size with the linear method",
        )
    }
}
