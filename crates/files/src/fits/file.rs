//! An open FITS file, plain or compressed by gzip. Values that cfitsio does not check are checked before its functions are
//! called.

use std::collections::BTreeMap;
use std::ffi::{CStr, CString, c_char, c_int};
use std::fs;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::ptr;
use std::sync::{Mutex, MutexGuard, PoisonError};

use fitsio::sys;
use flate2::bufread::MultiGzDecoder;

use crate::open::open;
use crate::{FileError, MAX_SIDE};

// Numbers of cfitsio's interface, from its fitsio.h.
const READONLY: c_int = 0;
const IMAGE_HDU: c_int = 0;
const KEY_NO_EXIST: c_int = 202;
const VALUE_UNDEFINED: c_int = 204;

/// Bytes of a block: headers and data each fill whole ones.
pub const BLOCK: usize = 2880;
/// Bytes of a header card.
pub const CARD: usize = 80;
/// Most columns of a table (FITS standard 4.0, section 7).
pub const MAX_COLUMNS: usize = 999;

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

// Most bytes that a gzip file may unpack to: ten images of the challenge.
const MAX_UNPACKED_BYTES: u64 = 1 << 30;
// Bytes that are unpacked at a time, at least.
const UNPACK_STEP_BYTES: u64 = 1 << 23;
// Checksums of FITS are sums modulo this number, in ones' complement.
const ONES: u64 = u32::MAX as u64;
// Bytes that are summed at a time: they stay in the cache.
const SUM_STEP_BYTES: usize = 1 << 18;

struct Source {
    path: PathBuf,
    file: fs::File,
    /// Bytes in it.
    size: u64,
    /// Bytes on disk.
    disk: u64,
    packed: Option<MultiGzDecoder<BufReader<fs::File>>>,
}

impl Source {
    fn open(path: &Path, content: Content) -> Result<Self, FileError> {
        let cannot = || FileError::doing(path, "cannot open the file");
        let file = open(path).map_err(cannot())?;
        let size = file.metadata().map_err(cannot())?.len();
        let mut source = Source {
            path: path.to_owned(),
            file,
            size,
            disk: size,
            packed: None,
        };
        if source.start()?.starts_with(&[0x1f, 0x8b]) {
            source.file.rewind().map_err(cannot())?;
            let plain = tempfile::tempfile().map_err(FileError::doing(
                path,
                "cannot make a temporary file to unpack to",
            ))?;
            let packed = std::mem::replace(&mut source.file, plain);
            source.packed = Some(MultiGzDecoder::new(BufReader::new(packed)));
            source.size = 0;
        }
        let start = source.start()?;
        if start == *b"SIMPLE" {
            return Ok(source);
        }
        let message = if start.is_empty() {
            format!("the file is empty; expected a FITS {content}")
        } else {
            format!(
                "the file starts with `{}`; expected a FITS {content}, which starts with `SIMPLE`, plain or compressed by gzip or fpack",
                start.escape_ascii()
            )
        };
        Err(FileError::new(path, message))
    }

    fn name(&self) -> Result<CString, FileError> {
        let name = match self.packed {
            None => literal(self.path.as_os_str().as_encoded_bytes()),
            Some(_) => open_file_name(&self.file),
        };
        CString::new(name).map_err(FileError::doing(&self.path, "cannot open the file"))
    }

    /// Refuses a gzip file of more bytes than may be unpacked.
    fn allow(&self, wanted: u64) -> Result<(), FileError> {
        if wanted <= MAX_UNPACKED_BYTES {
            return Ok(());
        }
        let message = format!(
            "its header asks for {wanted} bytes; expected at most {MAX_UNPACKED_BYTES} in a gzip file: unpack it first"
        );
        Err(FileError::new(&self.path, message))
    }

