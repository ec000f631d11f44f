//! Models of a PSF that varies over the exposure, drawn at the galaxies: tables of PSFEx, and files of Piff through Python.

use std::ffi::OsString;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use ndarray::Array2;
use shearq_files::fits::{self, TableHead};
use shearq_files::table::Place;
use shearq_files::{FileError, names_of};

// Interpreter that has the Python package, if it is not the `python3` of the path. The package sets it for its own command line.
const PYTHON: &str = "SHEARQ_PYTHON";

/// Which chip of a camera an exposure is, from 0, of how many.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Chip {
    pub(crate) at: usize,
    pub(crate) of: usize,
}

pub(crate) enum PsfModel {
    Psfex(Box<PsfexModel>),
    Piff(PathBuf, Chip),
}

impl PsfModel {
    /// The model that a file contains; `None` of a file of stamps.
    pub(crate) fn read(path: &Path, chip: Chip) -> Result<Option<Self>, FileError> {
        let place = Place::of(path);
        // What is wrong with a file that is no table is said when its stamps are read.
        let Ok(tables) = fits::tables(&place.path, None) else {
            return Ok(None);
        };
        let of_psfex = |head: &&TableHead| head.columns.iter().any(|name| name == MASKS);
        let of_psfex: Vec<&TableHead> = tables.iter().filter(of_psfex).collect();
        let of_piff = tables.iter().any(|head| {
            let is_type = |name: &String| name == "type";
            head.name.eq_ignore_ascii_case("psf") && head.columns.iter().any(is_type)
        });
        let table = match (of_psfex.as_slice(), &place.table) {
            ([], _) if of_piff => return Ok(Some(PsfModel::Piff(place.path, chip))),
            ([], _) => return Ok(None),
            (all, Some(name)) => all.iter().find(|head| head.is_called(name)),
            ([one], None) => Some(one),
            (all, None) if all.len() == chip.of => all.get(chip.at),
            _ => None,
        };
        let Some(table) = table else {
            let numbers: Vec<String> = of_psfex.iter().map(|own| own.number.to_string()).collect();
            let message = format!(
                "found models of PSFEx in table {}; expected one that is named, or one for each exposure",
                names_of(&numbers)
            );
            let first = format!("{}[{}]", place.path.display(), numbers[0]);
            return Err(FileError::new(&place.path, message).hint(first));
        };
        let model = PsfexModel::read(&place.path, table.number)?;
        Ok(Some(PsfModel::Psfex(Box::new(model))))
    }

    /// The pixels of a model at the first place, with a frame of zeros, as it is beyond them; and their number along a pixel of the image.
    /// Piff draws its models without end.
    pub(crate) fn framed(&self, places: &[(f64, f64)]) -> Option<(Array2<f64>, f64)> {
        match (self, places) {
            (PsfModel::Psfex(model), [place, ..]) => {
                let [columns, rows] = model.sides;
                let mask = model.mask_at(*place);
                let framed = Array2::from_shape_fn((rows + 2, columns + 2), |(y, x)| {
                    let inside = (1..=rows).contains(&y) && (1..=columns).contains(&x);
                    inside.then(|| mask[(y - 1) * columns + x - 1])
                });
                let framed = framed.mapv(Option::unwrap_or_default);
                Some((framed, 1.0 / model.step))
            }
            _ => None,
        }
    }

    /// Draws the PSF at each place, in FITS pixels, as far as it has light.
    pub(crate) fn stars(
        &self,
        path: &Path,
        places: &[(f64, f64)],
        scale: Option<f64>,
    ) -> Result<Vec<Array2<f64>>, FileError> {
        let side = match self {
            PsfModel::Psfex(model) => {
                model.check_places(path, places)?;
                let longest = model.sides[0].max(model.sides[1]);
                (longest as f64 * model.step).ceil() as usize
            }
            PsfModel::Piff(..) => PIFF_SIDE_PX,
        };
        let mut stars = Vec::new();
        self.draw(places, side, scale, |stamp| {
            let at = |(y, x): (usize, usize)| f64::from(stamp[y * side + x]);
            stars.push(Array2::from_shape_fn((side, side), at));
            Ok(())
        })?;
        Ok(stars)
    }

