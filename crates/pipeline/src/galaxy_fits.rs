//! Tables of fits to galaxies.

use std::path::Path;

use shearq_files::FileError;
use shearq_files::table::{self, MAX_ROWS};
use shearq_simulate::fit::{Fit, FitComponent};
use shearq_simulate::galaxy::Sersic;

/// Reads fits to galaxies: `n r_e q`, and perhaps `flux`, `bulge_r_e bulge_q bulge_flux` and `snr`.
pub fn read_fits(path: &Path) -> Result<Vec<Fit>, FileError> {
    let read = table::read(path, None, MAX_ROWS)?;
    let column = |name: &str| Ok(table::numbers(&read, name, path)?.into_owned());
    let optional = |name: &str| read.column(name).is_ok().then(|| column(name)).transpose();
    let (n, radius, ratio) = (column("n")?, column("r_e")?, column("q")?);
    let (flux, snr) = (optional("flux")?, optional("snr")?);
    let bulge = match optional("bulge_flux")? {
        Some(flux) => Some([column("bulge_r_e")?, column("bulge_q")?, flux]),
        None => None,
    };
    let component = |profile, radius: f64, axis_ratio: f64, flux| FitComponent {
        profile,
        half_light_arcsec: radius * axis_ratio.sqrt(),
        flux,
        axis_ratio,
    };
    let positive = |value: f64| value > 0.0 && value.is_finite();
    let fit = |k: usize| {
        let check = |is_sound: bool, name: &str, found: f64, expected: &str| match is_sound {
            true => Ok(found),
            false => {
                let message = format!("row {}: {name} is {found}, expected {expected}", k + 1);
                Err(FileError::new(path, message))
            }
        };
        let size = |name: &str, found| check(positive(found), name, found, "a positive number");
        let axes = |name: &str, q| check(q > 0.0 && q <= 1.0, name, q, "above 0 and up to 1");
        // Half of the smallest step beyond the indices that can be drawn.
        let index = check((0.25..6.25).contains(&n[k]), "n", n[k], "0.25 to 6.25")?;
        let (radius, ratio) = (size("r_e", radius[k])?, axes("q", ratio[k])?);
        let flux = flux.as_ref().map_or(1.0, |flux| flux[k]);
        let main = component(Sersic::nearest(index), radius, ratio, size("flux", flux)?);
        let bulge = match bulge
            .as_ref()
            .map(|of| of.each_ref().map(|column| column[k]))
        {
            None | Some([_, _, 0.0]) => None,
            Some([radius, ratio, flux]) => Some(component(
                Sersic::DeVaucouleurs,
                size("bulge_r_e", radius)?,
                axes("bulge_q", ratio)?,
                check(
                    positive(flux),
                    "bulge_flux",
                    flux,
                    "zero or a positive number",
                )?,
            )),
        };
        let snr = snr.as_ref().map(|snr| size("snr", snr[k])).transpose()?;
        Ok(Fit { main, bulge, snr })
    };
    match read.height() {
        0 => Err(FileError::new(
            path,
            "there is no galaxy; expected a row for each fit",
        )),
        count => (0..count).map(fit).collect(),
    }
}
