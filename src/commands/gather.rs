use std::path::{Path, PathBuf};

use clap::Args;

use crate::arguments::{SummaryArguments, listed, mask_bit, named};
use crate::{count, tell};
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::{DataFolder, MAX_IMAGE, MAX_SET};
use shearq_files::fits::{Selection, image_heads};
use shearq_files::names_of;
use shearq_files::table::Place;
use shearq_pipeline::gather::{
    Content, Exposures, Files, Gathered, Gathering, Masks, Square, Stamps, Table, gather,
};
use shearq_quantities::Frame;

/// Gather your stamps and PSFs into a data folder for `measure`.
///
/// Subtract the sky first. Stamps come from FITS files of one stamp, a cube or several extensions each. Or they are cut
/// out of an exposure around positions. Stamps smaller than the largest get missing pixels around them.
///
/// Pixels are missing if they are outside the exposure, not finite, −1e30, or not zero in a mask. A linear configuration
/// fills a few from the opposite side of the galaxy; a network flags the galaxy.
///
/// The PSF is one star stamp for all galaxies, one per galaxy in the same order, or a model by PSFEx or Piff. It may also be a table of
/// functional PSFs (x,y,profile,beta,fwhm,e1,e2; docs/files.md), whose positions are not used. Width, noise and pixel scale of
/// stamps and PSFs are compared. A table next to the image lists
/// the stamps in the order of the catalogues. In lists of files, `@FILE` stands for the lines of a file, and a quoted name with `*` or `?`
/// for all that it matches.
#[derive(Debug, Clone, Args)]
pub(crate) struct Arguments {
    /// FITS files of stamps, in the order of the galaxies.
    #[arg(long, value_name = "FILE", num_args = 1.., required_unless_present = "exposure", conflicts_with_all = ["exposure", "chips", "first_pixel", "columns", "degrees", "size"])]
    stamps: Vec<PathBuf>,
    /// Image to cut stamps out of: the first of its file, or the one of `FILE[SCI,2]`. Rows of the positions that are on none of
    /// the exposures are left out. Several exposures of the same galaxies become images of consecutive
    /// numbers, each with the PSF, map and mask at its place in the lists, for `measure --epochs`.
    #[arg(long, value_name = "FILE", num_args = 1.., requires = "positions")]
    exposure: Vec<PathBuf>,
    /// The exposures are chips of a camera: each becomes an image of the galaxies that are on it. Positions are right ascension and
    /// declination, or a table for each chip. A chip without galaxies becomes no image.
    #[arg(long, requires = "exposure")]
    chips: bool,
    /// Use only these images of files: by name (EXTNAME) `SCI`, with version (EXTVER) `SCI,2`, or by number `4`. `plane=2` is one
    /// plane of cubes, `SCI,2,plane=3` one of this image; `plane=all` says that planes are galaxies, not bands. Of exposures,
    /// `SCI,*` is each image of this name and `*` each image, as chips of a camera (see --chips); `*` in other options then stands for the
    /// same version, name or number.
    #[arg(long, value_name = "NAME|NUMBER")]
    extension: Option<String>,
    /// Masks of the stamps in the same order, or of the exposure. A pixel is missing if its mask is not zero.
    #[arg(long, value_name = "FILE", num_args = 1..)]
    mask: Vec<PathBuf>,
    /// Bits of the masks, from 0 for the lowest: a pixel is missing if one of them is set [default: all].
    #[arg(long, value_name = "BITS", value_delimiter = ',', num_args = 1, value_parser = mask_bit)]
    mask_bits: Option<Vec<u8>>,
    /// Use only masks of this name or number, like --extension [default files: the stamps or the exposure].
    #[arg(long, value_name = "NAME")]
    mask_extension: Option<String>,
    /// Table of positions on the exposure: text, FITS or Parquet, in FITS pixels (the centre of the first pixel is 1), or in
    /// degrees on the sky if the exposure has a WCS (TAN, TAN-SIP, TPV, SIN, STG, CAR). Catalogues have its identifiers and positions.
    /// `FILE[NAME]` and `FILE[NUMBER]` are tables of a FITS file. One table for all exposures, or one for each.
    /// With --stamps, a row per stamp in their order: its columns id, x, y, ra and dec are copied as they are.
    #[arg(long, value_name = "FILE", num_args = 1..)]
    positions: Vec<PathBuf>,
    /// Table of a FITS file: its name (EXTNAME), or its number from 1 [default: the table that has the columns].
    #[arg(long, value_name = "NAME|NUMBER", requires = "positions")]
    table: Option<String>,
    /// Column of identifiers, integers or texts [default: id, object_id, source_id or NUMBER, if there is one].
    #[arg(long, value_name = "NAME", requires = "positions")]
    id: Option<String>,
    /// Further columns of the positions for the catalogue, such as mag,z.
    #[arg(
        long,
        value_name = "NAMES",
        value_delimiter = ',',
        num_args = 1,
        requires = "positions"
    )]
    carry: Vec<String>,
    #[command(flatten)]
    cutouts: Cutouts,
    /// Make squares of stamps that are not: by their central square (crop), or by missing pixels around them (pad). A galaxy with
    /// many missing pixels is flagged. PSFs are cropped [default: refuse].
    #[arg(long, value_name = "HOW", value_parser = named::<Square>(), conflicts_with_all = ["exposure", "chips", "first_pixel", "columns", "degrees", "size"])]
    square: Option<Square>,
    /// FITS files of PSF stamps, or one table of functional PSFs (.csv): one PSF for all galaxies, or one per galaxy. Or a model by PSFEx
    /// or Piff of each exposure, drawn at the galaxies; models of Piff need the Python package and piff.
    #[arg(long, value_name = "FILE", num_args = 1.., required = true)]
    psf: Vec<PathBuf>,
    /// Use only PSFs of this name (EXTNAME).
    #[arg(long, value_name = "NAME")]
    psf_extension: Option<String>,
    /// Pixels of the PSF images along a pixel of the galaxies, of undersampled images. The light of the finer pixels is
    /// integrated over those of the galaxies, without aliases [default: OVERSAMP, PSF_SAMP or SAMPLING of the header, or 1].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=32))]
    psf_oversampling: Option<u8>,
    /// Maps of the variance of each pixel: of the stamps in the same order, or of the exposure. The noise of a galaxy is the median
    /// of its stamp beyond a quarter of the side from the centre, where a map does not contain the Poisson noise of the galaxy.
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with_all = ["noise", "weight_map"])]
    variance: Vec<PathBuf>,
    /// Use only variance maps of this name [default files: the stamps or the exposure].
    #[arg(long, value_name = "NAME", conflicts_with_all = ["noise", "weight_map"])]
    variance_extension: Option<String>,
    /// Maps of the inverse variance instead. Pixels of weight 0 are missing.
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with_all = ["noise", "variance", "variance_extension"])]
    weight_map: Vec<PathBuf>,
    /// Use only weight maps of this name [default files: the stamps or the exposure].
    #[arg(long, value_name = "NAME", conflicts_with_all = ["noise", "variance", "variance_extension"])]
    weight_extension: Option<String>,
    /// Axes of ellipticities: those of the sky, by the WCS of the galaxies, or of the pixels [default: sky if the WCS rotates,
    /// mirrors or shears the pixels, else pixel].
    #[arg(long, value_name = "pixel|sky")]
    frame: Option<Frame>,
    /// Electrons per unit of the image: linear configurations then add the Poisson noise of each galaxy, by its measured flux and
    /// size.
    #[arg(long, value_name = "E_PER_ADU")]
    gain: Option<f64>,
    /// Standard deviation of the noise per pixel, written to the header for configurations that do not measure it.
    #[arg(long, value_name = "SIGMA")]
    noise: Option<f64>,
    /// Set of the image.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_SET)))]
    set: u32,
    /// Number of the image in its set.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    image: u32,
    /// Data folder. It may contain images of other numbers.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    summary: SummaryArguments,
}

