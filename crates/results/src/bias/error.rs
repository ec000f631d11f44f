//! What can stop an estimate of m and c.

use std::path::PathBuf;

use shearq_bias::{BiasError, Catalogue, Design};
use shearq_catalogue::request::MAX_BINS;
use shearq_dataset::truth::{Sign, SignBasis, word};
use shearq_files::FileError;
use shearq_quantities::{hints, tried};
use shearq_scoring::TruthSign;
use thiserror::Error;

#[derive(Debug, Error)]
pub enum BiasFailure {
    #[error(transparent)]
    File(#[from] FileError),
    #[error(transparent)]
    Bias(#[from] BiasError),
    #[error("there is no catalogue")]
    NoCatalogue,
    /// All rows have the same value in the column that names units, such as one patch or tile.
    #[error("{}{}", .0, tried(self.hint()))]
    OneUnit(BiasError),
    #[error("--truth-sign: the data of these folders state the sign of g2{}", tried(self.hint()))]
    SignOfFolders,
    #[error("{}: it does not state the same sign of g2 as {}{}", catalogue.display(), first.display(), tried(self.hint()))]
    Signs { catalogue: PathBuf, first: PathBuf },
    #[error("{}: its columns are not the columns of {} (found {}){}", catalogue.display(), first.display(), difference, tried(self.hint()))]
    Columns {
        catalogue: PathBuf,
        first: PathBuf,
        difference: String,
    },
    #[error("{second}: it was measured on the same image as {first} (expected one catalogue of each image){}", tried(self.hint()))]
    SameImage { first: String, second: String },
    #[error("the sums are of different lists of catalogues (expected one list, of which each file has a part){}", tried(self.hint()))]
    OtherLists,
    #[error("the sums do not belong together: they have different {0}")]
    Unlike(&'static str),
    #[error("the sums do not belong together (found {}){}", .0, tried(self.hint()))]
    UnlikeColumns(String),
    #[error("{second}: it contains the same galaxies as {first}, which would count twice (expected other galaxies){}", tried(self.hint()))]
    SameContent { first: String, second: String },
    #[error("{0}: the catalogue is in two files of sums")]
    InTwoFiles(String),
    #[error("--bins: `{of}` has {different} different values (expected more for {bins} bins with equally many galaxies){}", tried(self.hint()))]
    FewValues {
        of: String,
        bins: usize,
        different: usize,
    },
    #[error("--bins: `{of}` has more than {MAX_BINS} different values (expected a bin per value){}", tried(self.hint()))]
    ManyValues { of: String },
    #[error("--bins: found {0} bins of all quantities together, expected at most {MAX_BINS}")]
    ManyBins(usize),
    #[error("--bins: no galaxy that counts has {}{}", .0, tried(self.hint()))]
    EmptyBin(String),
    #[error("--paired needs the same galaxies under several test shears (found the design {}){}", .0.name(), tried(self.hint()))]
    NothingPairs(Design),
    #[error("--paired: the galaxies of sheared catalogues are detected again in each, and have no partner in another (expected responses in columns){}", tried(self.hint()))]
    PairedSheared,
    #[error("--paired: {second} has {} rows and {first} has {}, and no column of identifiers states which of them are the same galaxies (expected as many rows){}", .rows[1], .rows[0], tried(self.hint()))]
    PairedRows {
        first: String,
        second: String,
        rows: [u64; 2],
    },
    #[error("--like needs bins of both catalogues{}", tried(self.hint()))]
    LikeWithoutBins,
    #[error("{}: no galaxy of the survey is in a bin with simulated galaxies", .0.display())]
    NothingAlike(PathBuf),
    #[error("the catalogues cannot be compared: truth or bins differ{}", tried(self.hint()))]
    BinsDiffer,
    #[error("the catalogues cannot be compared: they have other true shears (found {} on one side and {} on the other, expected the same){}", .0[0], .0[1], tried(self.hint()))]
    TruthsDiffer([String; 2]),
    #[error("the catalogues cannot be compared: e2 of one follows the true g2 of sign {}, of the other {}{}", word(*.0), word(*.1), tried(self.hint()))]
    SignsDiffer(TruthSign, TruthSign),
    #[error("the catalogues cannot be compared (found ellipticities in the {} frame and in the {} frame, expected one frame){}", .0, .1, tried(self.hint()))]
    FramesDiffer(String, String),
    #[error(
        "the catalogues cannot be compared (found {own} beside {other}, expected the same images in the same order on both sides)"
    )]
    ImagesDiffer { own: String, other: String },
    #[error("the catalogues cannot be compared (found {} with {} and {} with {}, expected the same design and units){}", .0.0.name(), .0.1, .1.0.name(), .1.1, tried(self.hint()))]
    DesignsDiffer((Design, &'static str), (Design, &'static str)),
    #[error(
        "no galaxy can be used (found {} rows: {} with a flag, {} with a weight of zero or less, {} not selected, {} with missing numbers, {} with failed measurements, {} with a distortion above 1){}",
        .0.rows, .0.flagged, .0.unweighted, .0.unselected, .0.missing, .0.failed, .0.above_one, tried(self.hint())
    )]
    NoGalaxy(Box<Catalogue>),
    #[error(
        "{}: no row of this catalogue counts{} (found {} rows: {} with a flag, {} with a weight of zero or less, {} not selected, {} with missing numbers, {} without partner), so that its shear is unknown{}",
        .catalogue.name, more_of(*.more), .catalogue.rows, .catalogue.flagged, .catalogue.unweighted, .catalogue.unselected, .catalogue.missing + .catalogue.failed, .catalogue.without_partner, tried(self.hint())
    )]
    NothingCounts {
        catalogue: Box<Catalogue>,
        more: usize,
    },
    #[error("{rows} of {used} rows have |e| above 2, so that e1 and e2 are no ellipticities (expected moduli below 1){}", tried(self.hint()))]
    Beyond { rows: u64, used: u64 },
    #[error("e{component} is {value} in all {rows} rows (expected different values)")]
    Constant {
        component: usize,
        value: f64,
        rows: u64,
    },
    /// The responses of e1 to g1 and of e2 to g2.
    #[error("e1 follows the true g2, and e2 the true g1 (found slopes of {:.3} and {:.3} on the own component, expected about 1): e1 and e2 are probably exchanged{}", .0[0], .0[1], tried(self.hint()))]
    Exchanged([f64; 2]),
    #[error("e1 follows minus the true g1 (found a slope of {response:.3}, expected about 1){}", tried(self.hint()))]
    MinusG1 { response: f64, e1: String },
    #[error("e2 follows minus the true g2 (found a slope of {response:.3}, expected about 1){}", tried(self.hint()))]
    MinusG2 { response: f64, sign: Option<Sign> },
    #[error("the ellipticities do not follow the true shear (found slopes of {:.3} and {:.3}, expected about 1){}", .0[0], .0[1], tried(self.hint()))]
    Unrelated([f64; 2]),
    #[error("the ellipticities look like distortions (found slopes of {:.3} and {:.3}, expected about 1){}", .0[0], .0[1], tried(self.hint()))]
    Distortions([f64; 2]),
}

