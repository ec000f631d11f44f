//! The linear method for PSFs and galaxies of any breadth: a member for each step of either.
//!
//! What a PSF destroys follows its width, and so do the Gaussian that the deconvolved stamp is convolved with and
//! the weight of the moments: a target much sharper than the PSF is made of noise. The window, which keeps out noise
//! beyond the galaxy, follows the galaxies.

use std::sync::{Arc, OnceLock};

use ndarray::ArrayView2;
use shearq_submissions::limits::{MAX_TARGET, MIN_TARGET};
use shearq_submissions::{LinearMethod, PsfCut};

use super::found::{AdaptedSettings, CutWorker, Found, Images};
use super::linear::{LinearPlan, LinearWorker};
use super::window;
use crate::error::MeasureError;
use crate::extent::Moments;
use crate::noise::StampNoise;
use crate::psf::CommonProfile;
use crate::psf::breadth;
use crate::psf::shrink::Shrinker;

/// What one submission and stamp size need.
pub(crate) struct LinearFamily {
    method: LinearMethod,
    n: usize,
    cut: PsfCut,
    first: Arc<LinearPlan>,
    /// Of each step of the PSF, for each window; planned when first needed.
    members: Vec<[OnceLock<Arc<LinearPlan>>; window::COUNT]>,
}

impl LinearFamily {
    pub(super) fn new(method: &LinearMethod, n: usize, cut: PsfCut) -> Result<Self, MeasureError> {
        Ok(LinearFamily {
            method: method.clone(),
            n,
            cut,
            first: Arc::new(LinearPlan::new(
                method,
                n,
                cut.size,
                extent(method, window::OWN),
            )?),
            members: breadth::STEPS.map(|_| Default::default()).collect(),
        })
    }

    fn member(&self, kind: Kind) -> Result<Arc<LinearPlan>, MeasureError> {
        if kind == Kind::OWN {
            return Ok(Arc::clone(&self.first));
        }
        let Kind { step, window } = kind;
        let place = &self.members[(step - breadth::STEPS.start()) as usize][window];
        if let Some(plan) = place.get() {
            return Ok(Arc::clone(plan));
        }
        let mut method = self.method.clone();
        let target = &mut method.deconvolution.target_sigma;
        // A target beyond the bounds is the submission's own.
        let (least, most) = (MIN_TARGET / *target, MAX_TARGET / *target);
        let factor = breadth::factor(step).clamp(least.min(1.0), most.max(1.0));
        *target *= factor;
        method.shape.weight_scale *= factor;
        let extent = extent(&method, window);
        let own = &mut method.deconvolution.window_sigma;
        *own = window::sigma(*own, window, self.n);
        let plan = LinearPlan::new(&method, self.n, self.cut.size, extent)?;
        Ok(Arc::clone(place.get_or_init(|| Arc::new(plan))))
    }

    /// The member for a PSF of sum one, and galaxies that are seen so broad.
    fn kind(&self, psf: ArrayView2<'_, f64>, extent: Option<f64>, moments: &mut Moments) -> Kind {
        let settings = &self.method.deconvolution;
        Kind {
            step: breadth::step(psf, settings.reference_area),
            window: window::place(extent, psf, settings.reference_extent, moments),
        }
    }
}

/// Of the galaxies that the window at `place` is for.
fn extent(method: &LinearMethod, place: usize) -> f64 {
    let settings = &method.deconvolution;
    window::extent(settings.reference_extent, settings.window_sigma, place)
}

/// What tells a member from the others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Kind {
    /// Of the PSF's breadth.
    step: i32,
    /// Place of the window's width.
    window: usize,
}

impl Kind {
    /// Lengths as they are set.
    const OWN: Kind = Kind {
        step: 0,
        window: window::OWN,
    };
}