// The options of stamps that are cut out of an exposure.
#[derive(Debug, Clone, Args)]
#[group(requires_all = ["exposure", "positions"])]
struct Cutouts {
    /// Coordinate of the centre of the first pixel: 1 for FITS and SExtractor, 0 for NumPy and sep.
    #[arg(long, value_name = "0|1", default_value_t = 1, value_parser = clap::value_parser!(u8).range(0..=1))]
    first_pixel: u8,
    /// Columns of the positions: names, or numbers from 1 if the table has no names [default: x and y, names of SExtractor
    /// such as X_IMAGE and Y_IMAGE, ra and dec, or the only two columns].
    #[arg(long, value_name = "X,Y", value_delimiter = ',', num_args = 1)]
    columns: Option<Vec<String>>,
    /// Positions are right ascension and declination in degrees: the columns of --columns, whatever their names, or those of such
    /// names even if there are x and y.
    #[arg(long)]
    degrees: bool,
    /// Pixels a side of the stamps that are cut out.
    #[arg(long, value_name = "N", default_value_t = 48, value_parser = clap::value_parser!(u16).range(5..=1024))]
    size: u16,
}

fn two_columns(columns: Option<&[String]>) -> anyhow::Result<Option<[&str; 2]>> {
    match columns {
        None => Ok(None),
        Some([x, y]) if !x.is_empty() && !y.is_empty() => Ok(Some([x, y])),
        Some(columns) => anyhow::bail!(
            "--columns is `{}`; expected two columns, as in `x,y` or `2,3`",
            columns.join(",")
        ),
    }
}

