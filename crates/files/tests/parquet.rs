//! Tables written and read back, and files that are wrong in some way.

use std::fs;
use std::path::Path;

use shearq_files::FileError;
use shearq_files::frames::polars::{AnyValue, Column, DataFrame, df};
use shearq_files::frames::{Metadata, frame, reals};
use shearq_files::parquet::{self, columns};
use shearq_files::table::{self, Place};

/// More rows than any of the files has.
const MAX_ROWS: usize = 10_000_000;

/// Every type, a NaN, an infinity, extreme integers, and text beyond ASCII.
fn sample() -> DataFrame {
    df!(
        "g1" => [0.25, f64::NAN, f64::NEG_INFINITY],
        "size" => [1.5_f32, -0.0, f32::NAN],
        "id" => [i64::MIN, 0, i64::MAX],
        "flag" => [0, 7, u32::MAX],
        "name" => ["", "γ₁", "long long long long long long long long long"],
    )
    .expect("equal lengths")
}

fn metadata() -> Metadata {
    [
        ("set", "7"),
        ("branch", "variable"),
        ("note", "σ = 0.05\n\"quoted\""),
    ]
    .map(|(key, value)| (key.to_owned(), value.to_owned()))
    .into()
}

fn encode(frame: &DataFrame) -> Vec<u8> {
    parquet::encode(frame, &metadata()).expect("writing to memory")
}

/// Writes a file of these bytes, and gives what `read` makes of it, with the path as the message has it.
fn reading<T>(bytes: &[u8], read: impl FnOnce(&Path) -> Result<T, FileError>) -> Result<T, String> {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("table.parquet");
    fs::write(&path, bytes).expect("temporary file");
    let name = path.display().to_string();
    read(&path).map_err(|error| error.to_string().replace(&name, "FILE"))
}

fn read(bytes: &[u8], wanted: Option<&[&str]>, most: usize) -> Result<DataFrame, String> {
    reading(bytes, |path| parquet::read(path, wanted, most))
}

/// Equality under which NaN equals NaN and −0 differs from 0.
fn assert_same(left: &DataFrame, right: &DataFrame) {
    assert_eq!(left.schema(), right.schema());
    for (left, right) in left.columns().iter().zip(right.columns()) {
        let bits = |column: &Column| {
            let values = column.as_materialized_series().iter();
            values
                .map(|value| match value {
                    AnyValue::Float64(value) => value.to_bits().to_string(),
                    AnyValue::Float32(value) => value.to_bits().to_string(),
                    value => value.to_string(),
                })
                .collect::<Vec<_>>()
        };
        assert_eq!(bits(left), bits(right), "{}", left.name());
    }
}

#[test]
fn every_type_and_the_metadata_survive() {
    let bytes = encode(&sample());
    assert_same(&read(&bytes, None, MAX_ROWS).unwrap(), &sample());
    assert_eq!(
        reading(&bytes, |path| parquet::metadata(path)),
        Ok(metadata())
    );
    let names = ["g1", "size", "id", "flag", "name"].map(str::to_owned);
    assert_eq!(reading(&bytes, |path| columns(path)), Ok(names.into()));
    // In the order asked for.
    let table = read(&bytes, Some(&["flag", "g1"]), MAX_ROWS).unwrap();
    assert_eq!(table.get_column_names(), ["flag", "g1"]);
    assert_eq!(table.column("flag").ok(), sample().column("flag").ok());
    assert_eq!(read(&bytes, Some(&[]), MAX_ROWS).unwrap().width(), 0);
}

#[test]
fn many_rows_in_several_row_groups_and_none_at_all() {
    for rows in [0, 1, 600_000] {
        let numbers = 0..rows;
        let sines: Vec<f64> = numbers.clone().map(|i| f64::from(i).sin()).collect();
        let ids: Vec<i64> = numbers.clone().map(i64::from).collect();
        let kinds: Vec<String> = numbers.clone().map(|i| format!("kind {}", i % 3)).collect();
        let constant = vec![0.1; numbers.len()];
        let table =
            df!("x" => sines, "constant" => constant, "id" => ids, "kind" => kinds).unwrap();
        assert_same(&read(&encode(&table), None, MAX_ROWS).unwrap(), &table);
    }
}

#[test]
fn equal_tables_give_equal_bytes() {
    assert_eq!(encode(&sample()), encode(&sample()));
}

#[test]
fn missing_columns_are_named_with_file_and_columns_present() {
    let error = |wanted: &[&str]| read(&encode(&sample()), Some(wanted), MAX_ROWS).unwrap_err();
    assert_eq!(
        error(&["g1", "g2"]),
        "FILE: there is no column `g2`; columns found: g1, size, id, flag, name"
    );
    assert!(error(&["g1", "g1"]).contains("`g1` is named twice"));
}

#[test]
fn frames_that_contradict_themselves_are_refused() {
    let column = |name: &str, values: &[i64]| Column::new(name.into(), values);
    let refused = |columns: [Column; 2]| frame(columns.into()).unwrap_err().to_string();
    let uneven = refused([column("a", &[1, 2]), column("b", &[1, 2, 3])]);
    assert!(uneven.contains('3') && uneven.contains('b'), "{uneven}");
    let twice = refused([column("a", &[1, 2]), column("a", &[1, 2])]);
    assert!(twice.contains("'a'"), "{twice}");
    let reserved = Metadata::from([("ARROW:schema".to_owned(), String::new())]);
    let error = parquet::encode(&sample(), &reserved).unwrap_err();
    assert!(error.to_string().contains("reserved"));
}

