//! Positions for `gather`, in the tables that catalogues come in: the columns are those that were named or are known, or the
//! table is refused.

use std::fs;
use std::path::Path;

use shearq_files::fits::write_table;
use shearq_files::frames::frame;
use shearq_files::frames::polars::Column;

use crate::support::{Small, fail, fits_image, floats, pixels_of, shearq, succeed, text};

/// Centres of 24 px stamps of an exposure of 96 × 96 pixels, whose pixels number its stamps.
const PLACES: [(f64, f64); 3] = [(36.5, 12.5), (84.5, 60.5), (12.5, 84.5)];

/// A folder with an exposure and a PSF.
fn folder() -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    let value = |k: usize| (k / 96 / 24 * 4 + k % 96 / 24) as f32;
    let pixels: Vec<f32> = (0..96 * 96).map(value).collect();
    let exposure = fits_image(-32, &[96, 96], &[], &floats(&pixels));
    fs::write(root.path().join("field.fits"), exposure).unwrap();
    let mut star = vec![0.0f32; 400];
    star[210] = 1.0;
    let psf = fits_image(-32, &[20, 20], &[], &floats(&star));
    fs::write(root.path().join("psf.fits"), psf).unwrap();
    root
}

fn arguments(root: &Path, positions: &str, more: &[&str]) -> Vec<String> {
    let at = |name: &str| root.join(name).to_str().unwrap().to_owned();
    let mut all: Vec<String> = ["gather", "--size", "24"].map(str::to_owned).into();
    for (option, name) in [
        ("--exposure", "field.fits"),
        ("--positions", positions),
        ("--psf", "psf.fits"),
        ("--out", "data"),
    ] {
        all.extend([option.to_owned(), at(name)]);
    }
    all.extend(more.iter().map(|&argument| argument.to_owned()));
    all
}

fn borrowed(arguments: &[String]) -> Vec<&str> {
    arguments.iter().map(String::as_str).collect()
}

/// Gathers the stamps at the positions of a table, which must be those of `PLACES`, and gives what was reported.
fn gathered(root: &Path, positions: &str, more: &[&str]) -> String {
    let data = root.join("data");
    let _ = fs::remove_dir_all(&data);
    let done = shearq(&borrowed(&arguments(root, positions, more)));
    let said = String::from_utf8(done.stderr).unwrap();
    assert!(done.status.success(), "{positions} {more:?}: {said}");
    let (pixels, width) = pixels_of(&data.join("set01/galaxies-001.fits"));
    let found: Vec<f32> = (0..3)
        .map(|k| pixels[k / 2 * 24 * width + k % 2 * 24])
        .collect();
    assert_eq!(found, [1.0, 11.0, 12.0], "{positions} {more:?}");
    said
}

fn refused(root: &Path, positions: &str, more: &[&str]) -> String {
    let data = root.join("data");
    let _ = fs::remove_dir_all(&data);
    let message = fail(&borrowed(&arguments(root, positions, more)));
    assert!(
        !data.join("set01/galaxies-001.fits").exists(),
        "{positions}"
    );
    assert!(
        message.contains(positions.split('[').next().unwrap()),
        "{message}"
    );
    message
}

/// Lines of a table, each written by `line` from number, x and y.
fn lines(head: &str, line: impl Fn(usize, f64, f64) -> String) -> String {
    let rows = PLACES
        .iter()
        .enumerate()
        .map(|(k, &(x, y))| line(k + 1, x, y) + "\n");
    head.to_owned() + &rows.collect::<String>()
}

const SEXTRACTOR: &str = "\
#   1 NUMBER                 Running object number
#   2 X_IMAGE                Object position along x                                    [pixel]
#   3 Y_IMAGE                Object position along y                                    [pixel]
#   4 FLUX_APER              Flux vector within fixed circular aperture(s)              [count]
#   6 FLAGS                  Extraction flags
";

