//! The functional form of PSFs: CSV with x, y, profile, beta, fwhm, e1, e2.

use std::path::Path;

use shearq_quantities::Shear;
use shearq_quantities::{FunctionalPsf, PsfProfile};

use crate::grid::Mosaic;
use shearq_files::FileError;
use shearq_files::atomic;
use shearq_files::open;

pub type PositionedPsf = ((f64, f64), FunctionalPsf);

const HEADER: &str = "x,y,profile,beta,fwhm,e1,e2";

/// PSFs of an image: one, or one per galaxy along the rows of the mosaic.
pub fn read(path: &Path, mosaic: &Mosaic) -> Result<Vec<FunctionalPsf>, FileError> {
    let rows = read_all(path)?;
    if let [(_, psf)] = rows.as_slice() {
        return Ok(vec![*psf]);
    }
    // By position, so that the order of the rows does not matter.
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
pub fn read_all(path: &Path) -> Result<Vec<PositionedPsf>, FileError> {
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
        // A line of blanks, as editors leave it at the end.
        if record.len() == 1 && record[0].is_empty() {
            continue;
        }
        let end = reader.position().byte() as usize;
        let wrong = |what: String| {
            // Counted only for a message: for each row it would take a time quadratic in the length.
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

pub fn write(path: &Path, rows: &[PositionedPsf]) -> Result<(), FileError> {
    atomic::write(path, text(rows).as_bytes())
}

pub fn text(rows: &[PositionedPsf]) -> String {
    let mut text = format!("{HEADER}\n");
    for ((x, y), psf) in rows {
        // A Kolmogorov PSF has no β; the column has any valid number.
        let (profile, beta) = match psf.profile {
            PsfProfile::Moffat { beta } => ("moffat", beta),
            PsfProfile::Kolmogorov => ("kolmogorov", 3.0),
        };
        let (fwhm, e1, e2) = (psf.fwhm, psf.shape.e1, psf.shape.e2);
        text.push_str(&format!("{x},{y},{profile},{beta},{fwhm},{e1},{e2}\n"));
    }
    text
}
