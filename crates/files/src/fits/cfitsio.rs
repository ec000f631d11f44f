//! What every call of cfitsio needs.

use std::ffi::c_char;
use std::sync::{Mutex, MutexGuard, PoisonError};

static CFITSIO: Mutex<()> = Mutex::new(());

/// The lock around every cfitsio call. A panic elsewhere does not damage the state of cfitsio.
pub fn lock() -> MutexGuard<'static, ()> {
    CFITSIO.lock().unwrap_or_else(PoisonError::into_inner)
}

pub fn plain(buffer: &[c_char]) -> String {
    let bytes: Vec<u8> = buffer
        .iter()
        .take_while(|c| **c != 0)
        .map(|c| c.to_ne_bytes()[0])
        .collect();
    String::from_utf8_lossy(&bytes).trim().to_owned()
}