    /// Size of the file; of a gzip file, what was unpacked, until `wanted` bytes or its end.
    fn size(&mut self, wanted: u64) -> Result<u64, FileError> {
        if wanted <= self.size || self.packed.is_none() {
            return Ok(self.size);
        }
        self.allow(wanted)?;
        let Some(packed) = &mut self.packed else {
            return Ok(self.size);
        };
        let more = (wanted - self.size).max(UNPACK_STEP_BYTES);
        self.size += self
            .file
            .seek(SeekFrom::Start(self.size))
            .and_then(|_| std::io::copy(&mut packed.take(more), &mut self.file))
            .map_err(FileError::doing(&self.path, "cannot unpack the gzip file"))?;
        Ok(self.size)
    }

    /// Bytes from `start`: `size`, or fewer at the end of the file.
    fn read_at(&mut self, start: u64, size: usize) -> Result<Vec<u8>, FileError> {
        self.size(start.saturating_add(size as u64))?;
        let mut bytes = Vec::with_capacity(size);
        self.file
            .seek(SeekFrom::Start(start))
            .and_then(|_| (&mut self.file).take(size as u64).read_to_end(&mut bytes))
            .map_err(FileError::doing(&self.path, "cannot read the file"))?;
        Ok(bytes)
    }

    /// Checksum of the 32-bit words from byte `start` to `end`. Bytes that the file lacks are zeros.
    fn sum(&mut self, start: u64, end: u64) -> Result<u64, FileError> {
        let mut sum = 0;
        for at in (start..end).step_by(SUM_STEP_BYTES) {
            let size = SUM_STEP_BYTES.min((end - at) as usize);
            let mut bytes = self.read_at(at, size)?;
            bytes.resize(size, 0);
            let (words, _) = bytes.as_chunks();
            let words = words
                .iter()
                .map(|word| u64::from(u32::from_be_bytes(*word)));
            sum = (sum + words.sum::<u64>()) % ONES;
        }
        Ok(sum)
    }

    fn check_end(&mut self) -> Result<(), FileError> {
        let Some(packed) = &mut self.packed else {
            return Ok(());
        };
        let rest = std::io::copy(&mut packed.take(MAX_UNPACKED_BYTES), &mut std::io::sink())
            .map_err(FileError::doing(&self.path, "cannot unpack the gzip file"))?;
        if rest < MAX_UNPACKED_BYTES {
            return Ok(());
        }
        let message =
            format!("more than {MAX_UNPACKED_BYTES} bytes follow what was read of the gzip file");
        Err(FileError::new(&self.path, message))
    }

    fn start(&mut self) -> Result<Vec<u8>, FileError> {
        self.read_at(0, 6)
    }
}

/// A name of an open file that has none.
fn open_file_name(file: &fs::File) -> Vec<u8> {
    use std::os::fd::AsRawFd;
    format!("/dev/fd/{}", file.as_raw_fd()).into_bytes()
}

// A name that cfitsio does not change. cfitsio replaces a tilde at the start by a home folder.
fn literal(name: &[u8]) -> Vec<u8> {
    let here: &[u8] = if name.starts_with(b"~") { b"./" } else { b"" };
    [here, name].concat()
}

// Most bytes of a header: fifty thousand cards.
const MAX_HEADER_BYTES: u64 = 1 << 22;
// Longest value and comment that cfitsio before 4.2 has room for; later ones cut them.
const LONGEST_VALUE: usize = 70;
const LONGEST_COMMENT: usize = 72;
// Numbers that cfitsio uses unchecked while it opens a header: it allocates and fills 160 bytes per column, has arrays for six
// axes of a compressed image, divides by sides of tiles, and takes ZDITHER0 as an index of ten thousand numbers.
const LIMITS: [(&str, RangeInclusive<f64>); 7] = [
    ("TFIELDS", 0.0..=MAX_COLUMNS as f64),
    ("ZNAXIS", 1.0..=6.0),
    // 64 bits are read as zeros.
    ("ZBITPIX", -64.0..=32.0),
    ("ZTILE1", 1.0..=MAX_SIDE as f64),
    ("ZTILE2", 1.0..=MAX_SIDE as f64),
    ("ZTILE3", 1.0..=MAX_SIDE as f64),
    ("ZDITHER0", 1.0..=10_000.0),
];
// cfitsio's decoders of HCOMPRESS and PLIO write the number of pixels that a tile claims, whatever its size; no survey uses them for
// images of galaxies.
const CODINGS: [&str; 4] = ["RICE_1", "RICE_ONE", "GZIP_1", "GZIP_2"];

