//! The functional form of PSFs: CSV with x, y, profile, beta, fwhm, e1, e2.

use std::path::Path;

use shearq_quantities::Shear;
use shearq_quantities::{FunctionalPsf, PsfProfile};

use crate::mosaic::Mosaic;
use shearq_files::FileError;
use shearq_files::atomic;
use shearq_files::open;

/// A PSF and the position it belongs to.
pub type Placed = ((f64, f64), FunctionalPsf);

/// Header of the table.
const HEADER: &str = "x,y,profile,beta,fwhm,e1,e2";

/// PSFs of an image: one, or one per galaxy along the rows of the mosaic.
///
/// # Errors
/// If the file cannot be read, a row is not valid, or the rows are neither one nor one per
/// galaxy.
pub fn read(path: &Path, mosaic: &Mosaic) -> Result<Vec<FunctionalPsf>, FileError> {
    let rows = read_all(path)?;
    if let [(_, psf)] = rows.as_slice() {
        return Ok(vec![*psf]);
    }
    let mut field = vec![None; mosaic.galaxies];
    for ((x, y), psf) in &rows {
        let place = mosaic.place(*x, *y).ok_or_else(|| {
            FileError::new(path, format!("the position ({x}, {y}) is outside the grid"))
        })?;
        if field[place].replace(*psf).is_some() {
            let message = format!("the galaxy at ({x}, {y}) has two rows; expected one");
            return Err(FileError::new(path, message));
        }
    }
    field
        .into_iter()
        .collect::<Option<Vec<_>>>()
        .ok_or_else(|| {
            FileError::new(
                path,
                format!(
                    "{} rows; expected one, or one for each of the {} galaxies",
                    rows.len(),
                    mosaic.galaxies
                ),
            )
        })
}

/// PSFs of a table, with their positions, in its order.
///
/// # Errors
/// If the file cannot be read, or a row is not valid.
pub fn read_all(path: &Path) -> Result<Vec<Placed>, FileError> {
    const DOING: &str = "cannot read the PSF parameters";
    let text = open::read_to_string(path, open::DATA).map_err(FileError::doing(path, DOING))?;
    let mut reader = csv::ReaderBuilder::new()
        .has_headers(false)
        .flexible(true)
        .trim(csv::Trim::All)
        .from_reader(text.as_bytes());
    let mut record = csv::StringRecord::new();
    reader
        .read_record(&mut record)
        .map_err(FileError::doing(path, DOING))?;
    let header = record.iter().collect::<Vec<_>>().join(",");
    if header != HEADER {
        return Err(FileError::new(
            path,
            format!("the header is `{header}`; expected `{HEADER}`"),
        ));
    }
    let mut rows = Vec::new();
    while reader
        .read_record(&mut record)
        .map_err(FileError::doing(path, DOING))?
    {
        if record.len() == 1 && record[0].is_empty() {
            continue;
        }
        let end = reader.position().byte() as usize;
        let wrong = |what: String| {
            let line = text[..end].trim_end().lines().count();
            FileError::new(path, format!("line {line}: {what}"))
        };
        let fields: Vec<&str> = record.iter().collect();
        let &[x, y, profile, beta, fwhm, e1, e2] = fields.as_slice() else {
            return Err(wrong(format!("{} fields; expected 7", fields.len())));
        };
        let parse = |name: &str, field: &str| {
            field
                .parse::<f64>()
                .map_err(|_| wrong(format!("`{field}` in column `{name}` is not a number")))
        };
        let profile = match profile {
            "moffat" => PsfProfile::Moffat {
                beta: parse("beta", beta)?,
            },
            "kolmogorov" => PsfProfile::Kolmogorov,
            other => {
                return Err(wrong(format!(
                    "the profile is `{other}`; expected `moffat` or `kolmogorov`"
                )));
            }
        };
        let shape = Shear::new(parse("e1", e1)?, parse("e2", e2)?);
        let psf = FunctionalPsf::new(profile, parse("fwhm", fwhm)?, shape)
            .map_err(|error| wrong(error.to_string()))?;
        rows.push(((parse("x", x)?, parse("y", y)?), psf));
    }
    Ok(rows)
}

/// Writes PSFs with their positions.
///
/// # Errors
/// If the file cannot be written.
pub fn write(path: &Path, rows: &[Placed]) -> Result<(), FileError> {
    atomic::write(path, text(rows).as_bytes())
}

/// The same table as text.
pub fn text(rows: &[Placed]) -> String {
    // Writing to memory cannot fail.
    let mut text = csv::Writer::from_writer(Vec::new());
    let _ = text.write_record(HEADER.split(','));
    for ((x, y), psf) in rows {
        // A Kolmogorov PSF has no β; the column has any valid number.
        let (profile, beta) = match psf.profile {
            PsfProfile::Moffat { beta } => ("moffat", beta),
            PsfProfile::Kolmogorov => ("kolmogorov", 3.0),
        };
        let (fwhm, e1, e2) = (psf.fwhm, psf.shape.e1, psf.shape.e2);
        let numbers = [beta, fwhm, e1, e2].map(|number| number.to_string());
        let place = [x.to_string(), y.to_string(), profile.to_owned()];
        let _ = text.write_record(place.iter().chain(&numbers));
    }
    String::from_utf8(text.into_inner().unwrap_or_default()).unwrap_or_default()
}
