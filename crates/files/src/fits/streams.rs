//! Whether the bytes of a compressed tile can be unpacked.
//!
//! cfitsio's decoders do not check their input: they read beyond its end, and some write as many pixels as it claims.
//! Each tile is therefore checked here before cfitsio decodes it.

use std::io::Read;

use flate2::bufread::GzDecoder;

/// How tiles are compressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coding {
    /// RICE_1.
    Rice {
        /// Pixels of a block.
        block: usize,
        /// Bytes of a pixel: 1, 2 or 4.
        bytes: usize,
    },
    /// GZIP_1 or GZIP_2.
    Gzip,
    /// PLIO_1.
    Plio,
    /// HCOMPRESS_1.
    Hcompress,
}

/// The input ends before the tile does, or contradicts itself.
#[derive(Debug, PartialEq, Eq)]
pub struct Damaged;

/// Bits from the first of a byte to its last.
struct Bits<'a> {
    bytes: &'a [u8],
    next: usize,
}

impl Bits<'_> {
    /// Least number of valid bits in [`Bits::window`].
    const SEEN: u32 = 57;

    /// The next bits, followed by zeros.
    fn window(&self) -> u64 {
        let rest = self.bytes.get(self.next / 8..).unwrap_or_default();
        let eight = rest.first_chunk().copied().unwrap_or_else(|| {
            let mut padded = [0; 8];
            padded[..rest.len()].copy_from_slice(rest);
            padded
        });
        u64::from_be_bytes(eight) << (self.next % 8)
    }

    /// The next bits, 1 to 8, as a number.
    fn take(&mut self, count: usize) -> Result<usize, Damaged> {
        let value = self.window() >> (64 - count);
        self.skip(count)?;
        Ok(value as usize)
    }

    /// Skips bits, which must all be there.
    fn skip(&mut self, count: usize) -> Result<(), Damaged> {
        self.next = self.next.saturating_add(count);
        if self.next <= self.bytes.len() * 8 {
            Ok(())
        } else {
            Err(Damaged)
        }
    }

    /// Skips zeros and the one after them.
    fn skip_zeros(&mut self) -> Result<(), Damaged> {
        loop {
            let zeros = self.window().leading_zeros();
            if zeros < Self::SEEN {
                return self.skip(zeros as usize + 1);
            }
            self.skip(Self::SEEN as usize)?;
        }
    }
}

/// Checks a tile of `pixels` pixels compressed by RICE_1.
pub fn check_rice(
    bytes: &[u8],
    pixels: usize,
    block: usize,
    pixel_bytes: usize,
) -> Result<(), Damaged> {
    // Bits of a block's header, and its value for a block whose differences are stored in full.
    let (width, all) = match pixel_bytes {
        1 => (3, 6),
        2 => (4, 14),
        _ => (5, 25),
    };
    let mut bits = Bits { bytes, next: 0 };
    bits.skip(8 * pixel_bytes)?;
    let mut left = pixels;
    while left > 0 {
        let here = left.min(block);
        match bits.take(width)?.checked_sub(1) {
            None => {}
            Some(low) if low == all => bits.skip(8 * pixel_bytes * here)?,
            Some(low) => {
                for _ in 0..here {
                    bits.skip_zeros()?;
                    bits.skip(low)?;
                }
            }
        }
        left -= here;
    }
    Ok(())
}

/// Checks a tile of `pixels` pixels compressed by gzip, which must unpack to one of `sizes` bytes for
/// each.
pub fn check_gzip(bytes: &[u8], pixels: usize, sizes: &[usize]) -> Result<(), Damaged> {
    let most = sizes.iter().max().map_or(0, |size| size * pixels) as u64;
    let unpacked = std::io::copy(
        &mut GzDecoder::new(bytes).take(most + 1),
        &mut std::io::sink(),
    )
    .map_err(|_| Damaged)?;
    if sizes.iter().any(|size| (size * pixels) as u64 == unpacked) {
        Ok(())
    } else {
        Err(Damaged)
    }
}

/// Checks a line list of PLIO_1: its length is in its header, of one of two forms.
pub fn check_plio(words: &[i16]) -> Result<(), Damaged> {
    let word = |at: usize| words.get(at).map(|w| i64::from(*w)).ok_or(Damaged);
    let (first, length) = if word(2)? > 0 {
        (4, word(2)?)
    } else {
        (word(1)? + 1, (word(4)? << 15) + word(3)?)
    };
    let last = usize::try_from(length).unwrap_or(0);
    if first < 1 || last > words.len() {
        return Err(Damaged);
    }
    // An instruction that uses the next word cannot be the last one.
    const SET_HIGH: i16 = 1;
    match words[..last].last() {
        Some(word) if word / 4096 == SET_HIGH && last == words.len() => Err(Damaged),
        _ => Ok(()),
    }
}