#[test]
fn positions_are_read_from_text_tables_with_any_head() {
    let root = folder();
    let write = |name: &str, content: String| fs::write(root.path().join(name), content).unwrap();
    let id = |k, x, y| format!("{k},{x},{y}");
    let blank = |k, x, y| format!("  {k}  {x}  {y}");
    write("header.csv", lines("id,x,y\n", id));
    write("capitals.csv", lines("id,X,Y\n", id));
    write("comment.txt", lines("# id x y\n", blank));
    write(
        "sex.cat",
        lines(SEXTRACTOR, |k, x, y| format!("{k} {x} {y} 5.0 6.0 0")),
    );
    write("bare.txt", lines("", |_, x, y| format!("{x} {y}")));
    write("note.txt", lines("# by me\n", |_, x, y| format!("{x} {y}")));
    write("numbered.txt", lines("", blank));
    for name in [
        "header.csv",
        "capitals.csv",
        "comment.txt",
        "bare.txt",
        "note.txt",
    ] {
        gathered(root.path(), name, &[]);
    }
    let said = gathered(root.path(), "sex.cat", &[]);
    assert!(
        said.contains("sex.cat: positions from the columns X_IMAGE and Y_IMAGE"),
        "{said}"
    );
    gathered(root.path(), "sex.cat", &["--columns", "X_IMAGE,Y_IMAGE"]);
    gathered(root.path(), "numbered.txt", &["--columns", "2,3"]);
    let said = gathered(root.path(), "header.csv", &["--columns", "x,y"]);
    assert!(!said.contains("positions from"), "{said}");
}

#[test]
fn columns_are_never_guessed() {
    let root = folder();
    let write = |name: &str, content: String| fs::write(root.path().join(name), content).unwrap();
    write("numbered.txt", lines("", |k, x, y| format!("{k} {x} {y}")));
    write(
        "sex.cat",
        lines(SEXTRACTOR, |k, x, y| format!("{k} {x} {y} 5.0 6.0 0")),
    );
    write(
        "sky.csv",
        lines("id,RA,Dec\n", |k, x, y| format!("{k},{x},{y}")),
    );
    write("sky.txt", lines("# ra dec\n", |_, x, y| format!("{x} {y}")));
    write(
        "other.csv",
        lines("a,b,c\n", |k, x, y| format!("{k},{x},{y}")),
    );
    write("table.vot", "<?xml version=\"1.0\"?>\n<VOTABLE>\n".into());
    for (name, more, expected) in [
        (
            "numbered.txt",
            "",
            "no names and the first row `1, 36.5, 12.5`; expected x and y",
        ),
        ("numbered.txt", "", "Try: --columns 2,3"),
        (
            "numbered.txt",
            "X_IMAGE,Y_IMAGE",
            "the columns have no names (found the first row `1, 36.5, 12.5`",
        ),
        (
            "numbered.txt",
            "3,4",
            "there is no column `4`; columns found: 1, 2, 3",
        ),
        ("numbered.txt", "0,1", "there is no column `0`"),
        (
            "sex.cat",
            "XWIN_IMAGE,YWIN_IMAGE",
            "columns found: NUMBER, X_IMAGE, Y_IMAGE, FLUX_APER, FLUX_APER_1, FLAGS",
        ),
        (
            "sex.cat",
            "x,y",
            "there is no column `x`; columns found: NUMBER",
        ),
        (
            "sex.cat",
            "2,3",
            "there is no column `2`; columns found: NUMBER",
        ),
        ("sky.csv", "", "(found id, RA, Dec; expected x and y"),
        (
            "sky.csv",
            "",
            "Coordinates on the sky have to be converted to pixels first",
        ),
        (
            "sky.txt",
            "",
            "Coordinates on the sky have to be converted to pixels first",
        ),
        (
            "other.csv",
            "",
            "cannot determine the columns of the positions (found a, b, c;",
        ),
        (
            "other.csv",
            "x,y",
            "there is no column `x`; columns found: a, b, c; --columns X,Y names others",
        ),
        (
            "table.vot",
            "",
            "the file is XML, such as a VOTable, which is not read; expected a text, FITS or Parquet table. Try: stilts tcopy",
        ),
    ] {
        let more: &[&str] = if more.is_empty() {
            &[]
        } else {
            &["--columns", more]
        };
        let message = refused(root.path(), name, more);
        assert!(message.contains(expected), "{name} {more:?}: {message}");
    }
}