/// Checks the header that starts at byte `start` before cfitsio opens it. Returns whether there is one.
fn check_header(source: &mut Source, start: u64, content: Content) -> Result<bool, FileError> {
    let mut at = start;
    // The block of Rice compression. Headers of other codings have zeros there.
    let (mut is_rice, mut block_pixels) = (false, f64::INFINITY);
    loop {
        let block = source.read_at(at, BLOCK)?;
        if block.is_empty() && at == start {
            return Ok(false);
        }
        if block.len() < BLOCK || at - start >= MAX_HEADER_BYTES {
            // Records without a header behind the last one, which the standard tells readers to disregard (section 3.5). A header that is
            // damaged has an END.
            if start > 0 && !source.read_at(start, BLOCK)?.starts_with(b"XTENSION") {
                return Ok(false);
            }
            let read = at - start + block.len() as u64;
            let message = format!(
                "cannot open the file: the header from byte {start} has no END in {read} bytes"
            );
            return Err(FileError::new(&source.path, message));
        }
        for (k, card) in block.chunks_exact(CARD).enumerate() {
            let byte = at + (k * CARD) as u64;
            let fault = |message: String| Err(FileError::new(&source.path, message));
            if card.starts_with(b"END     ") {
                // cfitsio would decode blocks of no pixels for ever.
                if is_rice && block_pixels < 1.0 {
                    return fault(format!(
                        "the header key ZVAL1 is {block_pixels}; expected the number of pixels of a block"
                    ));
                }
                return Ok(true);
            }
            let Some((key, value)) = parse(card) else {
                return fault(format!(
                    "the header card at byte {byte} has a value or a comment that is too long"
                ));
            };
            match key.as_str() {
                // Entries of challenges, which strangers send, are tables: their compressed images never reach cfitsio.
                "ZCMPTYPE" if content == Content::Table => {
                    return fault(format!(
                        "the file has a compressed image (found ZCMPTYPE {value}, expected a FITS table)"
                    ))
                    .map_err(|error| error.hint("funpack"));
                }
                "ZCMPTYPE" if !CODINGS.contains(&value.trim_matches(['\'', ' '])) => {
                    return fault(format!(
                        "the header key ZCMPTYPE is {value}; expected RICE_1, GZIP_1 or GZIP_2"
                    ))
                    .map_err(|error| error.hint("funpack"));
                }
                "ZCMPTYPE" => is_rice |= value.contains("RICE"),
                "ZVAL1" => block_pixels = block_pixels.min(value.parse().unwrap_or(0.0)),
                key => {
                    let limit = LIMITS.iter().find(|(limited, _)| *limited == key);
                    // Some programs write whole numbers with a decimal point.
                    let found = value.parse::<f64>().ok();
                    if let Some((_, range)) = limit
                        && !found.is_some_and(|found| range.contains(&found))
                    {
                        return fault(format!(
                            "the header key {key} is {value}; expected a whole number, {} to {}",
                            range.start(),
                            range.end()
                        ));
                    }
                }
            }
        }
        at += BLOCK as u64;
    }
}