    /// Draws the PSF at each place, in FITS pixels, on `side` × `side` pixels around its centre. `scale` is that of the
    /// exposure, in arcseconds: models of Piff state their own.
    pub(super) fn draw(
        &self,
        places: &[(f64, f64)],
        side: usize,
        scale: Option<f64>,
        mut take: impl FnMut(&[f32]) -> Result<(), FileError>,
    ) -> Result<(), FileError> {
        match self {
            PsfModel::Psfex(model) => {
                let mut stamp = vec![0.0; side * side];
                let weights = model.weights(side);
                for &place in places {
                    model.draw(place, &weights, &mut stamp);
                    take(&stamp)?;
                }
                Ok(())
            }
            PsfModel::Piff(path, chip) => draw_by_python(path, *chip, places, (side, scale), take),
        }
    }
}

// Pixels a side of a star of Piff's: beyond them, a Moffat profile of β = 2.5 with a FWHM of 4 px has 1 % of its light.
const PIFF_SIDE_PX: usize = 64;
// Distance from the stars of a model in units of their range, from which a place is not on its chip: as `_psf_models.py` of the Python package
// has it.
const MAX_EXTRAPOLATION: f64 = 1.0;
// The column of the basis.
const MASKS: &str = "PSF_MASK";
// GalSim draws PSFEx's models with the same order.
const LANCZOS_ORDER: i64 = 3;
// Highest degree of the polynomial: of a hundred terms, as many as a basis of 10⁵ numbers has for masks of 32 px. Chosen by hand.
const MAX_DEGREE: usize = 12;

// For each pixel of a line of a stamp, the first fine pixel that enters and the weights from it on.
type Weights = Vec<(i64, Vec<f64>)>;

/// A PSF whose pixels on a fine grid are polynomials of the place (Bertin 2011, ASPC 442, 435). It contains the pixel.
pub(crate) struct PsfexModel {
    /// Of each term, row by row.
    basis: Vec<f64>,
    sides: [usize; 2],
    degree: usize,
    zero: [f64; 2],
    scale: [f64; 2],
    /// Pixels of the image per pixel of the basis.
    step: f64,
}

impl PsfexModel {
    fn read(path: &Path, table: usize) -> Result<Self, FileError> {
        let (basis, cards) = fits::read_vector(path, table, MASKS)?;
        let text = |key: &str| {
            cards
                .get(key)
                .map_or("", |value| value.trim_matches(['\'', ' ']))
        };
        let expected = |key: &str, expected: &str| {
            let message = format!(
                "{key} of table {table} is `{}`; expected {expected}",
                text(key)
            );
            FileError::new(path, message)
        };
        let number = |key: &str| {
            let value: Option<f64> = text(key).parse().ok();
            let finite = value.filter(|value| value.is_finite());
            finite.ok_or_else(|| expected(key, "a number"))
        };
        let whole = |key: &str, most: usize| {
            let value = number(key)?;
            let fits = value >= 0.0 && value <= most as f64 && value.fract() == 0.0;
            match fits {
                true => Ok(value as usize),
                false => Err(expected(key, &format!("a whole number up to {most}"))),
            }
        };
        // Colours and other parameters of the polynomial are not in the positions.
        let varies = text("POLNAXIS") != "0";
        if varies && (text("POLNAXIS"), text("POLNGRP")) != ("2", "1") {
            return Err(expected("POLNAXIS", "2 in one group (POLNGRP): x and y"));
        }
        for (key, axis) in [("POLNAME1", "X"), ("POLNAME2", "Y")] {
            let name = text(key);
            if varies && !(name.starts_with(axis) && name.contains("IMAGE")) {
                return Err(expected(key, &format!("{axis}_IMAGE or {axis}WIN_IMAGE")));
            }
        }
        let degree = match varies {
            true => whole("POLDEG1", MAX_DEGREE)?,
            false => 0,
        };
        let terms = (degree + 1) * (degree + 2) / 2;
        let sides = [
            whole("PSFAXIS1", basis.len())?,
            whole("PSFAXIS2", basis.len())?,
        ];
        let pixels = sides[0].saturating_mul(sides[1]);
        if pixels == 0 || pixels.saturating_mul(terms) != basis.len() {
            let message = format!("sides of {terms} masks with {} numbers", basis.len());
            return Err(expected("PSFAXIS1", &message));
        }
        if !["", &terms.to_string()].contains(&text("PSFAXIS3")) {
            return Err(expected(
                "PSFAXIS3",
                &format!("{terms} masks of a polynomial of degree {degree}"),
            ));
        }
        let of_place = |key: &str| if varies { number(key) } else { Ok(1.0) };
        let model = PsfexModel {
            basis,
            sides,
            degree,
            zero: [of_place("POLZERO1")?, of_place("POLZERO2")?],
            scale: [of_place("POLSCAL1")?, of_place("POLSCAL2")?],
            step: number("PSF_SAMP")?,
        };
        let positive = [
            ("POLSCAL1", model.scale[0]),
            ("POLSCAL2", model.scale[1]),
            ("PSF_SAMP", model.step),
        ];
        match positive.iter().find(|(_, value)| *value <= 0.0) {
            Some((key, _)) => Err(expected(key, "a positive number")),
            None => Ok(model),
        }
    }