#[test]
fn files_that_are_no_parquet_are_refused() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let pipe = folder.path().join("pipe");
    let made = std::process::Command::new("mkfifo").arg(&pipe).status();
    assert!(made.expect("mkfifo starts").success());
    for other in [&folder.path().join("absent.parquet"), folder.path(), &pipe] {
        let error = parquet::read(other, None, MAX_ROWS).expect_err("no file");
        assert!(error.text().contains("cannot read the file"), "{error}");
    }
    let whole = encode(&sample());
    let garbage = [&[0xff; 5000][..], b"PAR1PAR1PAR1PAR1", b"id,g1\n1,0.02\n"];
    for bytes in (0..whole.len())
        .map(|length| &whole[..length])
        .chain(garbage)
    {
        let error = read(bytes, None, MAX_ROWS).unwrap_err();
        assert!(error.starts_with("FILE"), "{} bytes: {error}", bytes.len());
    }
}

#[test]
fn small_files_have_as_many_rows_as_the_caller_expects() {
    // As a truth file of 2100 × 2100 cells without shear: fewer bytes than values.
    let rows = 2100 * 2100;
    let bytes = encode(&df!("g1" => vec![0_i64; rows], "g2" => vec![0_i64; rows]).unwrap());
    assert!(bytes.len() < 2 * rows);
    for wanted in [&["g1"][..], &["g1", "g2"]] {
        assert_eq!(read(&bytes, Some(wanted), rows).unwrap().height(), rows);
        let error = read(&bytes, Some(wanted), 1_600).unwrap_err();
        assert_eq!(error, "FILE: found 4410000 rows, expected at most 1600");
    }
}

#[test]
fn a_wrong_bit_anywhere_is_noticed_or_changes_nothing() {
    let bytes = encode(&sample());
    for at in 0..bytes.len() {
        let mut damaged = bytes.clone();
        damaged[at] ^= 1 << (at % 8);
        // The first bytes and the mark of the checksums are not compared.
        if let Ok(found) = read(&damaged, None, MAX_ROWS) {
            assert_same(&found, &sample());
            let found = reading(&damaged, |path| parquet::metadata(path));
            assert_eq!(found.unwrap(), metadata());
        }
    }
}

/// `tests/data/bytes.parquet` was written by pyarrow 26: the columns `step` and `blob` have the type binary, as astropy writes its
/// texts of bytes, and only the first is text.
#[test]
fn columns_of_bytes_are_read_as_text() {
    let path = Path::new("tests/data/bytes.parquet");
    let table = parquet::read(path, Some(&["step", "e1"]), MAX_ROWS).expect("readable");
    let steps = table.column("step").expect("a column").str();
    let expected = ["noshear", "1p", "noshear"].map(Some);
    assert!(steps.expect("text").iter().eq(expected));
    let texts = table::first_texts(&Place::of(path)).expect("readable");
    assert_eq!(texts, [("step".to_owned(), "noshear".to_owned())]);
    assert!(parquet::read(path, Some(&["blob"]), MAX_ROWS).is_err());
}

/// `tests/data/types.parquet` was written by pyarrow 26 with its defaults (Snappy, dictionaries):
/// two rows of one column per type, `None` where a value is missing.
#[test]
fn files_of_other_writers_are_converted() {
    let path = "tests/data/types.parquet";
    let names = [
        "i8", "i16", "i32", "u64", "u8", "u16", "flag", "category", "f32", "f64",
    ];
    let table = parquet::read(path, Some(&names), MAX_ROWS).expect("readable");
    let metadata = parquet::metadata(path).expect("readable");
    assert_eq!(metadata["written by"], "pyarrow");
    let expected = [
        [-128.0, 127.0],
        [-300.0, 4.0],
        [-70_000.0, 4.0],
        [(1_u64 << 40) as f64, 4.0],
        [255.0, 4.0],
        [65_535.0, 4.0],
        [1.0, 0.0],
    ];
    let column = |name: &str| table.column(name).expect("a column");
    for (name, expected) in names.iter().zip(&expected) {
        let found = reals(column(name)).expect("numbers");
        assert_eq!(&*found, expected, "{name}");
    }
    let words = column("category").str().expect("text");
    assert!(words.iter().eq([Some("disc"), Some("bulge")]) && reals(column("category")).is_none());
    let (single, double) = (column("f32"), column("f64"));
    // Not a number, and no gap.
    assert_eq!(single.null_count() + double.null_count(), 0);
    let (single, double) = (reals(single).unwrap(), reals(double).unwrap());
    assert!(single[0] == 1.5 && single[1].is_nan() && double[0].is_nan() && double[1] == 2.5);
    let beyond = parquet::read(path, Some(&["beyond"]), MAX_ROWS).expect("readable");
    let beyond = reals(beyond.column("beyond").expect("it")).expect("numbers");
    assert_eq!(beyond[1], 9_223_372_036_854_775_808.0);

    let gap = parquet::read(path, Some(&["gap"]), MAX_ROWS).expect("readable");
    let gap = reals(gap.column("gap").expect("it")).expect("numbers");
    assert_eq!(gap.iter().filter(|own| own.is_nan()).count(), 1);
    let error = parquet::read(path, Some(&["day"]), MAX_ROWS).expect_err("day");
    assert!(
        error.to_string().contains("column `day` has type Date32"),
        "{error}"
    );
}
