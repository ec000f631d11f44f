//! An open FITS file. Values that cfitsio does not check are checked before its functions are called.

use std::ffi::{CStr, CString, c_char, c_int};
use std::path::Path;
use std::ptr;

use fitsio::sys;

use super::cards::Cards;
use super::cfitsio::{lock, plain};
use super::source::Source;
use super::tiling::Tiling;
use crate::error::FileError;

// Numbers of cfitsio's interface, from its fitsio.h.
const READONLY: c_int = 0;
const IMAGE_HDU: c_int = 0;
const KEY_NO_EXIST: c_int = 202;
const VALUE_UNDEFINED: c_int = 204;
// Bytes of a block of a file.
const BLOCK: u64 = 2880;

/// A type of values of columns, with its code in cfitsio's interface.
pub trait ColumnValue: Copy + Default {
    const CODE: c_int;
}

/// Logical values are characters: 1, 0, or the one that stands for missing values.
impl ColumnValue for c_char {
    const CODE: c_int = 14;
}

impl ColumnValue for u8 {
    const CODE: c_int = 11;
}

impl ColumnValue for f64 {
    const CODE: c_int = 82;
}

impl ColumnValue for i64 {
    const CODE: c_int = 81;
}

impl ColumnValue for u64 {
    const CODE: c_int = 80;
}

