//! Tables written and read back, and files that are wrong in some way.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use shearq_tables::{
    Column, Table, TableError, parquet_columns, parquet_metadata, read_parquet, write_parquet,
};

/// Every type, a NaN, an infinity, extreme integers, and text beyond ASCII.
fn sample() -> Table {
    let columns = vec![
        (
            "g1".into(),
            Column::F64(vec![0.25, f64::NAN, f64::NEG_INFINITY]),
        ),
        ("size".into(), Column::F32(vec![1.5, -0.0, f32::NAN])),
        ("id".into(), Column::I64(vec![i64::MIN, 0, i64::MAX])),
        ("flag".into(), Column::U32(vec![0, 7, u32::MAX])),
        (
            "name".into(),
            Column::Text(vec![String::new(), "γ₁".into(), "long ".repeat(20)]),
        ),
    ];
    let metadata = [
        ("set", "7"),
        ("branch", "variable"),
        ("note", "σ = 0.05\n\"quoted\""),
    ];
    let metadata = metadata.map(|(key, value)| (key.to_owned(), value.to_owned()));
    Table::new(columns, BTreeMap::from(metadata)).expect("equal lengths")
}

fn encode(table: &Table) -> Vec<u8> {
    let mut bytes = Vec::new();
    write_parquet(&mut bytes, table).expect("writing to memory");
    bytes
}

/// A file of these bytes in `folder`.
fn place(folder: &Path, bytes: &[u8]) -> PathBuf {
    let path = folder.join("table.parquet");
    fs::write(&path, bytes).expect("temporary file");
    path
}

/// Equality under which NaN equals NaN and −0 differs from 0.
fn assert_same(left: &Table, right: &Table) {
    assert_eq!(left.metadata(), right.metadata());
    assert_eq!(left.columns().len(), right.columns().len());
    for ((left_name, left), (right_name, right)) in left.columns().iter().zip(right.columns()) {
        assert_eq!(left_name, right_name);
        match (left, right) {
            (Column::F64(a), Column::F64(b)) => {
                let bits = |values: &[f64]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
                assert_eq!(bits(a), bits(b), "{left_name}");
            }
            (Column::F32(a), Column::F32(b)) => {
                let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
                assert_eq!(bits(a), bits(b), "{left_name}");
            }
            _ => assert_eq!(left, right, "{left_name}"),
        }
    }
}

#[test]
fn every_type_and_the_metadata_survive() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = place(folder.path(), &encode(&sample()));
    assert_same(&read_parquet(&path, None).expect("readable"), &sample());
    assert_eq!(
        &parquet_metadata(&path).expect("readable"),
        sample().metadata()
    );
    assert_eq!(
        parquet_columns(&path).expect("readable"),
        ["g1", "size", "id", "flag", "name"]
    );
}

#[test]
fn wanted_columns_come_in_the_order_asked_for() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = place(folder.path(), &encode(&sample()));
    let table = read_parquet(&path, Some(&["flag", "g1"])).expect("readable");
    let names: Vec<&str> = table
        .columns()
        .iter()
        .map(|(name, _)| name.as_str())
        .collect();
    assert_eq!(names, ["flag", "g1"]);
    assert_eq!(table.column("flag"), sample().column("flag"));
    assert!(
        read_parquet(&path, Some(&[]))
            .expect("readable")
            .columns()
            .is_empty()
    );
}

#[test]
fn many_rows_in_several_row_groups_and_none_at_all() {
    let folder = tempfile::tempdir().expect("temporary folder");
    for rows in [0, 1, 600_000] {
        let numbers = 0..rows;
        let columns = vec![
            (
                "x".into(),
                Column::F64(numbers.clone().map(|i| f64::from(i).sin()).collect()),
            ),
            ("constant".into(), Column::F64(vec![0.1; numbers.len()])),
            (
                "id".into(),
                Column::I64(numbers.clone().map(i64::from).collect()),
            ),
            (
                "kind".into(),
                Column::Text(numbers.map(|i| format!("kind {}", i % 3)).collect()),
            ),
        ];
        let table = Table::new(columns, BTreeMap::new()).expect("equal lengths");
        let path = place(folder.path(), &encode(&table));
        assert_same(&read_parquet(&path, None).expect("readable"), &table);
    }
}

#[test]
fn equal_tables_give_equal_bytes() {
    assert_eq!(encode(&sample()), encode(&sample()));
}

#[test]
fn a_missing_column_is_named_with_the_file_and_the_columns_present() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = place(folder.path(), &encode(&sample()));
    let error = read_parquet(&path, Some(&["g1", "g2"]))
        .expect_err("no g2")
        .to_string();
    assert_eq!(
        error,
        format!(
            "{}: no column `g2`; the file has `g1`, `size`, `id`, `flag`, `name`",
            path.display()
        )
    );
    let error = read_parquet(&path, Some(&["g1", "g1"])).expect_err("g1 twice");
    assert!(matches!(error, TableError::DuplicateColumn { name } if name == "g1"));
}

