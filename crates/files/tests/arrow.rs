//! Arrow files of pyarrow 26, whole and damaged: the columns of `types.parquet`, vectors and text, in two record batches of one
//! row.

use std::fs;
use std::path::Path;

use shearq_files::frames::polars::DataFrame;
use shearq_files::frames::reals;
use shearq_files::table::{self, Place};
use shearq_files::{FileError, panic_is_caught};

const FILES: [&str; 3] = [
    "tests/data/plain.arrow",
    "tests/data/lz4.feather",
    "tests/data/zstd.arrow",
];
const NUMBERS: [&str; 13] = [
    "f64", "i8", "i16", "i32", "u64", "u8", "u16", "flag", "f32", "e[1]", "g[0]", "e[0]", "beyond",
];

fn read(path: impl AsRef<Path>) -> Result<DataFrame, FileError> {
    table::read(path.as_ref(), Some(&NUMBERS), 10)
}

#[test]
fn columns_become_what_they_become_in_parquet() {
    for path in FILES {
        let table = read(path).unwrap();
        let expected = [
            [f64::NAN, 2.5],
            [-128.0, 127.0],
            [-300.0, 4.0],
            [-70_000.0, 4.0],
            [(1_u64 << 40) as f64, 4.0],
            [255.0, 4.0],
            [65_535.0, 4.0],
            [1.0, 0.0],
            [1.5, f64::NAN],
            [-0.5, f64::NAN],
            [f64::from(0.02_f32), f64::NAN],
            [0.25, 0.125],
            [4.0, 9_223_372_036_854_775_808.0],
        ];
        for ((column, name), expected) in table.columns().iter().zip(NUMBERS).zip(expected) {
            assert_eq!((column.name().as_str(), column.null_count()), (name, 0));
            let found = reals(column).unwrap();
            let same = |(a, b): (&f64, f64)| *a == b || a.is_nan() && b.is_nan();
            let all = found.iter().zip(expected).all(same);
            assert!(all, "{path} {name}: {found:?}");
        }
        let mut parts = Vec::new();
        let wanted = ["category", "i8"];
        table::read_parts(&Place::of(path.as_ref()), &wanted, &[], |part| {
            let word = part.column("category").unwrap().str().unwrap().get(0);
            parts.push((word.map(str::to_owned), part.height()));
            Ok(())
        })
        .unwrap();
        assert_eq!(parts, ["disc", "bulge"].map(|word| (Some(word.into()), 1)));
        let texts = table::first_texts(&Place::of(path.as_ref())).unwrap();
        let expected = [("category", "disc"), ("name", "γ")];
        assert_eq!(
            texts,
            expected.map(|(name, text)| (name.into(), text.into()))
        );
        let stated = table::stated(path.as_ref(), "written by").unwrap();
        assert_eq!(stated.as_deref(), Some("pyarrow"));
        let names = table::columns(&Place::of(path.as_ref())).unwrap();
        assert!(names.named[0].names.contains(&"g[1]".to_owned()));
    }
}

#[test]
fn columns_of_other_types_are_refused_if_they_are_wanted() {
    for (name, words) in [
        ("day", "column `day` has type Date32"),
        ("nested", "column `nested` has type Struct"),
        ("name", "column `name` has 1 missing value(s)"),
        ("category", "column `category` holds text"),
        ("absent", "there is no column `absent`"),
    ] {
        let error = table::read(FILES[0].as_ref(), Some(&[name]), 10).unwrap_err();
        assert!(error.to_string().contains(words), "{error}");
    }
    let error = table::read(FILES[1].as_ref(), Some(&["i8"]), 1).unwrap_err();
    assert!(
        error
            .to_string()
            .ends_with("found 2 rows, expected at most 1")
    );
}

#[test]
fn damaged_files_give_one_error_and_no_panic() {
    let printing = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        if !panic_is_caught() {
            printing(panic);
        }
    }));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("table.feather");
    for file in FILES {
        let whole = fs::read(file).unwrap();
        // As many bytes as the signature has.
        for length in (6..whole.len()).step_by(3) {
            fs::write(&path, &whole[..length]).unwrap();
            let error = read(&path).unwrap_err().to_string();
            assert!(
                error.contains("not a readable Arrow file"),
                "{length}: {error}"
            );
        }
        for at in (6..whole.len()).step_by(3) {
            let mut damaged = whole.clone();
            damaged[at] ^= [0x01, 0x80, 0xff][at % 4 % 3];
            fs::write(&path, &damaged).unwrap();
            // The file has no checksums, so that a number may be another one.
            let found = read(&path);
            assert!(found.is_err() || found.unwrap().height() <= 2);
            _ = table::first_texts(&Place::of(&path));
            assert!(!panic_is_caught());
        }
    }
}
