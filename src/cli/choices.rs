//! Choices on the command line of types of the layers below: how they are spelt, and what `--help` says.

use clap::ValueEnum;
use clap::builder::PossibleValue;

use crate::io::table::FileFormat;
use crate::report::table::TableFormat;
use crate::results::groups::Grouping;
use crate::submit::manifest::Contents;

macro_rules! choices {
    ($($of:ty { $($variant:ident: $name:literal, $help:literal;)+ })+) => {
        $(impl ValueEnum for $of {
            fn value_variants<'a>() -> &'a [Self] {
                &[$(Self::$variant),+]
            }

            fn to_possible_value(&self) -> Option<PossibleValue> {
                Some(match self {
                    $(Self::$variant => PossibleValue::new($name).help($help),)+
                })
            }
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
