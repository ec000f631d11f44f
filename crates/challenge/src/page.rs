//! The leaderboard as a table, as a page that works without server and network, and the page for participants.

use std::path::Path;

use shearq_files::{FileError, atomic};
use shearq_render::figure::FigureError;
use shearq_render::html::{Block, Picture, Report, Section};
use shearq_render::page::PageError;
use shearq_render::table::{Cell, Table, TableFormat};
use shearq_results::submit::Kind as FileKind;
use shearq_results::views::comparison::per_set_plot;

use crate::entry::{EntryInfo, Refused};
use crate::kind::{ConstantShears, Noise, Published, RankBy};
use crate::ranking::{Board, Leaderboard, Scored, Standing, better};
use crate::scenes::{SceneScore, expected_m_error};
use crate::seal::close;
use crate::terms::{Challenge, Data, SceneData};

#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    pub challenge: &'a Challenge,
    pub board: &'a Leaderboard<'a>,
    pub refused: &'a [Refused],
    /// Mean Q of an entry of zeros; `None` for constant shears.
    pub zero_shear: Option<f64>,
    /// The true shears of sets with one shear each.
    pub constant: Option<&'a ConstantShears>,
    pub noise: &'a Noise,
    /// Whether entries are still accepted. Until then, the board has the metric alone.
    pub open: bool,
    /// Whether the page is for the organiser: all numbers, those of single sets, and what the comparison with the true shear
    /// showed.
    pub detail: bool,
}

// Keys of the columns of a metric and its error.
fn key(metric: RankBy) -> (&'static str, &'static str) {
    match metric {
        RankBy::Q => ("q", "q_error"),
        RankBy::QCorrected => ("q_corrected", "q_corrected_error"),
        RankBy::QCalibrated => ("q_calibrated", "q_calibrated_error"),
        RankBy::M => ("m", "m_error"),
        RankBy::C => ("c", "c_error"),
        RankBy::Qc => ("qc", "qc_error"),
        RankBy::ShearError => ("shear_error", "shear_error_error"),
    }
}