// Name in capitals and value of a card, as cfitsio parses it; `None` if they are too long for its buffers.
// Cards up to the end of a header, and whether it is among these bytes.
fn parse_cards(bytes: &[u8]) -> (BTreeMap<String, String>, bool) {
    let mut cards = bytes.chunks_exact(CARD);
    let is_end = |card: &&[u8]| card.starts_with(b"END     ");
    let before = cards.clone().take_while(|card| !is_end(card));
    (
        before.filter_map(parse).collect(),
        cards.any(|card| is_end(&card)),
    )
}

fn parse(card: &[u8]) -> Option<(String, String)> {
    let mut text = [0 as c_char; CARD + 1];
    for (to, from) in text.iter_mut().zip(card) {
        *to = c_char::from_ne_bytes([*from]);
    }
    // Longer than any text of a card.
    let [mut name, mut value, mut comment] = [[0 as c_char; 2 * CARD + 2]; 3];
    let (mut length, mut status): (c_int, c_int) = (0, 0);
    let _guard = lock();
    // SAFETY: the card ends in a zero byte, and each buffer is longer than a card.
    unsafe {
        sys::ffgknm(
            text.as_mut_ptr(),
            name.as_mut_ptr(),
            &mut length,
            &mut status,
        );
        sys::ffpsvc(
            text.as_mut_ptr(),
            value.as_mut_ptr(),
            comment.as_mut_ptr(),
            &mut status,
        );
        sys::ffcmsg();
    }
    let length = |text: &[c_char]| text.iter().take_while(|c| **c != 0).count();
    let fits = length(&value) <= LONGEST_VALUE && length(&comment) <= LONGEST_COMMENT;
    fits.then(|| (plain(&name).to_ascii_uppercase(), plain(&value)))
}

/// What is read from a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Content {
    Image,
    Table,
}

impl std::fmt::Display for Content {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Content::Image => "image",
            Content::Table => "table",
        })
    }
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
    content: Content,
}