/// A FITS file of one table, with another EXTNAME.
fn called(mut bytes: Vec<u8>, name: &str) -> Vec<u8> {
    let mut cards = bytes.chunks_exact_mut(80);
    let card = cards.find(|card| card.starts_with(b"EXTNAME ")).unwrap();
    let quoted = format!("'{name}'");
    card.copy_from_slice(format!("{:<80}", format!("EXTNAME = {quoted:<20}")).as_bytes());
    bytes
}

/// A FITS file with tables of these names and columns, each of which has an x and a y or others.
fn fits_tables(root: &Path, tables: &[(&str, [&str; 2], bool)]) -> Vec<u8> {
    let mut file = Vec::new();
    for (name, columns, right) in tables {
        let path = root.join("one.fits");
        let _ = fs::remove_file(&path);
        let value = |k: usize| PLACES.map(|at| if k == 0 { at.0 } else { at.1 });
        let shift = if *right { 0.0 } else { 24.0 };
        let column = |k: usize| {
            let values: Vec<f64> = value(k).iter().map(|at| at - shift).collect();
            Column::new(columns[k].into(), values)
        };
        let table = frame(vec![column(0), column(1)]).unwrap();
        write_table(&path, &table, &[]).unwrap();
        let bytes = called(fs::read(&path).unwrap(), name);
        file.extend_from_slice(if file.is_empty() {
            &bytes
        } else {
            &bytes[2880..]
        });
    }
    file
}

#[test]
fn tables_of_fits_files_are_found_by_their_columns_or_named() {
    let root = folder();
    let at = |name: &str| root.path().join(name);
    let ldac = [
        ("LDAC_IMHEAD", ["Field", "Header"], false),
        ("LDAC_OBJECTS", ["X_IMAGE", "Y_IMAGE"], true),
    ];
    fs::write(at("ldac.fits"), fits_tables(root.path(), &ldac)).unwrap();
    fs::copy(at("ldac.fits"), at("ldac.cat")).unwrap();
    for name in [
        "ldac.fits",
        "ldac.cat",
        "ldac.fits[2]",
        "ldac.cat[LDAC_OBJECTS]",
        "ldac.fits[ldac_objects]",
    ] {
        let said = gathered(root.path(), name, &[]);
        assert!(
            said.contains("positions from the columns X_IMAGE and Y_IMAGE of table"),
            "{said}"
        );
        gathered(root.path(), name, &["--columns", "X_IMAGE,Y_IMAGE"]);
    }
    gathered(root.path(), "ldac.fits", &["--table", "LDAC_OBJECTS"]);
    gathered(root.path(), "ldac.fits", &["--table", "2"]);
    // A name that has brackets is a name.
    fs::copy(at("ldac.fits"), at("field[1].fits")).unwrap();
    fs::copy(at("ldac.fits"), at("ldac.fits[1]")).unwrap();
    gathered(root.path(), "field[1].fits", &[]);
    gathered(root.path(), "ldac.fits[1]", &[]);
    fs::remove_file(at("ldac.fits[1]")).unwrap();

    let chips = [
        ("LDAC_OBJECTS", ["X_IMAGE", "Y_IMAGE"], false),
        ("LDAC_OBJECTS", ["X_IMAGE", "Y_IMAGE"], true),
    ];
    fs::write(at("chips.fits"), fits_tables(root.path(), &chips)).unwrap();
    gathered(root.path(), "chips.fits", &["--table", "2"]);
    gathered(
        root.path(),
        "chips.fits[2]",
        &["--columns", "X_IMAGE,Y_IMAGE"],
    );
    fs::write(at("plain.txt"), lines("", |_, x, y| format!("{x} {y}"))).unwrap();
    for (name, more, expected) in [
        (
            "chips.fits",
            &[][..],
            "2 tables have positions (found 1 `LDAC_OBJECTS`, 2 `LDAC_OBJECTS`, expected one). Try: --table with a number",
        ),
        (
            "chips.fits",
            &["--table", "LDAC_OBJECTS"],
            "2 tables have positions",
        ),
        (
            "chips.fits",
            &["--columns", "X_IMAGE,Y_IMAGE"],
            "2 tables have these columns (1 `LDAC_OBJECTS`, 2 `LDAC_OBJECTS`); expected one",
        ),
        (
            "ldac.fits",
            &["--table", "OBJECTS"],
            "there is no table `OBJECTS` in this file; tables found: 1 `LDAC_IMHEAD`, 2 `LDAC_OBJECTS`",
        ),
        (
            "ldac.fits[3]",
            &[],
            "there is no table `3` in this file; tables found: 1 `LDAC_IMHEAD`",
        ),
        (
            "ldac.fits[1]",
            &[],
            "(found Field, Header; expected x and y",
        ),
        (
            "ldac.fits",
            &["--columns", "x,y"],
            "there is no column `x`; columns found: X_IMAGE, Y_IMAGE",
        ),
        ("ldac.fits[2]", &["--table", "1"], "two tables are named"),
        (
            "plain.txt",
            &["--table", "1"],
            "the file is no FITS file (found table `1`",
        ),
        ("field.fits", &[], "there is no table in this file"),
    ] {
        let message = refused(root.path(), name, more);
        assert!(message.contains(expected), "{name} {more:?}: {message}");
    }
}