/// cfitsio's words for a status, followed by the messages on its stack, which this empties. The first message is
/// the closest to the cause.
fn describe(status: c_int) -> String {
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

/// An open file, closed under the lock.
pub struct File {
    raw: *mut sys::fitsfile,
    source: Source,
    /// Bytes of the file when cfitsio opened it.
    seen: u64,
    place: c_int,
    /// How the current image is compressed; `None` for an uncompressed one.
    tiling: Option<Tiling>,
    what: &'static str,
}

impl File {
    /// Opens a plain or gzip-compressed FITS file; `what` is expected in it.
    pub fn open(path: &Path, what: &'static str) -> Result<Self, FileError> {
        let mut source = Source::open(path, what)?;
        Cards::read(&mut source, 0)?;
        let mut file = File {
            raw: ptr::null_mut(),
            source,
            seen: 0,
            place: 1,
            tiling: None,
            what,
        };
        file.reopen()?;
        Ok(file)
    }

    // Opens the file in cfitsio, again if it has grown, and goes to the current header.
    fn reopen(&mut self) -> Result<(), FileError> {
        let name = self.source.name()?;
        self.seen = self.source.size(0)?;
        let mut status = 0;
        let _guard = lock();
        self.close();
        // SAFETY: the name ends in a zero byte, and the pointers are to live variables or null.
        unsafe {
            sys::ffcmsg();
            sys::ffdkopn(&mut self.raw, name.as_ptr(), READONLY, &mut status);
            if self.place > 1 {
                sys::ffmahd(self.raw, self.place, ptr::null_mut(), &mut status);
            }
        }
        if status == 0 && !self.raw.is_null() {
            return Ok(());
        }
        let message = format!("cannot open the {}: {}", self.what, describe(status));
        Err(FileError::new(self.source.path(), message))
    }

    // Closes the file if it is open. The caller has the lock.
    fn close(&mut self) {
        if !self.raw.is_null() {
            let mut status = 0;
            // SAFETY: the file is open. The pointer becomes null, so that it is not used again.
            unsafe { sys::ffclos(self.raw, &mut status) };
            self.raw = ptr::null_mut();
        }
    }

    /// Calls cfitsio. An error message starts with `doing`.
    pub fn call(
        &self,
        doing: impl FnOnce() -> String,
        call: impl FnOnce(*mut sys::fitsfile, &mut c_int),
    ) -> Result<(), FileError> {
        let mut status = 0;
        let _guard = lock();
        // SAFETY: this removes the messages of earlier calls from the stack.
        unsafe { sys::ffcmsg() };
        call(self.raw, &mut status);
        if status == 0 {
            return Ok(());
        }
        Err(self.fault(format!("{}: {}", doing(), describe(status))))
    }

    pub fn fault(&self, message: String) -> FileError {
        FileError::new(self.source.path(), message)
    }

    /// Goes to the next header. Returns whether there is one.
    pub fn next(&mut self) -> Result<bool, FileError> {
        let start = self.extent()?[1];
        let Some(cards) = Cards::read(&mut self.source, start)? else {
            return Ok(false);
        };
        self.tiling = Tiling::of(&cards).map_err(|message| self.fault(message))?;
        self.place += 1;
        if self.source.size(0)? > self.seen {
            self.reopen()?;
        } else {
            self.call(
                || format!("cannot read header {} of the file", self.place),
                // SAFETY: the file is open, and the type of the header is not requested.
                |raw, status| unsafe {
                    sys::ffmahd(raw, self.place, ptr::null_mut(), status);
                },
            )?;
        }
        Ok(true)
    }

    /// Goes to the header of an extension that was reached before; the first is 1.
    pub fn go_to(&mut self, extension: usize) -> Result<(), FileError> {
        self.place = c_int::try_from(extension + 1).unwrap_or(c_int::MAX);
        self.tiling = None;
        self.call(
            || format!("cannot read header {} of the file", self.place),
            // SAFETY: the file is open, and the type of the header is not requested.
            |raw, status| unsafe {
                sys::ffmahd(raw, self.place, ptr::null_mut(), status);
            },
        )
    }

    /// Number of the current extension; 0 for the primary header.
    pub fn number_of_extension(&self) -> usize {
        usize::try_from(self.place - 1).unwrap_or(0)
    }

    pub fn path(&self) -> &Path {
        self.source.path()
    }

    /// Moves the tiling of the current image out; `None` for an uncompressed one.
    pub fn take_tiling(&mut self) -> Result<Option<Tiling>, FileError> {
        let mut compressed = 0;
        // SAFETY: the file is open.
        self.call(
            || "cannot determine the type of the image".into(),
            |raw, status| unsafe { compressed = sys::fits_is_compressed_image(raw, status) },
        )?;
        if (compressed != 0) == self.tiling.is_some() {
            return Ok(self.tiling.take());
        }
        Err(self.fault("the header contradicts itself about a compressed image".into()))
    }

    /// Whether an image is here, and no table.
    pub fn is_image(&self) -> Result<bool, FileError> {
        let mut kind = 0;
        self.call(
            || "cannot determine what the header describes".into(),
            // SAFETY: the file is open, and the pointers are to live variables.
            |raw, status| unsafe {
                sys::ffghdt(raw, &mut kind, status);
            },
        )?;
        Ok(kind == IMAGE_HDU)
    }

    /// Sides of the image here, the first one along x.
    pub fn sides(&self) -> Result<Vec<i64>, FileError> {
        let doing = || "cannot determine the size of the image".into();
        let mut count = 0;
        // SAFETY: the file is open, and the pointers are to live variables.
        self.call(doing, |raw, status| unsafe {
            sys::ffgidm(raw, &mut count, status);
        })?;
        let mut sides = vec![0; usize::try_from(count).unwrap_or(0)];
        // SAFETY: the file is open, and there is room for `count` numbers.
        self.call(doing, |raw, status| unsafe {
            sys::ffgiszll(raw, count, sides.as_mut_ptr(), status);
        })?;
        Ok(sides)
    }

    /// BITPIX of the image here as stored: bits per pixel, negative for floats.
    pub fn bits_per_pixel(&self) -> Result<c_int, FileError> {
        let mut bits = 0;
        // SAFETY: the file is open, and the pointer is to a live variable.
        self.call(
            || "cannot determine the type of the image".into(),
            |raw, status| unsafe {
                sys::ffgidt(raw, &mut bits, status);
            },
        )?;
        Ok(bits)
    }

    /// First byte of the data here, and the first one after them.
    fn extent(&self) -> Result<[u64; 2], FileError> {
        let (mut header, mut start, mut end) = (0, 0, 0);
        // SAFETY: the file is open, and the pointers are to live variables.
        self.call(
            || "cannot determine where the data are".into(),
            |raw, status| unsafe {
                sys::ffghadll(raw, &mut header, &mut start, &mut end, status);
            },
        )?;
        let place = |byte| u64::try_from(byte).ok().filter(|byte| byte % BLOCK == 0);
        match [place(start), place(end)] {
            [Some(start), Some(end)] if start <= end => Ok([start, end]),
            _ => Err(self.fault(format!(
                "the header is damaged: its data are from byte {start} to {end}"
            ))),
        }
    }

    /// Makes sure that the file has the first `bytes` bytes of the data here.
    pub fn need(&mut self, bytes: u64) -> Result<(), FileError> {
        let wanted = self.extent()?[0].saturating_add(bytes);
        self.need_first(wanted)
    }

    /// Makes sure that the file has all data of the current header. The padding of the last block may be absent.
    pub fn need_all(&mut self) -> Result<(), FileError> {
        let [start, end] = self.extent()?;
        self.need_first((end + 1).saturating_sub(BLOCK).max(start))
    }

    /// Makes sure that the file can have the first `bytes` bytes of the data here. A gzip file is unpacked later, when
    /// they are read.
    pub fn expect(&mut self, bytes: u64) -> Result<(), FileError> {
        let wanted = self.extent()?[0].saturating_add(bytes);
        if self.source.is_packed() {
            self.source.allow(wanted)
        } else {
            self.need_first(wanted)
        }
    }

    fn need_first(&mut self, wanted: u64) -> Result<(), FileError> {
        let size = self.source.size(wanted)?;
        if size < wanted {
            return Err(self.fault(format!(
                "the file is truncated or its header damaged: it can hold {size} bytes; expected {wanted}"
            )));
        }
        if size > self.seen {
            self.reopen()?;
        }
        Ok(())
    }

    /// Bytes of the file on disk.
    pub fn disk_size(&self) -> u64 {
        self.source.disk_size()
    }

    /// Makes sure that a gzip file is complete. Call it after the last data are read.
    pub fn check_end(&mut self) -> Result<(), FileError> {
        self.source.check_end()
    }

    /// A numeric header value; `None` if the key is absent or has no value.
    pub fn number(&self, key: &str) -> Result<Option<f64>, FileError> {
        let doing = || format!("the header key {key} is not a number");
        let name = CString::new(key).map_err(|_| self.fault(doing()))?;
        let mut value = 0.0;
        let mut present = true;
        // SAFETY: the file is open, the name ends in a zero byte, and a comment is not requested.
        self.call(doing, |raw, status| unsafe {
            sys::ffgkyd(raw, name.as_ptr(), &mut value, ptr::null_mut(), status);
            if [KEY_NO_EXIST, VALUE_UNDEFINED].contains(status) {
                sys::ffcmsg();
                present = false;
                *status = 0;
            }
        })?;
        Ok(present.then_some(value))
    }

    /// Text of a header key, of all its CONTINUE cards; empty if there is none.
    pub fn text(&self, key: &str) -> String {
        let Ok(name) = CString::new(key) else {
            return String::new();
        };
        let mut value = ptr::null_mut();
        let mut text = String::new();
        // SAFETY: the file is open, and the name ends in a zero byte. The value is a string that cfitsio allocates and
        // that is read and given back before another call.
        let found = self.call(String::new, |raw, status| unsafe {
            sys::ffgkls(raw, name.as_ptr(), &mut value, ptr::null_mut(), status);
            if *status == 0 && !value.is_null() {
                text = CStr::from_ptr(value).to_string_lossy().trim().to_owned();
            }
            if !value.is_null() {
                let mut freed = 0;
                sys::fffree(value.cast(), &mut freed);
            }
        });
        match found {
            Ok(()) => text,
            Err(_) => String::new(),
        }
    }

    /// Type code of a column of the table here, and values in each of its rows.
    pub fn column_type(&self, column: c_int) -> Result<(c_int, i64), FileError> {
        let (mut kind, mut repeat, mut width) = (0, 0, 0);
        // SAFETY: the file is open, and the pointers are to live variables.
        self.call(
            || format!("cannot determine the type of column {column}"),
            |raw, status| unsafe {
                sys::ffgtclll(raw, column, &mut kind, &mut repeat, &mut width, status);
            },
        )?;
        Ok((kind, repeat))
    }

    /// Number of values of the array in a column and a row, from 1.
    pub fn array_length(&self, column: c_int, row: usize) -> Result<i64, FileError> {
        let (mut length, mut place) = (0, 0);
        // SAFETY: the file is open, and the pointers are to live variables.
        self.call(
            || format!("cannot read the place of the pixels of tile {row}"),
            |raw, status| unsafe {
                sys::ffgdesll(raw, column, row as i64, &mut length, &mut place, status);
            },
        )?;
        Ok(length)
    }

    /// The first bytes of the array in a column and a row, from 1.
    pub fn array(&self, column: c_int, row: usize, length: usize) -> Result<Vec<u8>, FileError> {
        let doing = || format!("cannot read the pixels of tile {row}");
        self.values(doing, column, row, length, 0)
    }

    /// As many values of a column as `count`, from the first one of `row`, which is counted from 1. Missing ones are
    /// `missing`; cfitsio does not look for them if this is zero.
    pub fn values<T: ColumnValue>(
        &self,
        doing: impl FnOnce() -> String,
        column: c_int,
        row: usize,
        count: usize,
        mut missing: T,
    ) -> Result<Vec<T>, FileError> {
        let mut values = vec![T::default(); count];
        let mut some_missing = 0;
        // SAFETY: the file is open, there is room for the requested values, and they have the type of the code.
        self.call(doing, |raw, status| unsafe {
            sys::ffgcv(
                raw,
                T::CODE,
                column,
                row as i64,
                1,
                count as i64,
                ptr::from_mut(&mut missing).cast(),
                values.as_mut_ptr().cast(),
                &mut some_missing,
                status,
            );
        })?;
        Ok(values)
    }
}

impl Drop for File {
    fn drop(&mut self) {
        let _guard = lock();
        self.close();
    }
}