impl File {
    pub fn open(path: &Path, content: Content) -> Result<Self, FileError> {
        let mut source = Source::open(path, content)?;
        check_header(&mut source, 0, content)?;
        let mut file = File {
            raw: ptr::null_mut(),
            source,
            seen: 0,
            place: 1,
            content,
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
        let message = format!("cannot open the {}: {}", self.content, describe(status));
        Err(self.fault(message))
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

    // A value that cfitsio writes to a variable.
    fn find<T: Default>(
        &self,
        what: &str,
        find: impl FnOnce(*mut sys::fitsfile, &mut T, &mut c_int),
    ) -> Result<T, FileError> {
        let mut found = T::default();
        let doing = || format!("cannot determine {what}");
        self.call(doing, |raw, status| find(raw, &mut found, status))?;
        Ok(found)
    }

    pub fn fault(&self, message: String) -> FileError {
        FileError::new(&self.source.path, message)
    }

    /// Goes to the next header. Returns whether there is one.
    pub fn next(&mut self) -> Result<bool, FileError> {
        let [_, _, start] = self.extent()?;
        if !check_header(&mut self.source, start, self.content)? {
            return Ok(false);
        }
        if self.source.size(0)? > self.seen {
            self.place += 1;
            self.reopen()?;
        } else {
            self.go_to(self.number_of_extension() + 1)?;
        }
        Ok(true)
    }

    /// Goes to the header of an extension that was reached before; the first is 1.
    pub fn go_to(&mut self, extension: usize) -> Result<(), FileError> {
        self.place = c_int::try_from(extension + 1).unwrap_or(c_int::MAX);
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
        &self.source.path
    }

    pub fn is_compressed(&self) -> Result<bool, FileError> {
        // SAFETY: the file is open.
        self.find(
            "the type of the image",
            |raw, found: &mut c_int, status| unsafe {
                *found = sys::fits_is_compressed_image(raw, status);
            },
        )
        .map(|found| found != 0)
    }

    /// Whether an image is here, and no table.
    pub fn is_image(&self) -> Result<bool, FileError> {
        // SAFETY: the file is open, and the pointers are to live variables.
        self.find("what the header describes", |raw, found, status| unsafe {
            sys::ffghdt(raw, found, status);
        })
        .map(|found| found == IMAGE_HDU)
    }

    /// Sides of the image here, the first one along x.
    pub fn sides(&self) -> Result<Vec<i64>, FileError> {
        let what = "the size of the image";
        // SAFETY: the file is open, and the pointers are to live variables.
        let count: c_int = self.find(what, |raw, found, status| unsafe {
            sys::ffgidm(raw, found, status);
        })?;
        let length = usize::try_from(count).unwrap_or(0);
        // SAFETY: the file is open, and there is room for `count` numbers.
        self.find(what, |raw, sides: &mut Vec<i64>, status| unsafe {
            sides.resize(length, 0);
            sys::ffgiszll(raw, count, sides.as_mut_ptr(), status);
        })
    }

    /// BITPIX of the image here as stored: bits per pixel, negative for floats.
    pub fn bits_per_pixel(&self) -> Result<c_int, FileError> {
        // SAFETY: the file is open, and the pointer is to a live variable.
        self.find("the type of the image", |raw, found, status| unsafe {
            sys::ffgidt(raw, found, status);
        })
    }

    /// First byte of the header and of the data here, and the first one after them.
    fn extent(&self) -> Result<[u64; 3], FileError> {
        // SAFETY: the file is open, and the pointers are to live variables.
        let [header, start, end] = self.find(
            "where the data are",
            |raw, found: &mut [i64; 3], status| unsafe {
                let [header, start, end] = found;
                sys::ffghadll(raw, header, start, end, status);
            },
        )?;
        let place = |byte| {
            u64::try_from(byte)
                .ok()
                .filter(|byte| byte % BLOCK as u64 == 0)
        };
        match [header, start, end].map(place) {
            [Some(header), Some(start), Some(end)] if start <= end => Ok([header, start, end]),
            _ => Err(self.fault(format!(
                "the header is damaged: its data are from byte {start} to {end}"
            ))),
        }
    }

    /// Makes sure that the file has the first `bytes` bytes of the data here.
    pub fn need(&mut self, bytes: u64) -> Result<(), FileError> {
        let wanted = self.extent()?[1].saturating_add(bytes);
        self.need_first(wanted)
    }

    /// Makes sure that the file has all data of the current header. The padding of the last block may be absent.
    pub fn need_all(&mut self) -> Result<(), FileError> {
        let [_, start, end] = self.extent()?;
        self.need_first((end + 1).saturating_sub(BLOCK as u64).max(start))
    }

    /// Reads data of the current header, from their byte `first` on. They have to be there ([`File::need`]).
    pub fn read_data(&mut self, first: u64, bytes: &mut [u8]) -> Result<(), FileError> {
        let start = self.extent()?[1] + first;
        let file = &mut self.source.file;
        file.seek(SeekFrom::Start(start))
            .and_then(|_| file.read_exact(bytes))
            .map_err(FileError::doing(self.path(), "cannot read the file"))
    }

    /// Makes sure that the file can have the first `bytes` bytes of the data here. A gzip file is unpacked later, when
    /// they are read.
    pub fn expect(&mut self, bytes: u64) -> Result<(), FileError> {
        let wanted = self.extent()?[1].saturating_add(bytes);
        if self.source.packed.is_some() {
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

    /// Refuses a compressed image that differs from the checksums in its header (FITS standard 4.0, appendix J).
    // Those of plain images are often stale, because `writeto` of astropy keeps them when it writes other pixels; it leaves them
    // out of compressed images, and fpack computes them.
    pub fn check_sums(&mut self) -> Result<(), FileError> {
        let [datasum, checksum] = ["DATASUM", "CHECKSUM"].map(|key| self.text(key));
        if datasum.is_empty() && checksum.is_empty() {
            return Ok(());
        }
        let [header, start, end] = self.extent()?;
        let data = self.source.sum(start, end)?;
        if !datasum.is_empty() && datasum.parse().ok().map(|sum: u64| sum % ONES) != Some(data) {
            return Err(self.wrong_sum("DATASUM", data, &datasum));
        }
        // CHECKSUM makes the sum of all zero.
        let all = (self.source.sum(header, start)? + data) % ONES;
        if !checksum.is_empty() && all != 0 {
            return Err(self.wrong_sum("CHECKSUM", all, "0"));
        }
        Ok(())
    }

    /// Whether data differ from the DATASUM of their header, if it states one.
    pub fn differs_from_datasum(&mut self) -> Result<bool, FileError> {
        let stated = self.text("DATASUM");
        if stated.is_empty() {
            return Ok(false);
        }
        let [_, start, end] = self.extent()?;
        let stated = stated.parse().ok().map(|sum: u64| sum % ONES);
        Ok(stated != Some(self.source.sum(start, end)?))
    }

    fn wrong_sum(&self, key: &str, found: u64, expected: &str) -> FileError {
        let message = format!(
            "the image of extension {} differs from its checksum {key} (found the sum {found}, expected {expected}): it is damaged, or a program changed it and kept the key",
            self.number_of_extension()
        );
        self.fault(message).hint(format!(
            "another copy; or, if its pixels are right, fitscheck --write --force {}",
            self.path().display()
        ))
    }

    /// Bytes of the file on disk.
    pub fn disk_size(&self) -> u64 {
        self.source.disk
    }

    /// Makes sure that a gzip file is complete. Call it after the last data are read.
    pub fn check_end(&mut self) -> Result<(), FileError> {
        self.source.check_end()
    }

    /// Keys and values of the header here. Texts keep their quotes; of keys that repeat, the last one counts.
    pub fn cards(&mut self) -> Result<BTreeMap<String, String>, FileError> {
        let [header, start, _] = self.extent()?;
        let bytes = self.source.read_at(header, (start - header) as usize)?;
        Ok(parse_cards(&bytes).0)
    }

    /// The cards, and those of the primary header that an extension with INHERIT lacks, such as a WCS.
    pub fn cards_with_inherited(&mut self) -> Result<BTreeMap<String, String>, FileError> {
        let mut found = self.cards()?;
        let [header, ..] = self.extent()?;
        if found.get("INHERIT").is_none_or(|value| value != "T") {
            return Ok(found);
        }
        for block in (0..header).step_by(BLOCK) {
            let (cards, ended) = parse_cards(&self.source.read_at(block, BLOCK)?);
            for (key, value) in cards {
                found.entry(key).or_insert(value);
            }
            if ended {
                break;
            }
        }
        Ok(found)
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

    /// Text of a header key with all its CONTINUE cards; empty if the key is absent.
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

    /// Rows of the table here.
    pub fn rows(&self) -> Result<i64, FileError> {
        // SAFETY: the file is open, and the pointers are to live variables.
        self.find("the number of rows", |raw, found, status| unsafe {
            sys::ffgnrwll(raw, found, status);
        })
    }

    /// Columns of the table here.
    pub fn columns(&self) -> Result<c_int, FileError> {
        // SAFETY: the file is open, and the pointers are to live variables.
        self.find("the number of columns", |raw, found, status| unsafe {
            sys::ffgncl(raw, found, status);
        })
    }

    /// Type code of a column of the table here, and values in each of its rows.
    pub fn column_type(&self, column: c_int) -> Result<(c_int, i64), FileError> {
        let what = format!("the type of column {column}");
        // SAFETY: the file is open, and the pointers are to live variables.
        self.find(&what, |raw, (kind, repeat), status| unsafe {
            let mut width = 0;
            sys::ffgtclll(raw, column, kind, repeat, &mut width, status);
        })
    }

    /// `count` values of a column, from the first one of `row`, which is counted from 1. Missing ones are
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
