//! Memory for small files that claim to be large. One test, so that no other allocates at the same time.

use std::fs;
use std::path::Path;

use shearq_files::fits::ImageReader;
use shearq_files::frames::polars::{Column, DataFrame};
use shearq_files::frames::{Metadata, frame};
use shearq_files::parquet;
use shearq_files::table::{MAX_ROWS, read_truth};

/// Bytes in use beyond those before `work`, at most, and what it returns.
fn peak<T>(work: impl FnOnce() -> T) -> (u64, T) {
    let bytes = |key: &str| {
        let status = fs::read_to_string("/proc/self/status").expect("status");
        let line = status.lines().find_map(|line| line.strip_prefix(key));
        let kilobytes = line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok());
        kilobytes.expect("kilobytes") * 1024
    };
    // Resets VmHWM.
    fs::write("/proc/self/clear_refs", "5").expect("clear_refs");
    let before = bytes("VmRSS:");
    let result = work();
    (bytes("VmHWM:").saturating_sub(before), result)
}

fn write(path: &Path, table: &DataFrame) {
    let mut bytes = Vec::new();
    parquet::write(&mut bytes, table, &Metadata::new()).expect("written");
    fs::write(path, bytes).expect("written");
}

/// A truth of `n` × `n` cells without shear, whose positions are `position` of a cell's number along an axis.
fn truth(n: usize, position: impl Fn(usize) -> i64) -> DataFrame {
    let x = (0..n * n).map(|k| position(k % n)).collect::<Vec<_>>();
    let y = (0..n * n).map(|k| position(k / n)).collect::<Vec<_>>();
    let g1 = Column::new("g1".into(), vec![0_i64; n * n]);
    let mut g2 = g1.clone();
    g2.rename("g2".into());
    frame(vec![
        Column::new("x".into(), x),
        Column::new("y".into(), y),
        g1,
        g2,
    ])
    .expect("a frame")
}

#[cfg(target_os = "linux")]
#[test]
fn small_files_do_not_claim_memory() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("image.fits");
    let mut bytes = fs::read("../../tests/data/gzip.fits").expect("image");
    let mut cards = bytes.chunks_exact_mut(80);
    let card = cards
        .find(|card| card.starts_with(b"TFIELDS "))
        .expect("TFIELDS");
    card.copy_from_slice(format!("{:<80}", "TFIELDS =             16000000").as_bytes());
    fs::write(&path, bytes).expect("written");
    let (used, error) = peak(|| ImageReader::open(&path).err().map(|e| e.to_string()));
    // cfitsio needs 160 bytes per column: 2,560 MB. Reading the good file needs less than 1 MB.
    assert!(used < 16 << 20, "{used} bytes");
    let error = error.expect("too many columns");
    assert!(
        error.contains("TFIELDS is 16000000; expected a whole number, 0 to 999"),
        "{error}"
    );

    let path = folder.path().join("truth.parquet");
    write(&path, &truth(4000, |_| 24));
    let size = fs::metadata(&path).expect("file").len();
    assert!(size < 4 << 20, "{size} bytes");
    let (used, error) = peak(|| read_truth(&path, MAX_ROWS).err().map(|e| e.to_string()));
    // One column is 128 MB, and it is copied once if the file has several row groups. Four columns are 512 MB.
    assert!(used < 320 << 20, "{used} bytes");
    let error = error.expect("one position");
    assert!(
        error.contains("column `x` has 1 different values in 16000000 rows; expected 4000 or more"),
        "{error}"
    );

    write(&path, &truth(2100, |cell| cell as i64 * 48 + 24));
    assert_eq!(
        read_truth(&path, MAX_ROWS).expect("read").height(),
        2100 * 2100
    );
}