/// Checks a tile of `pixels` pixels compressed by HCOMPRESS_1.
pub fn check_hcompress(bytes: &[u8], pixels: usize) -> Result<(), Damaged> {
    // Two bytes of magic, the sides, the scale, the sum in eight, and the bit planes of the quadrants.
    const HEADER: usize = 25;
    const MOST_PLANES: u8 = 64;
    let header = bytes.get(..HEADER).ok_or(Damaged)?;
    let side = |at: usize| {
        header[at..at + 4]
            .iter()
            .fold(0, |v, b| v << 8 | usize::from(*b))
    };
    let (nx, ny, planes) = (side(2), side(6), &header[22..]);
    if header[..2] != [0xdd, 0x99]
        || nx.checked_mul(ny) != Some(pixels)
        || planes.iter().any(|count| *count > MOST_PLANES)
    {
        return Err(Damaged);
    }
    let (nx2, ny2) = (nx.div_ceil(2), ny.div_ceil(2));
    let mut tile = Quadtrees {
        bits: Bits {
            bytes: &bytes[HEADER..],
            next: 0,
        },
        signed: vec![false; pixels],
        stride: ny,
    };
    tile.quadrant(0, nx2, ny2, planes[0])?;
    tile.quadrant(ny2, nx2, ny / 2, planes[1])?;
    tile.quadrant(ny * nx2, nx / 2, ny2, planes[1])?;
    tile.quadrant(ny * nx2 + ny2, nx / 2, ny / 2, planes[2])?;
    if tile.bits.take(4)? != 0 {
        return Err(Damaged);
    }
    // From the next byte on a sign for each coefficient that is not zero.
    tile.bits.next = tile.bits.next.next_multiple_of(8);
    let signs = tile.signed.iter().filter(|signed| **signed).count();
    tile.bits.skip(signs)
}

/// The coefficients of an HCOMPRESS tile: bit planes of quadrants. Each plane is stored directly or as a quadtree.
struct Quadtrees<'a> {
    bits: Bits<'a>,
    /// Whether a coefficient is not zero.
    signed: Vec<bool>,
    /// Coefficients of a row.
    stride: usize,
}

impl Quadtrees<'_> {
    /// Reads the planes of the quadrant of `nx` × `ny` coefficients from `start`.
    fn quadrant(&mut self, start: usize, nx: usize, ny: usize, planes: u8) -> Result<(), Damaged> {
        const DIRECT: usize = 0;
        const TREE: usize = 15;
        let cells = nx.div_ceil(2) * ny.div_ceil(2);
        if cells == 0 && planes > 0 {
            return Err(Damaged);
        }
        for _ in 0..planes {
            let codes = match self.bits.take(4)? {
                DIRECT => (0..cells)
                    .map(|_| self.bits.take(4))
                    .collect::<Result<_, _>>()?,
                TREE => self.tree(nx, ny)?,
                _ => return Err(Damaged),
            };
            for ix in 0..nx {
                for iy in 0..ny {
                    self.signed[start + ix * self.stride + iy] |= part(&codes, ix, iy, ny);
                }
            }
        }
        Ok(())
    }

    /// The codes of the 2 × 2 cells of a plane of `nx` × `ny`, from a quadtree.
    fn tree(&mut self, nx: usize, ny: usize) -> Result<Vec<usize>, Damaged> {
        let levels = nx.max(ny).next_power_of_two().trailing_zeros();
        let mut codes = vec![self.code()?];
        for level in (1..levels).rev() {
            let (nx, ny) = (nx.div_ceil(1 << level), ny.div_ceil(1 << level));
            let mut finer = vec![0; nx * ny];
            for (k, code) in finer.iter_mut().enumerate().rev() {
                if part(&codes, k / ny, k % ny, ny) {
                    *code = self.code()?;
                }
            }
            codes = finer;
        }
        Ok(codes)
    }

    /// The next code of four bits, in the fixed Huffman code.
    fn code(&mut self) -> Result<usize, Damaged> {
        let three = self.bits.take(3)?;
        if three < 4 {
            return Ok(1 << three);
        }
        let four = three << 1 | self.bits.take(1)?;
        if four < 13 {
            return Ok([3, 5, 10, 12, 15][four - 8]);
        }
        let five = four << 1 | self.bits.take(1)?;
        if five < 31 {
            return Ok([6, 7, 9, 11, 13][five - 26]);
        }
        Ok(if self.bits.take(1)? == 0 { 0 } else { 14 })
    }
}

/// Whether the code of the 2 × 2 cell of (`ix`, `iy`), on a plane of `ny` columns, has that element.
fn part(codes: &[usize], ix: usize, iy: usize, ny: usize) -> bool {
    let code = codes[ix / 2 * ny.div_ceil(2) + iy / 2];
    code >> (3 - (ix % 2 * 2 + iy % 2)) & 1 == 1
}