impl BiasFailure {
    hints! {
        Self::File(error) => return error.hint.clone(),
        Self::Bias(error) => return error.hint(),
        Self::NoGalaxy(all) => {
            let text = all.unmatched.first()?;
            &format!("another text, because no row has `{text}`")
        }
        Self::MinusG2 { sign, .. } => &other_sign(*sign),
        Self::OneUnit(..) => "--units rows",
        Self::SignOfFolders => "omit --truth-sign",
        Self::Signs { .. } => "--truth-sign, or the same statement in all",
        Self::Columns { .. } => "--columns with the same columns for all, or one command per kind of catalogue",
        Self::SameImage { .. } => "leave one out, or measure again if it is a copy",
        Self::OtherLists => "--shard K/N --sums FILE with the list of all catalogues, or in Python shearq.bias_sums of each list and BiasSums.merge",
        Self::UnlikeColumns(..) => "the same columns and options for all",
        Self::SameContent { .. } => "each catalogue once, also of tasks that were repeated",
        Self::FewValues { of, .. } => &format!("--bins '{of}' for a bin per value, or edges"),
        Self::ManyValues { of } => &format!("--bins '{of}:5', or edges"),
        Self::EmptyBin(..) => "other edges",
        Self::NothingPairs(..) => "--design shears if they are the same",
        Self::PairedSheared => "omit --paired; each test shear then has its own response",
        Self::PairedRows { .. } => "--columns id=NAME, or omit --paired",
        Self::LikeWithoutBins => "--bins 'snr:10' --bins 'size:5'",
        Self::BinsDiffer => "bins with edges",
        Self::TruthsDiffer(..) => "the same simulations on both sides",
        Self::SignsDiffer(..) => "--truth-sign",
        Self::FramesDiffer(..) => "measure one of them again in the other's frame",
        Self::DesignsDiffer(..) => "--design and --units",
        Self::NothingCounts { .. } => "leave it out, with the catalogues of the same galaxies under other shears",
        Self::Beyond { .. } => "--columns with their names, or with the responses R11 and R22 of ellipticities in other units",
        Self::Exchanged(..) => "--columns with the names exchanged",
        Self::MinusG1 { e1, .. } => &format!("--columns e1={e1} if x of the catalogue points the other way, or check the sign of the truth"),
        Self::Unrelated(..) => "check the order of the rows and of e1 and e2, whether the mean was subtracted, or join by id",
        Self::Distortions(..) => "--ellipticity distortion, or --ellipticity shear to keep them",
    }
}

fn more_of(more: usize) -> String {
    match more {
        0 => String::new(),
        more => format!(", and none of {more} more catalogues"),
    }
}

fn other_sign(sign: Option<Sign>) -> String {
    match sign {
        None
        | Some(Sign {
            basis: SignBasis::Zero,
            ..
        }) => "--truth-sign challenge (of folders: truth_sign in layout.toml of the data)".into(),
        Some(sign) if sign.basis == SignBasis::Stated => format!(
            "check the sign of e2, or the statement `{}` in the truth",
            word(sign.of)
        ),
        Some(sign) => format!(
            "check the sign of e2, or --truth-sign {}",
            word(match sign.of {
                TruthSign::Standard => TruthSign::Challenge,
                TruthSign::Challenge => TruthSign::Standard,
            })
        ),
    }
}