#[test]
fn positions_outside_repeated_or_in_degrees_are_reported() {
    let root = folder();
    let write = |name: &str, content: &str| fs::write(root.path().join(name), content).unwrap();
    write("degrees.csv", "x,y\n150.11,2.2\n150.12,2.21\n150.13,2.19\n");
    write("far.csv", "x,y\n500,400\n500,450\n-90,3\n");
    write(
        "near.csv",
        "x,y\n36.51,12.5\n36.52,12.51\n36.49,12.48\n36.5,12.49\n",
    );
    let message = refused(root.path(), "degrees.csv", &[]);
    let field = root.path().join("field.fits");
    let expected = format!(
        "degrees.csv: all 3 positions are outside the exposure (found (150.11, 2.2) first, expected FITS pixels of {}, 1 to 96 and 1 to 96). Are these degrees (right ascension and declination)? Try: convert them",
        text(&field)
    );
    assert!(message.contains(&expected), "{message}");
    let message = refused(root.path(), "far.csv", &[]);
    assert!(message.contains("all 3 positions are outside"), "{message}");
    assert!(!message.contains("degrees ("), "{message}");
    // Degrees may be those of a few pixels of the exposure.
    let message = refused(root.path(), "near.csv", &[]);
    assert!(
        message.contains("3 of 4 positions are within 0.5 px of an earlier one"),
        "{message}"
    );
    assert!(message.contains("Are these degrees"), "{message}");

    let said = |name: &str, content: &str| {
        write(name, content);
        let _ = fs::remove_dir_all(root.path().join("data"));
        let done = shearq(&borrowed(&arguments(root.path(), name, &[])));
        let said = String::from_utf8(done.stderr).unwrap();
        assert!(done.status.success(), "{said}");
        said
    };
    let most = said("most.csv", "x,y\n36.5,12.5\n136.5,12.5\n36.5,112.5\n");
    assert!(
        most.contains("most.csv: 2 of 3 positions are outside the exposure of 96 × 96 px"),
        "{most}"
    );
    let twice = said(
        "twice.csv",
        "x,y\n36.5,12.5\n84.5,60.5\n36.8,12.6\n12.5,84.5\n84.5,60.5\n",
    );
    assert!(
        twice.contains("2 of 5 positions are within 0.5 px of an earlier one (the first is row 3 at (36.8, 12.6), like row 1)"),
        "{twice}"
    );
    let good = said("good.csv", "x,y\n36.5,12.5\n84.5,60.5\n12.5,84.5\n");
    assert!(
        !good.contains("warning: ") || !good.contains("position"),
        "{good}"
    );
}

