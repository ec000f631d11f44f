//! Memory for small files that claim to be large. One test, so that no other allocates at the same time.

use std::fs;

use shearq_files::fits::ImageReader;

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
}