impl View<'_> {
    fn metric(&self) -> RankBy {
        self.challenge.rules.metric
    }

    /// All boards in one table: one row per team and reference.
    pub fn table(&self) -> Table {
        self.table_of(&Board::ALL)
    }

    #[expect(clippy::too_many_lines, reason = "one column after the other")]
    fn table_of(&self, boards: &[Board]) -> Table {
        let metric = self.metric();
        let zero = metric.of_zero_shear(self.zero_shear.unwrap_or(f64::NAN));
        let zero = Published::new(zero, metric.least_error(zero, self.noise));
        let standings = boards.iter().flat_map(|board| self.board.of(*board));
        // A row without standing is an entry of zeros: whoever is below it has measured nothing.
        let mut rows: Vec<Option<&Standing<'_>>> = standings.map(Some).collect();
        if boards.contains(&Board::Main) {
            // At the better end of its error: a value that is rounded to 0 by a large error is not below that of zeros.
            let behind = |row: &Option<&Standing<'_>>| {
                row.is_none_or(|standing| {
                    let Published { value, step, .. } = standing.best.published;
                    let end = match metric.larger_is_better() {
                        true => value + step,
                        false => value - step,
                    };
                    standing.board != Board::Main || better(metric, zero.value, end)
                })
            };
            let place = rows.iter().position(behind).unwrap_or(rows.len());
            rows.insert(place, None);
        }
        let mut table = Table::titled(format!("Leaderboard of {}", self.challenge.name));
        let mut add = |key, label: &str, of_zeros: Cell, cell: &dyn Fn(&Standing<'_>) -> Cell| {
            table.column(key, label, &rows, |row| {
                row.map_or_else(|| of_zeros.clone(), cell)
            });
        };
        let info = |text: fn(&EntryInfo) -> String| {
            move |standing: &Standing<'_>| Cell::text(text(standing.best.info()))
        };
        let number = |value: usize| Cell::number(value as f64, 0);
        add("rank", "rank", Cell::Empty, &|standing| {
            let shared = if standing.shared { "=" } else { "" };
            let rank = |rank| Cell::text(format!("{rank}{shared}"));
            standing.rank.map_or(Cell::Empty, rank)
        });
        // Teams may have this name, too, but they have a rank.
        let team = info(|info| info.team.clone());
        add("team", "team", Cell::text("zero shear"), &team);
        let method = info(|info| info.method.clone());
        add("method", "method", Cell::text("no image"), &method);
        add("title", "title", Cell::Empty, &|standing| {
            let info = standing.best.info();
            let reference = if info.reference { "reference" } else { "" };
            let same = standing.same_as.as_deref().unwrap_or_default();
            let mut parts = vec![reference, &info.title, same];
            parts.retain(|part| !part.is_empty());
            match parts.is_empty() {
                true => Cell::Empty,
                false => Cell::text(parts.join(": ")),
            }
        });
        let files = info(|info| match info.contents.is_spectra() {
            true => "spectra".into(),
            false => "catalogues".into(),
        });
        add("files", "files", Cell::Empty, &files);
        let value = |own: Published| Cell::number(own.value, own.decimals);
        let exact = |exact: f64, own: Published| match self.detail {
            true => Cell::number(exact, own.decimals + 2),
            false => value(own),
        };
        let exact_error = |error: f64, own: Published| match self.detail {
            true => Cell::number(error, own.decimals + 2),
            false => Cell::number(own.step, own.decimals),
        };
        let (of_value, of_error) = key(metric);
        add(of_value, metric.label(), value(zero), &|standing| {
            exact(standing.best.value, standing.best.published)
        });
        add(of_error, "± error", Cell::Empty, &|standing| {
            exact_error(standing.best.error, standing.best.published)
        });
        for other in [RankBy::QCalibrated, RankBy::M, RankBy::C] {
            let is_secret = self.open && !self.detail;
            if is_secret || other == metric || !other.suits(self.constant.is_some()) {
                continue;
            }
            let of = |standing: &Standing<'_>| {
                let entry = standing.best.entry;
                let (value, error) = entry.value(other, self.constant);
                let own = entry.published(other, self.constant, self.noise);
                value.is_finite().then_some((value, error, own))
            };
            let (of_value, of_error) = key(other);
            add(of_value, other.label(), Cell::Empty, &|standing| {
                of(standing).map_or(Cell::Empty, |(value, _, own)| exact(value, own))
            });
            // A limit of m is compared with it.
            if self.challenge.data.scene.is_some() {
                add(of_error, "±", Cell::Empty, &|standing| {
                    of(standing).map_or(Cell::Empty, |(_, error, own)| exact_error(error, own))
                });
            }
        }
        if self.challenge.data.scene.is_some() {
            add("density", "rows/arcmin²", Cell::Empty, &|standing| {
                let scenes = &standing.best.info().scenes;
                let density = |own: &SceneScore| Cell::number(own.density, 1);
                scenes.as_ref().map_or(Cell::Empty, density)
            });
        }
        let received = info(|info| info.received.strftime("%Y-%m-%d %H:%M").to_string());
        add("received", "received (UTC)", Cell::Empty, &received);
        add("entries", "entries", Cell::Empty, &|standing| {
            number(standing.entries.len())
        });
        let filled =
            |board: &Board| *board != Board::Main && self.board.of(*board).next().is_some();
        if boards.iter().any(filled) {
            let all = self.challenge.data.sets.len();
            add("board", "board", Cell::Empty, &|standing| {
                Cell::text(match standing.board {
                    Board::Main => "main".to_owned(),
                    Board::Biased => biased(self.challenge.rules.max_m),
                    Board::Late => "late".to_owned(),
                    Board::Partial => format!("{} of {all} sets", standing.best.entry.sets.len()),
                })
            });
        }
        // Columns that say nothing are left out for people.
        let contents = &self.challenge.rules.contents;
        for heading in &mut table.headings {
            heading.detail = heading.key == "files" && !contents.iter().any(|own| own.is_spectra());
        }
        table.notes = vec![
            metric.meaning().to_owned(),
            "Each team is ranked by its best entry. Teams share a rank (=) if their difference is below its error or not printed. Values are rounded to their errors and ordered by their worse ends.".into(),
        ];
        table.notes.extend(self.zero_note());
        table
    }

    /// The table for people: without empty columns, and with the numbers beside the team, where they are in sight on a phone.
    pub fn shown(&self) -> Table {
        self.shown_of(&Board::ALL)
    }

    fn shown_of(&self, boards: &[Board]) -> Table {
        let mut table = self.table_of(boards).narrow().without_empty_columns();
        let place = |key: &str| match key {
            "rank" | "team" => 0,
            "method" | "title" | "files" => 2,
            "received" | "entries" | "board" => 3,
            _ => 1,
        };
        let mut order: Vec<usize> = (0..table.headings.len()).collect();
        order.sort_by_key(|k| place(table.headings[*k].key));
        table.headings = order.iter().map(|k| table.headings[*k].clone()).collect();
        for row in &mut table.rows {
            *row = order.iter().map(|k| row[*k].clone()).collect();
        }
        table
    }

    // Q of zero shear on boards of other metrics, too: whoever reads Q elsewhere must see it.
    fn zero_note(&self) -> Option<String> {
        // On a board of Q it is a line.
        if self.open && !self.detail {
            return None;
        }
        let q = self.zero_shear?;
        let q = Published::new(q, RankBy::Q.least_error(q, self.noise)).value;
        let why = match self.metric().of_zero_shear(1.0).is_nan() {
            true => format!(
                " It has no {}, because it does not respond to the shear.",
                self.metric().label()
            ),
            false => String::new(),
        };
        Some(format!("Zero shear has Q = {q} without images.{why}"))
    }

    // Entries that were not scored or do not count.
    fn failures(&self) -> Table {
        let refused = self.refused.iter().map(|refused| {
            let name = refused.path.file_name().unwrap_or_default();
            let name = name.to_string_lossy().into_owned();
            (name, &refused.team, &refused.reason)
        });
        let excluded = self.board.excluded.iter();
        let excluded = excluded.map(|(info, reason)| (info.method.clone(), &info.team, reason));
        let rows: Vec<(String, &String, &String)> = refused.chain(excluded).collect();
        let mut table = Table::titled("Entries without a rank");
        table.column("entry", "entry", &rows, |row| Cell::text(&row.0));
        table.column("team", "team", &rows, |row| Cell::text(row.1));
        table.column("reason", "reason", &rows, |row| Cell::text(row.2));
        table
    }

    // What the comparison with the true shear showed, on a page for the organiser.
    fn findings(&self) -> Table {
        let standings = self.board.standings.iter();
        let ranked = standings
            .flat_map(|standing| &standing.entries)
            .map(Scored::info);
        let excluded = self.board.excluded.iter().map(|(info, _)| *info);
        let all = ranked.chain(excluded).filter(|_| self.detail);
        let of = |info: &'_ EntryInfo| {
            let found = info.findings.iter();
            found
                .map(|found| [&info.file, &info.team, found].map(String::clone))
                .collect::<Vec<_>>()
        };
        let rows: Vec<[String; 3]> = all.flat_map(of).collect();
        let mut table = Table::titled("Findings for the organiser");
        for (k, heading) in ["entry", "team", "finding"].into_iter().enumerate() {
            table.column(heading, heading, &rows, |row| Cell::text(&row[k]));
        }
        table
    }

    fn report(&self) -> Result<Report, FigureError> {
        let Challenge {
            name,
            version,
            kind,
            data,
            rules: terms,
            ..
        } = self.challenge;
        let blocks = vec![Block::Filtered(self.shown_of(&[Board::Main]))];
        let mut sections = vec![Section::new("leaderboard", "Leaderboard", blocks)];
        if self.detail && data.scene.is_none() {
            sections.push(self.every_set()?);
        }
        let of_board = |board, title: &str| Table {
            title: title.into(),
            notes: Vec::new(),
            ..self.shown_of(&[board])
        };
        for (id, table) in [
            (
                "biased",
                of_board(
                    Board::Biased,
                    &format!("Entries with {}", biased(terms.max_m)),
                ),
            ),
            ("late", of_board(Board::Late, "Late entries")),
            ("partial", of_board(Board::Partial, "Entries of some sets")),
            ("failures", self.failures()),
            ("findings", self.findings()),
        ] {
            if !table.rows.is_empty() {
                let title = table.title.clone();
                sections.push(Section::new(id, title, vec![Block::Filtered(table)]));
            }
        }
        for (id, title, paragraphs) in [
            ("take-part", "Take part", take_part(self.challenge)),
            ("rules", "Rules", rules(self.challenge)),
        ] {
            let text = Block::Text(paragraphs.join("\n\n"));
            sections.push(Section::new(id, title, vec![text]));
        }
        let about_data = match &data.scene {
            Some(scene) => in_words(data, scene),
            None => format!(
                "{} sets of {} images with {2} × {2} galaxies, {3}",
                data.sets.len(),
                data.images,
                data.grid,
                volume(data)
            ),
        };
        let settings = [
            ("Version of the data", version.to_string()),
            ("Kind", kind.title().to_owned()),
            ("Data", about_data),
            ("Metric", terms.metric.label().to_owned()),
            ("Program", format!("shearq {}", shearq_dataset::VERSION)),
        ];
        Ok(Report {
            title: name.clone(),
            subtitle: format!("{}: leaderboard", kind.title()),
            sections,
            settings: settings
                .map(|(name, value)| (name.to_owned(), value))
                .into(),
            ..Report::default()
        })
    }

    fn every_set(&self) -> Result<Section, FigureError> {
        let rows: Vec<_> = self
            .board
            .standings
            .iter()
            .map(|standing| {
                let info = standing.best.info();
                let name = format!("{}: {}", info.team, info.method);
                (name, standing.best.entry.sets.as_slice())
            })
            .collect();
        let caption = "Q, calibrated Q and m of each set.";
        let picture = Picture::draw(&per_set_plot(&rows), "per-set", caption)?;
        Ok(Section::new(
            "sets",
            "Metric of each set",
            vec![Block::Figure(picture)],
        ))
    }

    /// Writes the page to `path`, and the table as CSV and JSON with the same name. A page for the organiser is for its owner
    /// alone.
    pub fn save(&self, path: &Path) -> Result<(), PageError> {
        let table = self.table();
        self.report()?.save(path)?;
        let mut written = vec![path.to_owned()];
        for (ending, format) in [("csv", TableFormat::Csv), ("json", TableFormat::Json)] {
            let beside = path.with_extension(ending);
            if beside == path {
                let message = "expected a name that ends in .html";
                return Err(FileError::new(path, message).into());
            }
            atomic::write(&beside, table.render(format).as_bytes())?;
            written.push(beside);
        }
        if self.detail {
            written.iter().try_for_each(|path| close(path))?;
        }
        Ok(())
    }
}