#[test]
fn a_mosaic_given_as_a_stamp_is_reported() {
    let root = folder();
    let at = |name: &str| root.path().join(name);
    let (psf, stamps, out) = (at("psf.fits"), at("mosaic.fits"), at("data"));
    let gather = [
        "gather",
        "--psf",
        text(&psf),
        "--stamps",
        text(&stamps),
        "--out",
        text(&out),
    ];
    let image = |width: usize, height: usize| {
        let values: Vec<f32> = (0..width * height).map(|k| (k % 7) as f32 - 3.0).collect();
        fits_image(-32, &[width, height], &[], &floats(&values))
    };
    fs::write(&stamps, image(768, 768)).unwrap();
    let done = shearq(&gather);
    let said = String::from_utf8(done.stderr).unwrap();
    assert!(
        said.contains("mosaic.fits: the only stamp is 768 × 768 px, which looks like a mosaic of stamps or an exposure. Try: --exposure with --positions"),
        "{said}"
    );
    // A mosaic without STAMP in its header is read where the advice puts it.
    let small = Small::new("2");
    let set = small.at("data/set02");
    let (pixels, side) = pixels_of(&set.join("galaxies-001.fits"));
    fs::create_dir_all(small.at("own/set01")).unwrap();
    fs::write(small.at("own/layout.toml"), "stamp = 48\n").unwrap();
    let mosaic = fits_image(-32, &[side, side], &[], &floats(&pixels));
    fs::write(small.at("own/set01/galaxies-001.fits"), mosaic).unwrap();
    fs::copy(set.join("psf-001.fits"), small.at("own/set01/psf-001.fits")).unwrap();
    let (data, measured) = (small.at("own"), small.at("out"));
    let measure = [
        "measure",
        "--submission",
        "48/linear/star",
        "--data",
        text(&data),
    ];
    succeed(&[&measure[..], &["--out", text(&measured)]].concat());
    assert_eq!(small.measured("01", "e1").len(), 64);
    let _ = fs::remove_dir_all(&out);
    fs::write(&stamps, image(768, 480)).unwrap();
    let message = fail(&gather);
    assert!(
        message.contains(
            "the stamp is 768 × 480 pixels; expected a square of at most 1024. Try: --exposure"
        ),
        "{message}"
    );
}