/// A worker for one thread.
pub(super) fn worker(family: Arc<LinearFamily>) -> Box<dyn CutWorker> {
    Box::new(FamilyWorker {
        members: vec![(Kind::OWN, LinearWorker::new(Arc::clone(&family.first)))],
        at: 0,
        extent: None,
        moments: Moments::default(),
        shrinker: Shrinker::default(),
        noise: StampNoise::white(1.0),
        family,
    })
}

struct FamilyWorker {
    family: Arc<LinearFamily>,
    /// Members that were needed so far.
    members: Vec<(Kind, LinearWorker)>,
    /// The one for the PSF at hand.
    at: usize,
    noise: StampNoise,
    extent: Option<f64>,
    moments: Moments,
    shrinker: Shrinker,
}

impl CutWorker for FamilyWorker {
    fn set_image(
        &mut self,
        noise: &StampNoise,
        extent: Option<f64>,
        stars: Option<&Arc<CommonProfile>>,
    ) {
        self.shrinker.set_common(stars);
        self.extent = extent;
        // The noise of each mode takes as long as several galaxies, and rows of an image have the same.
        if self.noise != *noise {
            self.noise = noise.clone();
            for (_, member) in &mut self.members {
                member.set_noise(noise);
            }
        }
    }

    fn set_psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<(), MeasureError> {
        let PsfCut { size, least, .. } = self.family.cut;
        let side = psf.nrows();
        if !(least..=size).contains(&side) || side % 2 != size % 2 {
            let parity = if size % 2 == 0 { "an even" } else { "an odd" };
            let expected = format!("{parity} number a side, {least} to {size}");
            return Err(MeasureError::square("a PSF stamp", psf.dim(), expected));
        }
        let psf = self.shrinker.shrunk(psf);
        let kind = self.family.kind(psf, self.extent, &mut self.moments);
        let known = self.members.iter().position(|(of, _)| *of == kind);
        self.at = if let Some(at) = known {
            at
        } else {
            let mut member = LinearWorker::new(self.family.member(kind)?);
            member.set_noise(&self.noise);
            self.members.push((kind, member));
            self.members.len() - 1
        };
        self.members[self.at].1.set_psf(psf)
    }

    fn adapted(&self) -> Option<AdaptedSettings> {
        self.members[self.at].1.adapted()
    }

    fn measure(&mut self, cut: &[f32], noise: f64) -> Result<Option<Found>, MeasureError> {
        self.members[self.at].1.measure(cut, noise)
    }