/// An exposure of the list, or a chip that `*` stands for.
struct Exposed {
    /// `FILE`, or `FILE[SELECTION]` of a chip.
    path: PathBuf,
    /// The place of the file in the list.
    file: usize,
    /// What `*` stands for in options of other files.
    chip: Option<Star>,
}

struct Star {
    version: i64,
    /// The shortest selection of the image in its file.
    name: String,
}

impl Star {
    /// A selection with `*` for the version of a name, or for a whole image.
    fn filled(&self, selection: &str) -> String {
        let mut parts: Vec<String> = selection
            .split(',')
            .map(|part| part.trim().into())
            .collect();
        for (place, part) in parts
            .iter_mut()
            .enumerate()
            .filter(|(_, part)| *part == "*")
        {
            *part = match place {
                0 => self.name.clone(),
                _ => self.version.to_string(),
            };
        }
        parts.join(",")
    }
}

fn has_star(selection: &str) -> bool {
    selection.split(',').any(|part| part.trim() == "*")
}

impl Arguments {
    /// With the files of `@LIST` and quoted patterns. `*` in brackets is a version of an image.
    fn with_lists(&self) -> anyhow::Result<Self> {
        let mut own = self.clone();
        let lists = [
            &mut own.stamps,
            &mut own.exposure,
            &mut own.mask,
            &mut own.psf,
            &mut own.variance,
            &mut own.weight_map,
        ];
        for list in lists {
            if !list.iter().any(|path| path.to_string_lossy().contains('[')) {
                *list = listed(list)?;
            }
        }
        Ok(own)
    }
}

impl Exposed {
    fn all(arguments: &Arguments) -> anyhow::Result<Vec<Self>> {
        let mut all = Vec::new();
        for (file, path) in arguments.exposure.iter().enumerate() {
            let place = Place::of(path);
            let selection = arguments.extension.as_ref().or(place.table.as_ref());
            let Some(selection) = selection.filter(|selection| has_star(selection)) else {
                all.push(Exposed {
                    path: path.clone(),
                    file,
                    chip: None,
                });
                continue;
            };
            all.extend(Exposed::of_file(&place.path, file, selection)?);
        }
        Ok(all)
    }

    fn of_file(path: &Path, file: usize, selection: &str) -> anyhow::Result<Vec<Self>> {
        let heads = image_heads(path)?;
        // Without its stars a selection is one of all chips.
        let rest: Vec<&str> = selection
            .split(',')
            .filter(|part| part.trim() != "*")
            .collect();
        let meant = match rest.join(",") {
            rest if rest.is_empty() => Selection::default(),
            rest => Selection::parse(&rest).map_err(anyhow::Error::msg)?,
        };
        let chips: Vec<Exposed> = heads
            .iter()
            .filter(|head| meant.has(head))
            .map(|head| {
                let star = Star {
                    version: head.version,
                    name: head.shown(&heads),
                };
                Exposed {
                    // By its name for people; a name alone would be that of several.
                    path: format!("{}[{}]", path.display(), star.name).into(),
                    file,
                    chip: Some(star),
                }
            })
            .collect();
        let names: Vec<String> = heads.iter().map(|head| head.shown(&heads)).collect();
        anyhow::ensure!(
            !chips.is_empty(),
            "{}: no image is called `{selection}` (found {})",
            path.display(),
            names_of(&names)
        );
        Ok(chips)
    }
}