// Why entries of scenes have no rank.
fn biased(max_m: Option<f64>) -> String {
    format!("|m| above {}", max_m.unwrap_or(f64::INFINITY))
}

// Scenes with their pixels and area, in words.
fn in_words(data: &Data, scene: &SceneData) -> String {
    format!(
        "{} scenes of {1} × {1} pixels and {2:.2} arcmin² each",
        data.sets.len(),
        scene.side,
        scene.arcmin2
    )
}

// Rules of a challenge, one paragraph each.
fn rules(challenge: &Challenge) -> Vec<String> {
    let Challenge {
        kind, rules, data, ..
    } = challenge;
    let covers = match rules.partial {
        _ if data.scene.is_some() => "An entry has one catalogue of each scene.",
        false => "An entry covers all images of all sets.",
        true => {
            "An entry covers all images of its sets. One of some sets only is listed without a rank."
        }
    };
    let mut all = vec![covers.to_owned(), kind.rule().to_owned()];
    all.push(format!(
        "Entries are ranked by {}, over all {}. {}",
        rules.metric.label(),
        if data.scene.is_some() {
            "scenes"
        } else {
            "sets"
        },
        rules.metric.meaning()
    ));
    if let (Some(max_m), Some(scene)) = (rules.max_m, &data.scene) {
        let error = expected_m_error(data.sets.len() as f64 * scene.arcmin2);
        all.push(format!(
            "Entries whose |m|, the mean of both components, is above {max_m} by more than twice its error are listed without a rank. With all scenes, m has an error of about {error:.2}."
        ));
    }
    all.push("The response of an entry to the shear must be at least 3σ from zero.".into());
    all.push("Entries whose difference is below its error share a rank. Values are rounded to their errors.".into());
    all.push("Symbolic links are not accepted.".into());
    if let Some(most) = rules.entries_per_team {
        all.push(format!(
            "Each team may send at most {most} entries, because published values reveal the true shear entry by entry."
        ));
    }
    if let Some(opens) = &rules.opens {
        all.push(format!("Entries are accepted from {opens}."));
    }
    if let Some(closes) = &rules.closes {
        all.push(format!(
            "Entries are accepted until {closes}. Later entries have their own board."
        ));
    }
    all
}

