//! What every call of cfitsio needs: the lock, and its texts.

use std::ffi::{c_char, c_int};
use std::sync::{Mutex, MutexGuard, PoisonError};

use fitsio::sys;

static CFITSIO: Mutex<()> = Mutex::new(());

/// The lock around every cfitsio call. A panic elsewhere does not damage the state of cfitsio.
pub fn lock() -> MutexGuard<'static, ()> {
    CFITSIO.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The text of a buffer that cfitsio filled.
pub fn plain(buffer: &[c_char]) -> String {
    let bytes: Vec<u8> = buffer
        .iter()
        .take_while(|c| **c != 0)
        .map(|c| c.to_ne_bytes()[0])
        .collect();
    String::from_utf8_lossy(&bytes).trim().to_owned()
}

/// cfitsio's words for a status, followed by the messages on its stack, which this empties. The first message is
/// the closest to the cause.
pub fn describe(status: c_int) -> String {
    // FLEN_STATUS is 31, FLEN_ERRMSG 81.
    let mut text = [0 as c_char; 81];
    // SAFETY: the buffer has room for cfitsio's longest text.
    unsafe { sys::ffgerr(status, text.as_mut_ptr()) };
    let mut words = format!("cfitsio error {status}: {}", plain(&text));
    // SAFETY: as above.
    while unsafe { sys::ffgmsg(text.as_mut_ptr()) } != 0 {
        let message = plain(&text).replace(char::is_control, " ");
        words.push_str(&format!("; {message}"));
    }
    words
}