#[test]
fn catalogues_with_a_head_of_sextractor_or_in_a_named_table_are_scored() {
    let root = folder();
    let at = |name: &str| root.path().join(name);
    let data = at("sim");
    let simulate = ["simulate", "--sets", "2", "--images", "1", "--grid", "8"];
    succeed(&[&simulate[..], &["--out", text(&data)]].concat());
    let truth = data.join("set02/truth.csv");
    let rows: Vec<Vec<f64>> = fs::read_to_string(&truth)
        .unwrap()
        .lines()
        .filter(|line| !line.starts_with('#'))
        .skip(1)
        .map(|line| {
            line.split(',')
                .map(|field| field.parse().unwrap())
                .collect()
        })
        .collect();
    let head = "# 1 NUMBER\n# 2 X_IMAGE x [pixel]\n# 3 Y_IMAGE y [pixel]\n# 4 E1\n# 5 E2\n";
    let mut catalogue = String::from(head);
    for (k, row) in rows.iter().enumerate() {
        catalogue += &format!("{k} {} {} {} {}\n", row[0], row[1], row[2], row[3]);
    }
    fs::write(at("sex.cat"), &catalogue).unwrap();
    fs::write(at("bare.cat"), catalogue.replace(head, "")).unwrap();
    let column = |k: usize| rows.iter().map(|row| row[k]).collect::<Vec<f64>>();
    let names = ["X_IMAGE", "Y_IMAGE", "E1", "E2"];
    let columns = (0..4)
        .map(|k| Column::new(names[k].into(), column(k)))
        .collect();
    write_table(&at("t.fits"), &frame(columns).unwrap(), &[]).unwrap();
    let named = called(fs::read(at("t.fits")).unwrap(), "SHAPES");
    fs::write(at("t.fits"), named).unwrap();
    let score = |catalogue: &str, columns: &[&str]| {
        let catalogue = at(catalogue);
        let score = ["score", "--truth", text(&truth), text(&catalogue)];
        shearq(&[&score[..], columns].concat())
    };
    let by_name = ["--columns", "X_IMAGE,Y_IMAGE,E1,E2"];
    for (name, columns) in [
        ("sex.cat", by_name),
        ("bare.cat", ["--columns", "2,3,4,5"]),
        ("t.fits[SHAPES]", by_name),
        ("t.fits[1]", by_name),
    ] {
        let done = score(name, &columns);
        let said = String::from_utf8(done.stderr).unwrap();
        assert!(done.status.success(), "{name}: {said}");
    }
    let said = String::from_utf8(score("sex.cat", &[]).stderr).unwrap();
    assert!(
        said.contains("there is no column `x`; columns found: NUMBER, X_IMAGE"),
        "{said}"
    );
    // Five columns without names are not `x y e1 e2` and another.
    let said = fail(&["score", "--truth", text(&truth), text(&at("bare.cat"))]);
    for words in [
        "bare.cat: 5 columns have no names (found the first row `0, 24.5, 24.5, ",
        "expected 4: x, y, e1, e2). Try: add a first line with the names",
        "`score --columns` (names, or numbers such as 2,3,4,5)",
    ] {
        assert!(said.contains(words), "{said}");
    }
    let said = fail(&[
        "score",
        "--truth",
        text(&at("bare.cat")),
        text(&at("sex.cat")),
    ]);
    assert!(
        said.contains("bare.cat: 5 columns have no names") && said.contains("x, y, g1, g2)"),
        "{said}"
    );
}

#[test]
fn descriptions_of_catalogues_name_a_table() {
    let root = folder();
    let at = |name: &str| root.path().join(name);
    let data = at("sim");
    let simulate = ["simulate", "--sets", "2", "--images", "1", "--grid", "8"];
    succeed(&[&simulate[..], &["--out", text(&data)]].concat());
    let truth = fs::read_to_string(data.join("set02/truth.csv")).unwrap();
    let rows: Vec<Vec<f64>> = truth
        .lines()
        .filter(|line| !line.starts_with(['#', 'x']))
        .map(|line| {
            line.split(',')
                .map(|field| field.parse().unwrap())
                .collect()
        })
        .collect();
    // Two tables with the same columns; the ellipticities of the first are zero.
    let mut file = Vec::new();
    for (name, factor) in [("ZERO", 1e-9), ("SHAPES", 1.0)] {
        let columns = ["x", "y", "e1", "e2"].iter().enumerate().map(|(k, name)| {
            let factor = if k < 2 { 1.0 } else { factor };
            let values: Vec<f64> = rows.iter().map(|row| row[k] * factor).collect();
            Column::new((*name).into(), values)
        });
        let _ = fs::remove_file(at("one.fits"));
        write_table(&at("one.fits"), &frame(columns.collect()).unwrap(), &[]).unwrap();
        let bytes = called(fs::read(at("one.fits")).unwrap(), name);
        let start = if file.is_empty() { 0 } else { 2880 };
        file.extend_from_slice(&bytes[start..]);
    }
    fs::write(at("cat-2-1.fits"), file).unwrap();
    let describe = |table: &str| {
        let keys =
            "name = \"F\"\ncatalogues = \"cat-{set}-{image}.fits\"\nellipticity = \"shear\"\n";
        fs::write(at("f.toml"), format!("{keys}{table}\n")).unwrap();
    };
    let foreign = at("f.toml");
    let score = [
        "score",
        "--data",
        text(&data),
        "--foreign",
        text(&foreign),
        "--format",
        "csv",
    ];
    let scored = |table: &str| {
        describe(table);
        succeed(&score)
    };
    let named = scored("table = \"SHAPES\"");
    assert_eq!(scored("table = 2"), named);
    assert_eq!(scored("table = \"2\""), named);
    assert_ne!(scored("table = 1"), named);
    for (table, expected) in [
        ("", "2 tables have these columns (1 `ZERO`, 2 `SHAPES`)"),
        (
            "table = \"NONE\"",
            "there is no table `NONE` in this file; tables found: 1 `ZERO`, 2 `SHAPES`",
        ),
        ("table = 2.5", "expected the name or the number of a table"),
    ] {
        describe(table);
        let message = fail(&score);
        assert!(message.contains(expected), "{table}: {message}");
    }
}