// Where to get data and program, and where to send entries, one paragraph each.
fn take_part(challenge: &Challenge) -> Vec<String> {
    let data = &challenge.data;
    let place = |place: &str, none: &str| match place.is_empty() {
        true => none.to_owned(),
        false => place.to_owned(),
    };
    vec![
        format!(
            "Data ({}): {}",
            volume(data),
            place(&challenge.address, "ask the organiser")
        ),
        format!(
            "Entries and questions: {}",
            place(&challenge.contact, "to the organiser")
        ),
        format!(
            "Any program may measure the shapes. shearq ({}) {}, and checks it without the true shear: README.md beside the images has the commands.",
            env!("CARGO_PKG_REPOSITORY"),
            match data.scene {
                Some(_) => "detects and measures galaxies, which are an entry as they are",
                None => "measures, packs an entry",
            }
        ),
    ]
}

// Bytes of the pixels of all images, in words.
fn volume(data: &Data) -> String {
    if let Some(SceneData { side, epochs, .. }) = data.scene {
        let exposures = data.sets.len() * epochs.unwrap_or(1) as usize;
        let bytes = exposures * side * side * size_of::<f32>();
        return format!("{:.0} MB of exposures, and their PSF", bytes as f64 / 1e6);
    }
    let pixels = data.galaxies() as f64 * (data.stamp * data.stamp) as f64;
    let megabytes = pixels * size_of::<f32>() as f64 / 1e6;
    match megabytes < 1000.0 {
        true => format!("{megabytes:.0} MB of galaxies, and their PSFs"),
        false => format!("{:.1} GB of galaxies, and their PSFs", megabytes / 1000.0),
    }
}