#[test]
fn tables_that_contradict_themselves_are_refused() {
    let two = Column::I64(vec![1, 2]);
    let three = Column::I64(vec![1, 2, 3]);
    let table = |columns: [(&str, &Column); 2], key: &str| {
        Table::new(
            columns
                .map(|(name, column)| (name.to_owned(), column.clone()))
                .into(),
            BTreeMap::from([(key.to_owned(), String::new())]),
        )
        .map_err(|error| error.to_string())
    };
    assert_eq!(
        table([("a", &two), ("b", &three)], "").unwrap_err(),
        "column `b` has 3 rows; expected 2, as in the first column `a`"
    );
    assert!(
        table([("a", &two), ("a", &two)], "")
            .unwrap_err()
            .contains("`a` is named twice")
    );
    assert!(
        table([("a", &two), ("b", &two)], "ARROW:schema")
            .unwrap_err()
            .contains("reserved")
    );
}

#[test]
fn a_failing_writer_gives_its_error() {
    struct Full;
    impl std::io::Write for Full {
        fn write(&mut self, _: &[u8]) -> std::io::Result<usize> {
            Err(std::io::Error::other("no space left"))
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }
    let error = write_parquet(Full, &sample())
        .expect_err("a full disk")
        .to_string();
    assert!(error.contains("no space left"), "{error}");
}

#[test]
fn files_that_are_no_parquet_are_refused() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let absent = folder.path().join("absent.parquet");
    assert!(matches!(
        read_parquet(&absent, None),
        Err(TableError::Io { .. })
    ));
    assert!(matches!(
        read_parquet(folder.path(), None),
        Err(TableError::Damaged { .. })
    ));
    let pipe = folder.path().join("pipe");
    let made = std::process::Command::new("mkfifo").arg(&pipe).status();
    assert!(made.expect("mkfifo starts").success());
    assert!(matches!(
        read_parquet(&pipe, None),
        Err(TableError::Damaged { .. })
    ));
    for garbage in [
        &b""[..],
        b"PAR1",
        b"PAR1PAR1PAR1PAR1",
        &[0xff; 5000],
        b"id,g1\n1,0.02\n",
    ] {
        let path = place(folder.path(), garbage);
        let error = read_parquet(&path, None).expect_err("garbage").to_string();
        assert!(error.starts_with(&path.display().to_string()), "{error}");
    }
}

#[test]
fn rows_and_texts_that_take_next_to_nothing_in_a_file_are_counted() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let refusal = |column: Column| {
        let table = Table::new(vec![("a".into(), column)], BTreeMap::new()).expect("a table");
        let path = place(folder.path(), &encode(&table));
        read_parquet(&path, None)
            .err()
            .map(|error| error.to_string())
    };
    assert_eq!(refusal(Column::I64(vec![7; 1 << 20])), None);
    let error = refusal(Column::I64(vec![7; 5_000_000])).expect("too many rows");
    assert!(
        error.contains("found 5000000 rows of 1 columns, expected at most"),
        "{error}"
    );
    let error = refusal(Column::Text(vec!["x".repeat(10_000); 100_000])).expect("too much text");
    assert!(
        error.contains("too much text") || error.contains("unpack to"),
        "{error}"
    );
}

#[test]
fn truncated_files_are_refused_at_any_length() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let bytes = encode(&sample());
    for length in 0..bytes.len() {
        let path = place(folder.path(), &bytes[..length]);
        assert!(
            read_parquet(&path, None).is_err(),
            "{length} of {} bytes",
            bytes.len()
        );
    }
}

#[test]
fn a_wrong_byte_anywhere_never_panics() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let bytes = encode(&sample());
    for place_of_damage in 0..bytes.len() {
        for mask in [0x01, 0x80, 0xff] {
            let mut damaged = bytes.clone();
            damaged[place_of_damage] ^= mask;
            // Damaged values and names can still be read; only the return matters.
            let _ = read_parquet(place(folder.path(), &damaged), None);
        }
    }
}

/// `tests/data/types.parquet` was written by pyarrow 26 with its defaults (Snappy, dictionaries):
/// two rows of one column per type, `None` where a value is missing.
#[test]
fn files_of_other_writers_are_converted() {
    let path = "tests/data/types.parquet";
    let names = [
        "i8", "i16", "i32", "u64", "u8", "u16", "flag", "category", "f32", "f64",
    ];
    let table = read_parquet(path, Some(&names)).expect("readable");
    assert_eq!(table.metadata()["written by"], "pyarrow");
    let expected = [
        Column::I64(vec![-128, 127]),
        Column::I64(vec![-300, 4]),
        Column::I64(vec![-70_000, 4]),
        Column::I64(vec![1 << 40, 4]),
        Column::U32(vec![255, 4]),
        Column::U32(vec![65_535, 4]),
        Column::U32(vec![1, 0]),
        Column::Text(vec!["disc".into(), "bulge".into()]),
    ];
    for (name, expected) in names.iter().zip(&expected) {
        assert_eq!(table.column(name), Some(expected), "{name}");
    }
    assert!(matches!(table.column("f32"), Some(Column::F32(v)) if v[0] == 1.5 && v[1].is_nan()));
    assert!(matches!(table.column("f64"), Some(Column::F64(v)) if v[0].is_nan() && v[1] == 2.5));

    let error = |name: &str| {
        read_parquet(path, Some(&[name]))
            .expect_err(name)
            .to_string()
    };
    assert!(error("gap").contains("column `gap` has 1 missing value(s)"));
    assert!(error("beyond").contains("column `beyond`, row 1: found 9223372036854775808"));
    assert!(error("day").contains("column `day` has type Date32"));
}