    // Far from the stars, a polynomial may have any value.
    fn check_places(&self, path: &Path, places: &[(f64, f64)]) -> Result<(), FileError> {
        // POLZERO is the middle of the range of the stars, and POLSCAL its width.
        let is_far = |(x, y): &&(f64, f64)| {
            let of_range =
                [(x, 0), (y, 1)].map(|(at, axis)| (at - self.zero[axis]) / self.scale[axis]);
            of_range.iter().any(|at| at.abs() > 0.5 + MAX_EXTRAPOLATION)
        };
        let Some((x, y)) = places.iter().find(is_far).filter(|_| self.degree > 0) else {
            return Ok(());
        };
        let [of_x, of_y] = [0, 1].map(|axis| {
            let [from, to] = [-0.5, 0.5].map(|end| self.zero[axis] + end * self.scale[axis]);
            format!("{from:.0} to {to:.0}")
        });
        let message = format!(
            "the model has no stars near x = {x:.0}, y = {y:.0} of the exposure (found stars with x from {of_x} and y from {of_y}; expected some in all parts)"
        );
        Err(FileError::new(path, message)
            .hint("the model of this exposure and chip, such as --psf FILE[2]"))
    }

    // On the fine grid.
    fn mask_at(&self, (x, y): (f64, f64)) -> Vec<f64> {
        let [u, v] = [(x, 0), (y, 1)].map(|(at, axis)| (at - self.zero[axis]) / self.scale[axis]);
        let pixels = self.sides[0] * self.sides[1];
        let mut mask = vec![0.0; pixels];
        // Powers of x change fastest.
        let powers = (0..=self.degree)
            .flat_map(|of_v| (0..=self.degree - of_v).map(move |of_u| (of_u, of_v)));
        for ((of_u, of_v), term) in powers.zip(self.basis.chunks_exact(pixels)) {
            let factor = u.powi(of_u as i32) * v.powi(of_v as i32);
            mask.iter_mut()
                .zip(term)
                .for_each(|(sum, value)| *sum += factor * value);
        }
        mask
    }

    fn draw(&self, place: (f64, f64), [of_x, of_y]: &[Weights; 2], stamp: &mut [f32]) {
        let side = of_x.len();
        let mask = self.mask_at(place);
        let [columns, rows] = self.sides;
        let light: f64 = mask.iter().sum::<f64>() * self.step * self.step;
        // A polynomial may be negative far from its stars. Divided by this, a PSF would look like one.
        let light = light.abs();
        // Along x first.
        let mut lines = vec![0.0; side * rows];
        for (line, row) in lines.chunks_exact_mut(side).zip(mask.chunks_exact(columns)) {
            for (to, (first, weights)) in line.iter_mut().zip(of_x) {
                *to = sum(weights, *first, |at| row.get(at).copied());
            }
        }
        for (to, pixel) in stamp.iter_mut().enumerate() {
            let (first, weights) = &of_y[to / side];
            let value = sum(weights, *first, |at| {
                lines.get(at * side + to % side).copied()
            });
            *pixel = (value / light) as f32;
        }
    }