// Data, conventions and entries of a challenge of scenes, as Markdown.
fn scene_sections(challenge: &Challenge, scene: &SceneData) -> String {
    let data = &challenge.data;
    let (psf, model) = match scene.psf_varies {
        false => (
            "`psf.fits`: the PSF of all scenes, as a star without noise",
            "psf.fits",
        ),
        true => (
            "`model.psf`: the PSF at each place of all scenes, as PSFEx has it; `psf.fits`: that of the middle, as a star without noise",
            "model.psf",
        ),
    };
    let gain = scene.gain.map_or_else(String::new, |gain| {
        format!(", and that of the light at {gain} electrons per unit")
    });
    let (epochs, all) = match scene.epochs {
        None => (String::new(), ""),
        Some(epochs) => (
            format!(
                " Each scene has {epochs} exposures, turned and moved, with a WCS each: `scene-001-epoch-2.fits` and so on."
            ),
            "*",
        ),
    };
    format!(
        r"## Data

* {about}: `scene-001.fits` and so on, with the sky subtracted and white noise of one per pixel{gain}. Galaxies lie anywhere and blend.{epochs}
* {psf}.
* Verify the download with `sha256sum -c SHA256SUMS`.

## Conventions

{conventions}
## Entries

Detect, measure and select with any program. An entry has a catalogue of each scene in CSV, FITS or Parquet, with the number of the scene in the name of the file (`scene-001.csv`). Of sheared catalogues, names or a column state noshear, 1p, 1m, 2p and 2m.

A catalogue has any number of rows with the ellipticities e1 and e2, and perhaps responses (R11, R22, R12, R21), a weight and a flag; positions are not needed. The mean shear of catalogues is Σ w e/Σ w R.

Put all catalogues into one folder, and this folder into a `.tar.gz` or `.zip`. With the detection of shearq:

```sh
for n in $(seq {count}); do
  shearq detect --exposure scene-$(printf %03d $n){all}.fits --psf {model} --image $n --out ../detected
done
tar czf ../entry.tar.gz -C ../detected set01
shearq challenge check ../entry.tar.gz --challenge .
```

The last command prints which column is used as what. It finds missing scenes and numbers that are not finite, but neither wrong signs nor exchanged components, for which it would need the true shear.

",
        about = in_words(data, scene),
        conventions = in_lines(challenge),
        count = data.sets.len(),
    )
}

