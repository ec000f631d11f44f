//! Reading, by cfitsio's own functions: what a header says is checked before it is believed.

use std::collections::BTreeMap;
use std::ffi::{CString, c_char, c_int};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::ptr;

use fitsio::sys;

use super::lock;
use crate::io::error::FileError;
use crate::io::table::{Column, Table};

/// Largest image side accepted, against absurd sizes in damaged headers.
const MAX_SIDE: usize = 200_000;
/// Most rows of a table accepted.
const MAX_ROWS: usize = 200_000_000;
/// Most pixels of a tile of a compressed image, against the same.
const MAX_TILE: f64 = 1e8;
/// Bytes at the start of a file in which the headers of an fpack-compressed image lie.
const HEADERS: usize = 32 * 2880;
/// Bytes of a header card.
const CARD: usize = 80;
/// Most bytes that deflate makes of one.
const MAX_INFLATION: u64 = 1032;

// Numbers of cfitsio's interface, from its fitsio.h.
const READONLY: c_int = 0;
const IMAGE_HDU: c_int = 0;
const KEY_NO_EXIST: c_int = 202;
const VALUE_UNDEFINED: c_int = 204;
const TLOGICAL: c_int = 14;
const TFLOAT: c_int = 42;
/// Type codes of columns that `ffgcvd` reads as one number a row: TBYTE, TSBYTE, TUSHORT, TSHORT,
/// TUINT, TINT, TULONG, TLONG, TFLOAT, TULONGLONG, TLONGLONG, TDOUBLE.
const NUMBERS: [c_int; 12] = [11, 12, 20, 21, 30, 31, 40, 41, 42, 80, 81, 82];

/// An open file, closed under the lock.
struct File {
    raw: *mut sys::fitsfile,
    path: PathBuf,
    /// Most bytes of data that the file can hold.
    room: u64,
}

impl File {
    /// Opens a plain or gzip-compressed FITS file; `what` is expected in it.
    fn open(path: &Path, what: &'static str) -> Result<Self, FileError> {
        let room = room(path, what)?;
        let name = CString::new(path.as_os_str().as_encoded_bytes())
            .map_err(FileError::doing(path, "cannot open the file"))?;
        let (mut raw, mut status) = (ptr::null_mut(), 0);
        let _guard = lock();
        // SAFETY: the name ends in a zero byte, and the pointers are to live variables.
        unsafe { sys::ffdkopn(&mut raw, name.as_ptr(), READONLY, &mut status) };
        if status != 0 || raw.is_null() {
            let message = format!("cannot open the {what}: {}", describe(status));
            return Err(FileError::new(path, message));
        }
        Ok(File {
            raw,
            path: path.to_owned(),
            room,
        })
    }

    /// Runs a cfitsio call; its error is worded as `doing`.
    fn call(
        &self,
        doing: impl FnOnce() -> String,
        call: impl FnOnce(*mut sys::fitsfile, &mut c_int),
    ) -> Result<(), FileError> {
        let mut status = 0;
        {
            let _guard = lock();
            call(self.raw, &mut status);
        }
        if status == 0 {
            return Ok(());
        }
        let message = format!("{}: {}", doing(), describe(status));
        Err(FileError::new(&self.path, message))
    }

    fn fault(&self, message: String) -> FileError {
        FileError::new(&self.path, message)
    }

    /// Goes to an extension, from 2, where there is one.
    fn extension(&self, number: c_int) -> bool {
        let go = |raw, status: &mut c_int| {
            // SAFETY: the file is open, and the pointers are null or to a live variable.
            unsafe { sys::ffmahd(raw, number, ptr::null_mut(), status) };
        };
        self.call(String::new, go).is_ok()
    }

    fn is_image(&self) -> Result<bool, FileError> {
        let mut kind = 0;
        self.call(
            || "cannot tell what the header describes".into(),
            // SAFETY: the file is open, and the pointers are to live variables.
            |raw, status| unsafe {
                sys::ffghdt(raw, &mut kind, status);
            },
        )?;
        Ok(kind == IMAGE_HDU)
    }