    // Along x and y, for stamps of `side` pixels.
    fn weights(&self, side: usize) -> [Weights; 2] {
        self.sides.map(|fine| self.weights_along(side, fine))
    }

    fn weights_along(&self, side: usize, fine: usize) -> Weights {
        let middle = |side: usize| (side as f64 - 1.0) / 2.0;
        let of_pixel = |to: usize| {
            let at = (to as f64 - middle(side)) / self.step + middle(fine);
            let first = at.floor() as i64 + 1 - LANCZOS_ORDER;
            let all = (first..first + 2 * LANCZOS_ORDER).map(|k| lanczos(at - k as f64));
            let all: Vec<f64> = all.collect();
            // A constant stays one.
            let sum: f64 = all.iter().sum();
            (first, all.iter().map(|weight| weight / sum).collect())
        };
        (0..side).map(of_pixel).collect()
    }
}

// Beyond its pixels a model is zero.
fn sum(weights: &[f64], first: i64, value: impl Fn(usize) -> Option<f64>) -> f64 {
    let at = |k: usize| usize::try_from(first + k as i64).ok().and_then(&value);
    let terms = weights.iter().enumerate();
    terms.map(|(k, weight)| weight * at(k).unwrap_or(0.0)).sum()
}

fn lanczos(x: f64) -> f64 {
    let order = LANCZOS_ORDER as f64;
    let sinc = |x: f64| match x {
        0.0 => 1.0,
        x => (std::f64::consts::PI * x).sin() / (std::f64::consts::PI * x),
    };
    match x.abs() < order {
        true => sinc(x) * sinc(x / order),
        false => 0.0,
    }
}

// Piff has many kinds of models, and only its own code draws them.
fn draw_by_python(
    path: &Path,
    chip: Chip,
    places: &[(f64, f64)],
    (side, scale): (usize, Option<f64>),
    mut take: impl FnMut(&[f32]) -> Result<(), FileError>,
) -> Result<(), FileError> {
    let python = std::env::var_os(PYTHON).unwrap_or_else(|| OsString::from("python3"));
    let fault = |what: String| {
        let message = format!(
            "{what}. A model of Piff is drawn by the Python package, `{} -m shearq._drawn_psfs`",
            python.display()
        );
        FileError::new(path, message).hint(format!(
            "the Python packages shearq and piff; {PYTHON}=PYTHON names an interpreter that has them"
        ))
    };
    let child = Command::new(&python)
        .args(["-m", "shearq._drawn_psfs"])
        .arg(path)
        .args([chip.at, chip.of, side].map(|number| number.to_string()))
        .args(scale.map(|scale| scale.to_string()))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn();
    let mut child = child.map_err(|error| fault(format!("cannot start Python: {error}")))?;
    let text: String = places
        .iter()
        .map(|(x, y)| format!("{x:?} {y:?}\n"))
        .collect();
    // It reads all places before it writes, and says itself what is wrong.
    let sent = child
        .stdin
        .take()
        .map(|mut input| input.write_all(text.as_bytes()));
    let mut drawn = child.stdout.take();
    let mut bytes = vec![0; 4 * side * side];
    let mut read = || -> Result<usize, FileError> {
        for done in 0..places.len() {
            let whole = drawn.as_mut().map(|from| from.read_exact(&mut bytes));
            if !matches!(whole, Some(Ok(()))) {
                return Ok(done);
            }
            let values = bytes.chunks_exact(4);
            let stamp: Vec<f32> = values
                .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
                .collect();
            take(&stamp)?;
        }
        Ok(places.len())
    };
    let done = read();
    drop(drawn);
    let status = child
        .wait()
        .map_err(|error| fault(format!("cannot wait for Python: {error}")))?;
    match (done?, sent) {
        (done, Some(Ok(()))) if done == places.len() && status.success() => Ok(()),
        (done, _) => Err(fault(format!(
            "{done} of {} PSFs were drawn ({status})",
            places.len()
        ))),
    }
}

#[cfg(test)]
mod tests {
    use shearq_measure::Truncation;

    use super::*;