    fn images(&mut self, cut: &[f32], psf: ArrayView2<'_, f64>) -> Images {
        self.members[self.at].1.images(cut, psf)
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use shearq_quantities::Shear;
    use shearq_submissions::{Configuration, Method, Registry};

    use std::sync::Arc;

    use crate::galaxy::Measurer;
    use crate::measurement::Measurement;
    use crate::noise::{StampNoise, Survey};
    use crate::worker::ImageNoise;
    use shearq_quantities::{FunctionalPsf, PsfProfile};

    fn configuration(reference_area: f64) -> Configuration {
        let mut configuration = Registry::embedded()
            .unwrap()
            .get("48/linear/star")
            .unwrap()
            .configuration;
        if let Method::Linear(linear) = &mut configuration.method {
            linear.deconvolution.reference_area = reference_area;
        }
        configuration
    }

    fn moffat(fwhm: f64) -> FunctionalPsf {
        let profile = PsfProfile::Moffat { beta: 3.0 };
        FunctionalPsf::new(profile, fwhm, Shear::new(0.03, -0.02)).unwrap()
    }

    /// Of a galaxy as broad as the PSF, elongated along x, with the σ of the target.
    fn measured(
        configuration: &Configuration,
        fwhms: &[f64],
        noise: f64,
    ) -> Vec<(Measurement, f64)> {
        let mut worker = Measurer::new(configuration, 48).unwrap().worker();
        let each = fwhms.iter().map(|&fwhm| {
            let psf = moffat(fwhm).stamp_beside(configuration.psf_cut().size, 48);
            let stamp = Array2::from_shape_fn((48, 48), |(y, x)| {
                let (y, x) = (y as f64 - 23.5, x as f64 - 23.5);
                (100.0 * (-(x * x / 1.2 + y * y) / (fwhm * fwhm)).exp()) as f32
            });
            let mut image = worker.image(ImageNoise::Level(noise));
            let mut worker = image.psf(psf.view()).unwrap();
            let found = worker.measure(stamp.view()).unwrap();
            (found, worker.adapted().unwrap().target_sigma)
        });
        each.collect()
    }

    #[test]
    fn usual_psfs_are_measured_as_without_a_family_broad_ones_more_smoothly_and_narrow_ones_less() {
        let (with, without) = (configuration(50.0), configuration(0.0));
        let fwhms = [3.4, 6.0, 3.06, 2.0];
        let found = measured(&with, &fwhms, 0.5);
        let plain = measured(&without, &fwhms, 0.5);
        for k in [0, 2] {
            assert_eq!(
                (found[k].0.e1, found[k].0.response),
                (plain[k].0.e1, plain[k].0.response)
            );
        }
        assert!(found[1].1 > 1.2 * plain[1].1, "{found:?} {plain:?}");
        assert!(found[3].1 < 0.8 * plain[3].1, "{found:?} {plain:?}");
        // Whatever was measured before, and on whichever worker.
        let alone = measured(&with, &[6.0], 0.5);
        assert_eq!(
            (found[1].0.e1, found[1].0.e2),
            (alone[0].0.e1, alone[0].0.e2)
        );
    }

    #[test]
    fn windows_follow_the_galaxies_of_the_image() {
        let configuration = configuration(50.0);
        let mut worker = Measurer::new(&configuration, 48).unwrap().worker();
        let psf = moffat(3.4).stamp_beside(configuration.psf_cut().size, 48);
        let stamp = moffat(6.0).stamp(48).mapv(|v| 1000.0 * v as f32);
        let mut radius = |extent: Option<f64>| {
            let survey = Survey {
                noise: StampNoise::white(0.1),
                extent,
                sky: None,
            };
            let survey = Arc::new(survey);
            let mut image = worker.image(ImageNoise::Survey(&survey));
            let mut worker = image.psf(psf.view()).unwrap();
            let found = worker.measure(stamp.view()).unwrap();
            assert!(found.e1.is_finite() && found.noise == 0.1, "{found:?}");
            (found.radius, worker.adapted().unwrap().window_sigma)
        };
        let [own, narrow, wide, again] = [None, Some(4.0), Some(30.0), Some(13.0)].map(&mut radius);
        // In steps of the lags; the stamp's side limits the wide one.
        assert!(
            narrow.0 < 0.7 * own.0 && wide.0 > own.0 && again == own,
            "{narrow:?} {own:?} {wide:?} {again:?}"
        );
        assert!(narrow.1 < own.1 && wide.1 > own.1);
        assert_eq!(
            own.1,
            configuration.linear().unwrap().deconvolution.window_sigma
        );
    }

    #[test]
    fn a_psf_is_taken_in_any_size_from_the_least_on_and_zeros_around_it_do_nothing() {
        let configuration = configuration(50.0);
        let mut worker = Measurer::new(&configuration, 48).unwrap().worker();
        let stamp = moffat(8.0).stamp(48).mapv(|v| 1000.0 * v as f32);
        let star = moffat(6.0).stamp(36);
        let mut wide = Array2::zeros((48, 48));
        wide.slice_mut(ndarray::s![6..42, 6..42]).assign(&star);
        let mut image = worker.image(ImageNoise::Level(0.1));
        let [small, large] = [&star, &wide].map(|psf| {
            let mut worker = image.psf(psf.view()).unwrap();
            worker.measure(stamp.view()).unwrap()
        });
        assert_eq!((small.e1, small.response), (large.e1, large.response));
        for side in [30, 33, 50] {
            assert!(image.psf(moffat(6.0).stamp(side).view()).is_err(), "{side}");
        }
    }
}