fn in_lines(challenge: &Challenge) -> String {
    let each = challenge.conventions.iter();
    each.map(|(name, meaning)| format!("* {name}: {meaning}.\n"))
        .collect()
}

// Data, conventions and entries of a challenge of galaxies on a grid, as Markdown.
fn grid_sections(challenge: &Challenge) -> String {
    let Challenge {
        name, data, rules, ..
    } = challenge;
    let sets: Vec<String> = data.sets.iter().map(u32::to_string).collect();
    let first = data.sets.first().copied().unwrap_or(1);
    let method = || "METHOD".to_owned();
    let catalogue = FileKind::Catalogue {
        set: first,
        image: 1,
        method: method(),
    };
    let spectrum = FileKind::Spectrum {
        set: first,
        method: method(),
    };
    let half = 0.5 * (data.stamp as f64 + 1.0);
    let mut text = format!(
        "## Data\n\n* Sets: {}.\n* Images per set: {}, numbered from 1.\n* Galaxies per image: {2} × {2}, in stamps of {3} × {3} pixels.\n* Side of the field: {4} degrees.\n* `layout.toml` has the names of images and PSFs.\n* Verify the download with `sha256sum -c SHA256SUMS`.\n\n",
        sets.join(", "),
        data.images,
        data.grid,
        data.stamp,
        data.field_degrees
    );
    text.push_str(&format!("## Conventions\n\n{}", in_lines(challenge)));
    text.push_str(&format!(
        "\n## Entries\n\nAn ellipticity catalogue is an ASCII file `{}` per image with one line per galaxy: `x y e1 e2`. For example, the first galaxy:\n\n```text\n{half} {half} 0.0312 -0.0147\n```\n\n",
        catalogue.file_name()
    ));
    if rules.contents.iter().any(|contents| contents.is_spectra()) {
        text.push_str(&format!(
            "A power spectrum is an ASCII file `{}` per set with the bins 2 to 9: `index l power`.\n\n",
            spectrum.file_name()
        ));
    }
    text.push_str(&format!(
        "Put the files of an entry into one `.tar.gz` or `.zip`. shearq does it for its own catalogues, and for yours if you describe them (`--foreign`):\n\n```sh\nshearq measure --data . --submission 48/linear/star --out ../catalogues\nshearq pack --measured ../catalogues --challenge \"{}\" --team TEAM --out ../entry.tar.gz\nshearq challenge check ../entry.tar.gz --challenge .\n```\n\nThe last command checks any entry, and needs no true shear. It finds missing and duplicate galaxies, swapped or flipped components, shapes that do not agree with their images, and distortions that are given as shear.\n\n",
        name.replace(['"', '\\', '$', '`'], "")
    ));
    text
}

// The page for participants, as Markdown.
pub(crate) fn readme(challenge: &Challenge) -> String {
    let (name, version, kind) = (&challenge.name, challenge.version, challenge.kind);
    let (task, sections) = match &challenge.data.scene {
        Some(scene) => ("shear of each scene", scene_sections(challenge, scene)),
        None => ("shapes of the galaxies", grid_sections(challenge)),
    };
    let mut text = format!(
        "# {name}\n\nVersion {version}. Kind: {} (`{}`).\n\nMeasure the {task}. The true shear is secret. `challenge.toml` has the numbers below in machine-readable form.\n\n{sections}## Rules\n\n",
        kind.title(),
        kind.name()
    );
    for rule in self::rules(challenge) {
        text.push_str(&format!("* {rule}\n"));
    }
    text.push_str("\n## Take part\n\n");
    for place in take_part(challenge) {
        text.push_str(&format!("* {place}\n"));
    }
    text
}