    /// A Gaussian of σ px that grows along x and becomes elliptical along y.
    fn model(step: f64) -> PsfexModel {
        let sides = [41, 43];
        let gaussian = |a: f64, b: f64| {
            let mut all = Vec::new();
            for (y, x) in (0..sides[1]).flat_map(|y| (0..sides[0]).map(move |x| (y, x))) {
                let [x, y] = [(x, sides[0]), (y, sides[1])]
                    .map(|(at, side)| (at as f64 - 0.5 * (side as f64 - 1.0)) * step);
                all.push((-0.5 * (x * x / (a * a) + y * y / (b * b))).exp() / (a * b));
            }
            all
        };
        let constant = gaussian(2.0, 2.0);
        let minus = |other: Vec<f64>| {
            other
                .iter()
                .zip(&constant)
                .map(|(a, b)| a - b)
                .collect::<Vec<_>>()
        };
        let basis = [
            constant.clone(),
            minus(gaussian(2.2, 2.2)),
            minus(gaussian(2.2, 1.8)),
        ];
        PsfexModel {
            basis: basis.concat(),
            sides,
            degree: 1,
            zero: [500.0, 400.0],
            scale: [100.0, 50.0],
            step,
        }
    }

    #[test]
    fn a_model_that_ends_in_light_is_cut_off() {
        let cut = |step: f64| {
            let model = PsfModel::Psfex(Box::new(model(step)));
            let (framed, fine) = model.framed(&[(500.0, 400.0)]).unwrap();
            assert_eq!(framed.dim(), (45, 43));
            Truncation::of(framed.view(), fine)
        };
        assert_eq!(cut(0.7), None);
        // 43 fine pixels are 8.6 px, of a Gaussian of σ 2 px.
        let found = cut(0.2).unwrap();
        assert!((found.side - 8.6).abs() < 1e-9, "{found:?}");
        assert!((0.04..0.14).contains(&found.level), "{found:?}");
    }

    #[test]
    fn a_negative_model_is_no_psf() {
        let mut model = model(0.7);
        model.basis.iter_mut().for_each(|value| *value = -*value);
        let mut stamp = vec![0.0; 32 * 32];
        model.draw((500.0, 400.0), &model.weights(32), &mut stamp);
        let sum: f32 = stamp.iter().sum();
        assert!((sum + 1.0).abs() < 0.01, "{sum}");
    }

    #[test]
    fn stars_of_a_model_are_those_near_its_own() {
        // POLZERO is (500, 400), and POLSCAL (100, 50).
        let model = PsfModel::Psfex(Box::new(model(0.7)));
        let stars = |place| model.stars(Path::new("model.psf"), &[(500.0, 400.0), place], None);
        let [one, other] = &stars((649.0, 326.0)).unwrap()[..] else {
            panic!()
        };
        // 43 pixels of 0.7.
        assert_eq!((one.dim(), other.dim()), ((31, 31), (31, 31)));
        for place in [(651.0, 400.0), (500.0, 324.0)] {
            assert!(
                stars(place)
                    .unwrap_err()
                    .to_string()
                    .contains("found stars with x from 450 to 550 and y from 375 to 425")
            );
        }
    }

    #[test]
    fn a_model_has_its_size_and_axes_at_each_place() {
        let model = model(0.7);
        for (place, [a, b]) in [
            ((500.0, 400.0), [2.0, 2.0]),
            ((600.0, 400.0), [2.2, 2.2]),
            ((500.0, 450.0), [2.2, 1.8]),
        ] {
            for side in [32, 33] {
                let mut stamp = vec![f32::NAN; side * side];
                model.draw(place, &model.weights(side), &mut stamp);
                let expected = |x: f64, y: f64| {
                    (-0.5 * (x * x / (a * a) + y * y / (b * b))).exp()
                        / (std::f64::consts::TAU * a * b)
                };
                for (at, found) in stamp.iter().enumerate() {
                    let [x, y] =
                        [at % side, at / side].map(|k| k as f64 - 0.5 * (side as f64 - 1.0));
                    // GalSim's interpolation by the same kernel is up to 3.1·10⁻³ of the peak from this Gaussian of three fine pixels.
                    let apart = (f64::from(*found) - expected(x, y)).abs();
                    assert!(apart < 1.25e-4, "{place:?} {x} {y} {apart}");
                }
            }
        }
    }
}