#[test]
fn names_of_images_continue_over_cards_and_scales_are_numbers() {
    let root = folder();
    let at = |name: &str| root.path().join(name);
    let long = "SCI-".repeat(30);
    let mut file = fits_image(8, &[], &["EXTEND  =                    T"], &[]);
    let first = format!("EXTNAME = '{}&'", &long[..60]);
    let second = format!("CONTINUE  '{}'", &long[60..]);
    let keys = [
        "PCOUNT  =                    0",
        "GCOUNT  =                    1",
        "LONGSTRN= 'OGIP 1.0'",
        &first,
        &second,
    ];
    let mut image = fits_image(-32, &[24, 24], &keys, &floats(&vec![1.0; 576]));
    image[..80].copy_from_slice(format!("{:<80}", "XTENSION= 'IMAGE   '").as_bytes());
    file.extend(image);
    fs::write(at("long.fits"), file).unwrap();
    let (stamps, psf, out) = (at("long.fits"), at("psf.fits"), at("data"));
    let gather = [
        "gather",
        "--psf",
        text(&psf),
        "--stamps",
        text(&stamps),
        "--out",
        text(&out),
    ];
    succeed(&[&gather[..], &["--extension", &long]].concat());
    let _ = fs::remove_dir_all(&out);
    let message = fail(&[&gather[..], &["--extension", &long[..60]]].concat());
    assert!(message.contains(&format!("found `{long}`")), "{message}");

    for (card, expected) in [
        ("BSCALE  =                  NaN", "BSCALE"),
        ("BSCALE  =                'NaN'", "BSCALE"),
        (
            "BSCALE  =                  0.0",
            "the header key BSCALE is 0; expected a finite number (for BSCALE not zero)",
        ),
        ("BSCALE  =                1E999", "BSCALE"),
        ("BZERO   =                  NaN", "BZERO"),
        ("BZERO   =                 -INF", "BZERO"),
    ] {
        let scaled = fits_image(16, &[24, 24], &[card], &[1; 2 * 576]);
        fs::write(&stamps, scaled).unwrap();
        let message = fail(&gather);
        assert!(
            message.contains("long.fits: ") && message.contains(expected),
            "{card}: {message}"
        );
        assert!(!out.join("set01/galaxies-001.fits").exists());
    }
    // The same of a column.
    let x = Column::new("x".into(), vec![36.5, 84.5, 12.5]);
    let y = Column::new("y".into(), vec![12.5, 60.5, 84.5]);
    write_table(&at("t.fits"), &frame(vec![x, y]).unwrap(), &[]).unwrap();
    gathered(root.path(), "t.fits", &[]);
    for card in [
        "TSCAL1  =                  0.0",
        "TSCAL1  =                  NaN",
        "TZERO2  =                 -INF",
    ] {
        let bytes = called(fs::read(at("t.fits")).unwrap(), "T");
        let mut bytes = bytes;
        let mut cards = bytes.chunks_exact_mut(80);
        let place = cards.find(|card| card.starts_with(b"EXTNAME ")).unwrap();
        place.copy_from_slice(format!("{card:<80}").as_bytes());
        fs::write(at("scaled.fits"), bytes).unwrap();
        let message = refused(root.path(), "scaled.fits", &[]);
        assert!(message.contains(&card[..6]), "{card}: {message}");
    }
}