/// The options that belong to one exposure: their `*` is filled.
struct Own<'a> {
    arguments: &'a Arguments,
    /// The exposures; none for stamps.
    exposed: &'a [Exposed],
    at: usize,
    is_chip: bool,
    mask_extension: Option<String>,
    psf_extension: Option<String>,
    variance_extension: Option<String>,
    weight_extension: Option<String>,
}

impl<'a> Own<'a> {
    fn new(
        arguments: &'a Arguments,
        exposed: &'a [Exposed],
        at: usize,
        is_chip: bool,
    ) -> anyhow::Result<Self> {
        let chip = exposed.get(at).and_then(|own| own.chip.as_ref());
        let filled = |(option, selection): (&str, &Option<String>)| match (selection, chip) {
            (Some(selection), Some(chip)) => Ok(Some(chip.filled(selection))),
            (Some(selection), None) if has_star(selection) => anyhow::bail!(
                "--{option} is {selection}; expected `*` in --extension of exposures, too"
            ),
            (selection, _) => Ok(selection.clone()),
        };
        Ok(Own {
            arguments,
            exposed,
            at,
            is_chip,
            mask_extension: filled(("mask-extension", &arguments.mask_extension))?,
            psf_extension: filled(("psf-extension", &arguments.psf_extension))?,
            variance_extension: filled(("variance-extension", &arguments.variance_extension))?,
            weight_extension: filled(("weight-extension", &arguments.weight_extension))?,
        })
    }

    /// The part of a list that belongs to this exposure: all of it if there is only one.
    fn part(
        &self,
        option: &str,
        files: &'a [PathBuf],
        one_for_all: bool,
    ) -> anyhow::Result<&'a [PathBuf]> {
        let (of, of_files) = (self.exposed.len(), self.arguments.exposure.len());
        match files.len() {
            0 => Ok(files),
            _ if of < 2 => Ok(files),
            1 if one_for_all => Ok(files),
            found if found == of => Ok(&files[self.at..=self.at]),
            found if found == of_files => {
                let file = self.exposed[self.at].file;
                Ok(&files[file..=file])
            }
            found => anyhow::bail!(
                "--{option} names {} for {of} exposures (expected one for each, in the same order)",
                count(found, "file")
            ),
        }
    }
}

