//! Names and `--help` lines of choices whose types belong to the layers below.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

use shearq_bias::Design;
use shearq_challenge::kind::{Kind, RankBy};
use shearq_files::table::FileFormat;
use shearq_pipeline::gather::Square;
use shearq_render::table::TableFormat;
use shearq_results::bias::columns::Shapes;
use shearq_results::response::{Position, Shared};
use shearq_results::submit::Contents;
use shearq_scoring::{Definition, TruthSign};
use shearq_submissions::{EllipticityType, Template};

// Clap's `ValueEnum` cannot be derived here: the types belong to crates without clap, so that libraries do not compile it.
pub(crate) trait Named: Copy + Send + Sync + 'static {
    const ALL: &[(Self, &str, &str)];
}

pub(crate) fn named<T: Named>() -> impl TypedValueParser<Value = T> {
    let names = T::ALL
        .iter()
        .map(|(_, name, help)| PossibleValue::new(*name).help(*help));
    // Other names were refused by `PossibleValuesParser`, so that the first value is never used as a default.
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
    Kind {
        Great10: "great10", "GREAT10 Galaxy Challenge";
        Great3: "great3", "Sets with one shear each, ranked by Q_c (with --data)";
    }
    FileFormat {
        Parquet: "parquet", "Parquet";
        Fits: "fits", "FITS binary table";
    }
    TableFormat {
        Table: "table", "For reading on a terminal";
        Json: "json", "Machine-readable, full precision";
        Csv: "csv", "Comma-separated, full precision, values and errors in separate columns. An apostrophe protects text that spreadsheets would execute as a formula";
        Markdown: "markdown", "Markdown";
        Latex: "latex", "A LaTeX tabular";
    }
    Shared {
        Survey: "survey", "All";
        Set: "set", "Those of a set";
        Image: "image", "Those of an image";
    }
    Position {
        Sky: "ra,dec", "Right ascension and declination in degrees, for shears in the frame of the sky";
        Pixel: "x,y", "Pixels of the image, for shears in their frame";
    }
    TruthSign {
        Challenge: "challenge", "Minus the standard g2, as in the challenge's truth files";
        Standard: "standard", "Positive along x = y";
    }
    EllipticityType {
        Shear: "shear", "(1 − q)/(1 + q) for an axis ratio q";
        Distortion: "distortion", "(1 − q²)/(1 + q²), converted to shear-type ellipticities";
    }
    Template {
        Linear: "linear", "The linear network in closed form (recommended)";
        Network: "network", "The Hopfield network of the paper";
    }
    Square {
        Crop: "crop", "By the central square";
        Pad: "pad", "By missing pixels around them; PSFs are cropped";
    }
    Definition {
        Leaderboard: "leaderboard", "The arithmetic of the challenge";
        Corrected: "corrected", "Azimuthal averages over fixed bins";
    }
    Design {
        Single: "single", "One true shear";
        Pairs: "pairs", "+γ and −γ of the same galaxies";
        Arms: "arms", "Several pairs, such as ±g1 and ±g2";
        Fields: "fields", "One true shear per catalogue";
        Galaxies: "galaxies", "Shears that vary within catalogues";
        Rotated: "rotated", "Galaxies rotated by 90 degrees, in neighbouring rows or catalogues";
    }
    Shapes {
        Shear: "shear", "(1 − q)/(1 + q) for an axis ratio q";
        Converted: "distortion", "(1 − q²)/(1 + q²) for an axis ratio q, each converted to a shear";
        Responsivity: "responsivity", "The same, but the mean is divided by the responsivity 2(1 − e_rms²), as surveys do";
    }
    RankBy {
        Q: "q", "Q with the arithmetic of GREAT10's leaderboard";
        QCorrected: "q-corrected", "Q with azimuthal averages over fixed bins";
        QCalibrated: "q-calibrated", "Q after dividing by the measured response";
        M: "m", "Modulus of the multiplicative bias";
        C: "c", "Modulus of the additive bias, divided by the response";
        Qc: "qc", "GREAT3's Q_c, from m and c of sets with one shear each";
        Noise: "noise", "Noise of one galaxy's ellipticity";
    }
    Contents {
        Catalogues: "catalogues", "Ellipticity catalogues";
        Spectra: "spectra", "Power spectra of the ellipticities averaged over the images, with their noise";
        CrossSpectra: "cross-spectra", "Shear power spectra from cross-spectra between groups of images; their noise averages to zero";
    }
}
