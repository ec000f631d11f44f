//! Choices on the command line of types of the layers below: how they are spelt, and what `--help` says.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

use shearq_files::table::FileFormat;
use shearq_render::table::TableFormat;
use shearq_results::groups::Grouping;
use shearq_results::submit::manifest::Contents;

/// A type of which the command line offers the values by name.
pub(crate) trait Named: Copy + Send + Sync + 'static {
    /// Each value with its name and its line of `--help`.
    const ALL: &[(Self, &str, &str)];
}

/// Parses the name of a value.
pub(crate) fn named<T: Named>() -> impl TypedValueParser<Value = T> {
    let names = T::ALL
        .iter()
        .map(|(_, name, help)| PossibleValue::new(*name).help(*help));
    // Other names do not get here.
    PossibleValuesParser::new(names).map(|given| {
        let found = T::ALL.iter().find(|(_, name, _)| *name == given);
        found.unwrap_or(&T::ALL[0]).0
    })
}

macro_rules! choices {
    ($($of:ty { $($variant:ident: $name:literal, $help:literal;)+ })+) => {
        $(impl Named for $of {
            const ALL: &[(Self, &str, &str)] = &[$((Self::$variant, $name, $help)),+];
        })+
    };
}

choices! {
    FileFormat {
        Parquet: "parquet", "Parquet";
        Fits: "fits", "FITS binary table";
    }
    TableFormat {
        Table: "table", "For reading on a terminal";
        Json: "json", "Machine-readable, full precision";
        Csv: "csv", "Comma-separated, full precision, value and error in columns of their own; words that a spreadsheet would take for a formula have an apostrophe in front";
        Markdown: "markdown", "Markdown";
        Latex: "latex", "A LaTeX tabular";
    }
    Grouping {
        Set: "set", "Each set alone";
        SetKind: "set-kind", "The kinds of the paper's Table 2";
        Psf: "psf", "Fixed or variable PSF";
        Snr: "snr", "Class of S/N";
        Size: "size", "Class of galaxy sizes";
    }
    Contents {
        Catalogues: "catalogues", "Ellipticity catalogues";
        Spectra: "spectra", "Power spectra of the ellipticities averaged over the images, noise included";
        CrossSpectra: "cross-spectra", "Shear power spectra from cross-spectra between groups of images, in which noise has no mean";
    }
}