/// What to gather from an exposure, or from all stamps.
fn gathering<'a>(own: &'a Own<'a>) -> anyhow::Result<Gathering<'a>> {
    let arguments = own.arguments;
    let exposure = own.exposed.get(own.at);
    for (option, value) in [("noise", arguments.noise), ("gain", arguments.gain)] {
        anyhow::ensure!(
            // Not subnormal: noise is divided by, and 1/5e-324 is infinite.
            value.is_none_or(|value| value > 0.0 && value.is_normal()),
            "--{option} is {}; expected a positive number",
            // `{}` would print 324 digits of the least number.
            format!("{:?}", value.unwrap_or_default()).trim_end_matches(".0")
        );
    }
    let images = Files {
        paths: match exposure {
            None => arguments.stamps.as_slice(),
            Some(exposure) => std::slice::from_ref(&exposure.path),
        },
        // A chip has its selection in brackets.
        extension: match exposure.and_then(|exposure| exposure.chip.as_ref()) {
            None => arguments.extension.as_deref(),
            Some(_) => None,
        },
        content: Content::Sky,
    };
    // An extension without a file means the files of the images: surveys store masks and weights in one file with the pixels.
    let companion = |paths: &'a [PathBuf], extension: Option<&'a str>, content| {
        (!paths.is_empty() || extension.is_some()).then_some(Files {
            paths: if paths.is_empty() {
                images.paths
            } else {
                paths
            },
            extension,
            content,
        })
    };
    let masks = companion(
        own.part("mask", &arguments.mask, false)?,
        own.mask_extension.as_deref(),
        Content::Mask,
    );
    anyhow::ensure!(
        // Not by `requires` of clap, because either of two options gives a mask.
        masks.is_some() || arguments.mask_bits.is_none(),
        "--mask-bits is given without a mask; expected --mask or --mask-extension"
    );
    let bits = arguments.mask_bits.as_ref();
    let bits = bits.map(|bits| bits.iter().fold(0, |all, bit| all | 1u64 << bit));
    let variances = companion(
        own.part("variance", &arguments.variance, false)?,
        own.variance_extension.as_deref(),
        Content::Variance,
    );
    let weights = companion(
        own.part("weight-map", &arguments.weight_map, false)?,
        own.weight_extension.as_deref(),
        Content::Weight,
    );
    let positions = own.part("positions", &arguments.positions, true)?;
    anyhow::ensure!(
        positions.len() <= 1,
        "--positions names {} for one image (expected one)",
        count(positions.len(), "file")
    );
    let cutouts = &arguments.cutouts;
    let columns = two_columns(cutouts.columns.as_deref())?;
    let table = positions.first().map(|path| Table {
        path,
        table: arguments.table.as_deref(),
        columns,
        degrees: cutouts.degrees,
        id: arguments.id.as_deref(),
        carry: &arguments.carry,
    });
    let (stamps, rows) = match table {
        Some(positions) if exposure.is_some() => {
            let cutouts = Stamps::Cutouts {
                exposure: images,
                positions,
                first_pixel: cutouts.first_pixel,
                side: usize::from(cutouts.size),
            };
            (cutouts, None)
        }
        rows => (Stamps::Files(images), rows),
    };
    Ok(Gathering {
        stamps,
        rows,
        square: arguments.square,
        masks: masks.map(|files| Masks { files, bits }),
        psfs: Files {
            paths: own.part("psf", &arguments.psf, own.is_chip)?,
            extension: own.psf_extension.as_deref(),
            content: Content::Psf,
        },
        psf_oversampling: arguments.psf_oversampling.map(usize::from),
        noise: arguments.noise,
        variances: variances.or(weights),
        gain: arguments.gain,
        frame: arguments.frame,
    })
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let arguments = &arguments.with_lists()?;
    let exposed = Exposed::all(arguments)?;
    let is_chip = arguments.chips || exposed.iter().any(|one| one.chip.is_some());
    let exposures = exposed.len().max(1);
    let own: Vec<Own<'_>> = (0..exposures)
        .map(|at| Own::new(arguments, &exposed, at, is_chip))
        .collect::<anyhow::Result<_>>()?;
    let all: Vec<Gathering<'_>> = own.iter().map(gathering).collect::<anyhow::Result<_>>()?;
    let last = arguments.image as usize + exposures - 1;
    anyhow::ensure!(
        last <= MAX_IMAGE as usize,
        "{exposures} exposures from --image {} on need the image number {last} (expected up to {MAX_IMAGE})",
        arguments.image
    );
    let out = &arguments.out;
    // An existing folder may have a layout.toml with other names of files.
    let data = if out.is_dir() {
        DataFolder::open(out)?
    } else {
        DataFolder::new(out)
    };
    let (set, image) = (arguments.set, arguments.image);
    let exposures = match is_chip {
        true => Exposures::Chips,
        false => Exposures::Epochs,
    };
    let gathered = gather(&data, ImageId { set, image }, &all, exposures)?;
    let mut images = Vec::new();
    for ((image, gathered), at) in (image..).zip(gathered).zip(0..) {
        match gathered {
            Some(gathered) => {
                let path = data.galaxies(set, image);
                tell_gathered(&path, &gathered);
                images.push(serde_json::json!({
                    "set": set,
                    "image": image,
                    "path": path,
                    "galaxies": gathered.mosaic.galaxies,
                    "stamp": gathered.mosaic.stamp,
                    "incomplete": gathered.incomplete,
                    "messages": gathered.messages,
                }));
            }
            None => tell(format_args!(
                "note: {}: no galaxy is on this chip, which becomes no image",
                exposed[at].path.display()
            )),
        }
    }
    let summary = || serde_json::json!({ "images": images });
    arguments.summary.print(summary)
}

fn tell_gathered(path: &Path, gathered: &Gathered) {
    let Gathered {
        mosaic,
        incomplete,
        messages,
    } = gathered;
    for message in messages {
        tell(format_args!("{message}"));
    }
    if *incomplete > 0 {
        tell(format_args!(
            "{} with missing pixels. Networks flag such galaxies; linear configurations flag them if too many pixels are missing",
            count(*incomplete, "stamp")
        ));
    }
    tell(format_args!(
        "{} of {1} × {1} pixels in {2}",
        count(mosaic.galaxies, "stamp"),
        mosaic.stamp,
        path.display()
    ));
}