    /// Sides of the image here, the first one along x.
    fn sides(&self) -> Result<Vec<i64>, FileError> {
        let doing = || "cannot tell the size of the image".into();
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

    /// Bytes of a pixel of the image here as stored; `None` for a tile-compressed one.
    fn pixel_bytes(&self) -> Result<Option<u64>, FileError> {
        let (mut compressed, mut bits) = (0, 0);
        // SAFETY: the file is open, and the pointers are to live variables.
        self.call(
            || "cannot tell the type of the image".into(),
            |raw, status| unsafe {
                compressed = sys::fits_is_compressed_image(raw, status);
                sys::ffgidt(raw, &mut bits, status);
            },
        )?;
        Ok((compressed == 0).then(|| u64::from(bits.unsigned_abs()) / 8))
    }

    /// First byte of the data here.
    fn data_start(&self) -> Result<u64, FileError> {
        let (mut header, mut start, mut end) = (0, 0, 0);
        // SAFETY: the file is open, and the pointers are to live variables.
        self.call(
            || "cannot tell where the data start".into(),
            |raw, status| unsafe {
                sys::ffghadll(raw, &mut header, &mut start, &mut end, status);
            },
        )?;
        Ok(u64::try_from(start).unwrap_or(0))
    }

    /// Checks that the file can hold `bytes` of data here.
    fn check_room(&self, bytes: u64) -> Result<(), FileError> {
        let wanted = self.data_start()?.saturating_add(bytes);
        if wanted <= self.room {
            return Ok(());
        }
        Err(self.fault(format!(
            "the file is truncated or its header damaged: it can hold {} bytes; expected {wanted}",
            self.room
        )))
    }

    /// A numeric header value, `None` where absent or without a value.
    fn number(&self, key: &str) -> Result<Option<f64>, FileError> {
        let doing = || format!("the header key {key} is not a number");
        let name = CString::new(key).map_err(|_| self.fault(doing()))?;
        let mut value = 0.0;
        let mut present = true;
        // SAFETY: the file is open, the name ends in a zero byte, and a comment is not asked for.
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

    /// Text of a header key, empty where there is none.
    fn text(&self, key: &str) -> String {
        let Ok(name) = CString::new(key) else {
            return String::new();
        };
        // A value has at most 68 characters, FLEN_VALUE with its quotes and zero byte is 71.
        let mut value = [0 as c_char; 81];
        // SAFETY: the file is open, the name ends in a zero byte, and the value has room.
        let found = self.call(String::new, |raw, status| unsafe {
            sys::ffgkys(
                raw,
                name.as_ptr(),
                value.as_mut_ptr(),
                ptr::null_mut(),
                status,
            );
        });
        if found.is_ok() {
            plain(&value)
        } else {
            String::new()
        }
    }
}

impl Drop for File {
    fn drop(&mut self) {
        let mut status = 0;
        let _guard = lock();
        // SAFETY: the file is open and never used again.
        unsafe { sys::ffclos(self.raw, &mut status) };
    }
}

/// The text of a buffer that cfitsio filled.
fn plain(buffer: &[c_char]) -> String {
    let bytes: Vec<u8> = buffer
        .iter()
        .take_while(|c| **c != 0)
        .map(|c| c.to_ne_bytes()[0])
        .collect();
    String::from_utf8_lossy(&bytes).trim().to_owned()
}

/// cfitsio's words for a status, and an empty stack of its messages.
fn describe(status: c_int) -> String {
    // FLEN_STATUS is 31.
    let mut text = [0 as c_char; 81];
    // SAFETY: the buffer is longer than cfitsio's longest text.
    unsafe {
        sys::ffgerr(status, text.as_mut_ptr());
        sys::ffcmsg();
    }
    format!("cfitsio error {status}: {}", plain(&text))
}

/// Most bytes that a file can hold, that is its size, or what a gzip-compressed one can expand to.
fn room(path: &Path, what: &'static str) -> Result<u64, FileError> {
    let cannot = || FileError::doing(path, "cannot open the file");
    let mut file = std::fs::File::open(path).map_err(cannot())?;
    let about = file.metadata().map_err(cannot())?;
    if !about.is_file() {
        return Err(FileError::new(
            path,
            format!("this is not a file; expected a FITS {what}"),
        ));
    }
    let size = about.len();
    let mut start = [0; 6];
    let found = read_up_to(&mut file, &mut start).map_err(cannot())?;
    if found == 0 {
        return Err(FileError::new(
            path,
            format!("the file is empty; expected a FITS {what}"),
        ));
    }
    if start == *b"SIMPLE" {
        check_tiles(&mut file, path)?;
        return Ok(size);
    }
    if !start.starts_with(&[0x1f, 0x8b]) || size < 18 {
        return Err(FileError::new(
            path,
            format!(
                "the file starts with `{}`; expected a FITS {what}, which starts with `SIMPLE`, plain or compressed by gzip or fpack",
                start[..found].escape_ascii()
            ),
        ));
    }
    // The last four bytes of a gzip file are its expanded size modulo 2³². cfitsio expands into
    // memory and trusts them.
    let mut stated = [0; 4];
    file.seek(SeekFrom::End(-4))
        .and_then(|_| file.read_exact(&mut stated))
        .map_err(cannot())?;
    let stated = u64::from(u32::from_le_bytes(stated));
    let most = size.saturating_mul(MAX_INFLATION);
    // What cannot be compressed grows by less than a per mille and the header.
    let least = size - (size / 1000 + 1024).min(size);
    if (least..=most).contains(&stated) {
        return Ok(stated);
    }
    Err(FileError::new(
        path,
        format!(
            "the gzip file is truncated, damaged, or of 4 GiB and more: it says that its {size} bytes expand to {stated}; expected {least} to {most}"
        ),
    ))
}

/// Checks the sizes of the tiles of an fpack-compressed image, by which cfitsio divides and for which
/// it takes memory unasked.
fn check_tiles(file: &mut std::fs::File, path: &Path) -> Result<(), FileError> {
    let mut header = vec![0; HEADERS];
    let found = file
        .rewind()
        .and_then(|()| read_up_to(file, &mut header))
        .map_err(FileError::doing(path, "cannot open the file"))?;
    let (mut pixels, mut rice) = (1.0, false);
    for card in header[..found].chunks_exact(CARD) {
        let text = String::from_utf8_lossy(card);
        let Some((key, value)) = text.split_once('=') else {
            continue;
        };
        let key = key.trim();
        if key == "ZCMPTYPE" {
            rice = value.contains("RICE");
        }
        // The first parameter of Rice compression is the size of a block.
        if !(key.starts_with("ZTILE") || rice && key == "ZVAL1") {
            continue;
        }
        let value = value.split('/').next().unwrap_or_default().trim();
        let size = value.parse::<f64>().unwrap_or(f64::NAN);
        if !(1.0..=MAX_SIDE as f64).contains(&size) {
            let message =
                format!("the header key {key} is {value}; expected 1 to {MAX_SIDE} pixels");
            return Err(FileError::new(path, message));
        }
        if key.starts_with("ZTILE") {
            pixels *= size;
        }
    }
    if pixels > MAX_TILE {
        let message = format!("its tiles have {pixels} pixels; expected at most {MAX_TILE}");
        return Err(FileError::new(path, message));
    }
    Ok(())
}

/// Fills `buffer` as far as the file goes.
fn read_up_to(file: &mut std::fs::File, buffer: &mut [u8]) -> std::io::Result<usize> {
    let mut found = 0;
    while found < buffer.len() {
        match file.read(&mut buffer[found..])? {
            0 => break,
            more => found += more,
        }
    }
    Ok(found)
}

/// An image open for reading.
pub struct ImageReader {
    file: File,
    width: usize,
    height: usize,
    next_row: usize,
}

impl ImageReader {
    /// Opens the first image of a file: the primary one, or that of the first extension where the
    /// primary is empty (as fpack writes it).
    ///
    /// # Errors
    /// Where the file cannot be read or holds no two-dimensional image of sensible size, or not all
    /// of it.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, FileError> {
        let file = File::open(path.as_ref(), "image")?;
        let mut place = "primary";
        if file.sides()?.is_empty() && file.extension(2) {
            place = "first extension";
            if !file.is_image()? {
                return Err(file.fault(format!(
                    "the {place} is a table; expected a two-dimensional image"
                )));
            }
        }
        let sides = file.sides()?;
        let &[x, y] = sides.as_slice() else {
            return Err(file.fault(format!(
                "the {place} image has {} dimensions; expected 2",
                sides.len()
            )));
        };
        let side = |found: i64| {
            usize::try_from(found)
                .ok()
                .filter(|side| (1..=MAX_SIDE).contains(side))
        };
        let (Some(width), Some(height)) = (side(x), side(y)) else {
            return Err(file.fault(format!(
                "the image is {x} × {y} pixels; expected 1 to {MAX_SIDE} a side"
            )));
        };
        if let Some(bytes) = file.pixel_bytes()? {
            file.check_room(width as u64 * height as u64 * bytes)?;
        }
        Ok(ImageReader {
            file,
            width,
            height,
            next_row: 0,
        })
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// A numeric header value, `None` where absent.
    ///
    /// # Errors
    /// Where it is there and not a number.
    pub fn number(&self, key: &str) -> Result<Option<f64>, FileError> {
        self.file.number(key)
    }

    /// The next `rows` rows, or fewer at the end of the image. Pixels that are not finite or, in an
    /// image of integers, have the value of its key BLANK, are NaN.
    ///
    /// # Errors
    /// Where the pixels cannot be read, as in a damaged file.
    pub fn read_rows(&mut self, rows: usize) -> Result<Vec<f32>, FileError> {
        let first = self.next_row;
        let last = (first + rows).min(self.height);
        let mut pixels = vec![0f32; (last - first) * self.width];
        // cfitsio writes to the second unasked.
        let (mut blank, mut some_blank) = (f32::NAN, 0);
        let start = (first * self.width + 1) as i64;
        self.file.call(
            || {
                let height = self.height;
                format!("cannot read rows {} to {last} of {height}", first + 1)
            },
            // SAFETY: the file is open, and there is room for all the pixels asked for.
            |raw, status| unsafe {
                sys::ffgpv(
                    raw,
                    TFLOAT,
                    start,
                    pixels.len() as i64,
                    ptr::from_mut(&mut blank).cast(),
                    pixels.as_mut_ptr().cast(),
                    &mut some_blank,
                    status,
                );
            },
        )?;
        self.next_row = last;
        Ok(pixels)
    }
}

/// A column of a table, by its number from 1.
struct Description {
    number: c_int,
    name: String,
    kind: c_int,
    repeat: i64,
}

/// Columns of the first table of a file: those of `wanted`, or all that are numbers.
///
/// # Errors
/// Where the file cannot be read, holds no table, or lacks a column.
pub fn read_table(path: &Path, wanted: Option<&[&str]>) -> Result<Table, FileError> {
    let file = File::open(path, "table")?;
    let mut number = 1;
    while file.is_image()? {
        number += 1;
        if !file.extension(number) {
            return Err(file.fault("there is no table in this file".into()));
        }
    }
    let rows = table_rows(&file)?;
    let descriptions = describe_columns(&file)?;
    let known = || {
        let names: Vec<&str> = descriptions.iter().map(|d| d.name.as_str()).collect();
        names.join(", ")
    };
    if let Some(missing) = wanted
        .into_iter()
        .flatten()
        .find(|name| !descriptions.iter().any(|d| d.name == **name))
    {
        return Err(file.fault(format!(
            "there is no column `{missing}`; columns found: {}",
            known()
        )));
    }
    let mut columns = Vec::new();
    for description in &descriptions {
        let name = description.name.as_str();
        let number = description.repeat == 1
            && (NUMBERS.contains(&description.kind) || description.kind == TLOGICAL);
        match wanted {
            Some(wanted) if !wanted.contains(&name) => continue,
            None if !number => continue,
            _ => {}
        }
        if !number {
            return Err(file.fault(format!("column `{name}` does not hold one number per row")));
        }
        columns.push((name.to_owned(), read_column(&file, description, rows)?));
    }
    Table::new(columns).map_err(|message| file.fault(message))
}

/// Text values of the header of a file's first extension, of those of `keys` that are there.
///
/// # Errors
/// Where the file cannot be read or has no extension.
pub fn read_table_keys<'a>(
    path: &Path,
    keys: impl Iterator<Item = &'a String>,
) -> Result<BTreeMap<String, String>, FileError> {
    let file = File::open(path, "table")?;
    if !file.extension(2) {
        return Err(file.fault("there is no table in this file".into()));
    }
    let value = |key: &String| (key.clone(), file.text(&key.to_ascii_uppercase()));
    Ok(keys.map(value).filter(|(_, v)| !v.is_empty()).collect())
}

/// Rows of the table here, which the file must be able to hold.
fn table_rows(file: &File) -> Result<usize, FileError> {
    let mut count = 0;
    // SAFETY: the file is open, and the pointers are to live variables.
    file.call(
        || "cannot tell the number of rows".into(),
        |raw, status| unsafe {
            sys::ffgnrwll(raw, &mut count, status);
        },
    )?;
    let rows = usize::try_from(count)
        .ok()
        .filter(|rows| *rows <= MAX_ROWS)
        .ok_or_else(|| {
            file.fault(format!(
                "the table says it has {count} rows; expected at most {MAX_ROWS}"
            ))
        })?;
    let bytes = file.number("NAXIS1")?.unwrap_or(0.0);
    file.check_room((bytes * rows as f64) as u64)?;
    Ok(rows)
}

fn describe_columns(file: &File) -> Result<Vec<Description>, FileError> {
    let mut count = 0;
    // SAFETY: the file is open, and the pointers are to live variables.
    file.call(
        || "cannot tell the number of columns".into(),
        |raw, status| unsafe {
            sys::ffgncl(raw, &mut count, status);
        },
    )?;
    (1..=count)
        .map(|number| {
            let (mut kind, mut repeat, mut width) = (0, 0, 0);
            let name = file.text(&format!("TTYPE{number}"));
            // SAFETY: the file is open, and the pointers are to live variables.
            file.call(
                || format!("cannot tell the type of column {number}"),
                |raw, status| unsafe {
                    sys::ffgtclll(raw, number, &mut kind, &mut repeat, &mut width, status);
                },
            )?;
            Ok(Description {
                number,
                name,
                kind,
                repeat,
            })
        })
        .collect()
}

/// A column as real numbers; missing ones are NaN, true is 1 and false 0.
fn read_column(file: &File, description: &Description, rows: usize) -> Result<Column, FileError> {
    let doing = || format!("cannot read column `{}`", description.name);
    let mut some_missing = 0;
    if description.kind == TLOGICAL {
        // Neither true nor false is missing.
        let missing = 2;
        let mut values = vec![0 as c_char; rows];
        // SAFETY: the file is open, and there is room for all the rows.
        file.call(doing, |raw, status| unsafe {
            sys::ffgcvl(
                raw,
                description.number,
                1,
                1,
                rows as i64,
                missing,
                values.as_mut_ptr(),
                &mut some_missing,
                status,
            );
        })?;
        let real = |value: c_char| {
            if value == missing {
                f64::NAN
            } else {
                f64::from(value)
            }
        };
        return Ok(Column::Real(values.into_iter().map(real).collect()));
    }
    let mut values = vec![0.0; rows];
    // SAFETY: the file is open, and there is room for all the rows.
    file.call(doing, |raw, status| unsafe {
        sys::ffgcvd(
            raw,
            description.number,
            1,
            1,
            rows as i64,
            f64::NAN,
            values.as_mut_ptr(),
            &mut some_missing,
            status,
        );
    })?;
    Ok(Column::Real(values))
}
