//! How the header of a compressed image divides it into tiles.

use super::cards::Cards;
use crate::{MAX_ROWS as MAX_PLANES, MAX_SIDE};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Coding {
    /// RICE_1, with the pixels of a block and the bytes of a pixel: 1, 2 or 4.
    Rice {
        block: usize,
        bytes: usize,
    },
    Gzip,
}

// Most pixels of the tiles next to each other along x, which cfitsio keeps in memory together. It needs some twenty
// bytes per pixel.
const MAX_TILE_ROW_PIXELS: usize = 1 << 21;
// Length of cfitsio's table of random numbers. ZDITHER0 is an index of the table, from 1.
const DITHERS: usize = 10_000;

/// The division of an image into tiles and their compression, as its header describes them.
#[derive(Debug)]
pub struct Tiling {
    pub(super) coding: Coding,
    /// Bytes per pixel of an image of real numbers; `None` for integers.
    pub(super) real: Option<usize>,
    /// Whether ZQUANTIZ states that real numbers are stored without quantisation.
    pub(super) unquantised: bool,
    /// Columns and rows of the image, or of each plane of a cube.
    sides: [usize; 2],
    /// Planes of a cube, 1 for an image.
    planes: usize,
    /// Columns and rows of a tile. A tile has one plane.
    tile: [usize; 2],
}

impl Tiling {
    /// The tiling that a header describes; `None` if it does not describe a compressed image.
    pub fn of(cards: &Cards) -> Result<Option<Self>, String> {
        if cards.text("ZIMAGE").is_none() {
            return Ok(None);
        }
        let need = |key: &str, range| {
            let found = cards.number(key, range)?;
            found.ok_or_else(|| format!("there is no header key {key}; a compressed image has one"))
        };
        let dimensions = need("ZNAXIS", 0..=999)?;
        let planes = match dimensions {
            2 => 1,
            3 => need("ZNAXIS3", 1..=MAX_PLANES)?,
            _ => {
                return Err(format!(
                    "the compressed image has {dimensions} dimensions; expected 2, or 3 for a cube"
                ));
            }
        };
        let depth = cards.number("ZTILE3", 1..=MAX_PLANES)?.unwrap_or(1);
        if depth != 1 {
            return Err(format!("its tiles have {depth} planes each; expected one"));
        }
        let sides = [
            need("ZNAXIS1", 1..=MAX_SIDE)?,
            need("ZNAXIS2", 1..=MAX_SIDE)?,
        ];
        let side =
            |key: &str, absent| Ok::<_, String>(cards.number(key, 1..=MAX_SIDE)?.unwrap_or(absent));
        let tile = [side("ZTILE1", sides[0])?, side("ZTILE2", 1)?];
        let pixels = sides[0].next_multiple_of(tile[0]) * tile[1];
        if pixels > MAX_TILE_ROW_PIXELS {
            return Err(format!(
                "its tiles of {} × {} pixels have {pixels} in a row of tiles; expected at most {MAX_TILE_ROW_PIXELS}",
                tile[0], tile[1]
            ));
        }
        let real = match cards.text("ZBITPIX") {
            Some("8" | "16" | "32") => None,
            Some("-32") => Some(4),
            Some("-64") => Some(8),
            found => {
                let found = found.unwrap_or("absent");
                return Err(format!(
                    "the header key ZBITPIX is {found}; expected 8, 16, 32, -32 or -64"
                ));
            }
        };
        cards.number("ZDITHER0", 1..=DITHERS)?;
        Ok(Some(Tiling {
            coding: coding(cards)?,
            real,
            unquantised: cards.text("ZQUANTIZ") == Some("NONE"),
            sides,
            planes,
            tile,
        }))
    }

    pub(super) fn tiles(&self) -> usize {
        self.of_plane() * self.planes
    }

    pub(super) fn of_plane(&self) -> usize {
        self.across() * self.sides[1].div_ceil(self.tile[1])
    }

    /// Number of tiles that contain the first `rows` rows, counted through the planes.
    pub(super) fn of_rows(&self, rows: usize) -> usize {
        let (planes, rest) = (rows / self.sides[1], rows % self.sides[1]);
        planes * self.of_plane() + rest.div_ceil(self.tile[1]) * self.across()
    }

    /// Number of tiles next to each other along x.
    fn across(&self) -> usize {
        self.sides[0].div_ceil(self.tile[0])
    }

    /// Pixels of the tile with this number, from 0. Tiles at the right and upper edge of the image may be smaller.
    pub(super) fn pixels(&self, number: usize) -> usize {
        let number = number % self.of_plane();
        let place = [number % self.across(), number / self.across()];
        let side = |axis: usize| {
            let start = place[axis] * self.tile[axis];
            (self.sides[axis] - start).min(self.tile[axis])
        };
        side(0) * side(1)
    }
}

fn coding(cards: &Cards) -> Result<Coding, String> {
    match cards.text("ZCMPTYPE") {
        Some("RICE_1" | "RICE_ONE") => rice(cards),
        Some("GZIP_1" | "GZIP_2") => Ok(Coding::Gzip),
        // cfitsio's decoders of these two write as many pixels as the tile claims. Guarding them takes a decoder of our
        // own, for two formats that no survey uses for galaxy images.
        Some(name @ ("PLIO_1" | "HCOMPRESS_1")) => Err(format!(
            "the image is compressed by {name}; expected RICE_1, GZIP_1 or GZIP_2. Try: funpack"
        )),
        found => {
            let found = found.unwrap_or("absent");
            Err(format!(
                "the header key ZCMPTYPE is {found}; expected RICE_1, GZIP_1 or GZIP_2"
            ))
        }
    }
}

/// The parameters of Rice compression. Very old files lack the pixel size, or have the two exchanged.
fn rice(cards: &Cards) -> Result<Coding, String> {
    const BLOCKS: std::ops::RangeInclusive<usize> = 1..=MAX_SIDE;
    let block = cards.number("ZVAL1", BLOCKS)?;
    let block = block.ok_or("there is no header key ZVAL1; Rice compression has one")?;
    let bytes = match cards.text("ZNAME2") {
        Some("NOISEBIT") => None,
        _ => cards.number("ZVAL2", BLOCKS)?,
    }
    .unwrap_or(4);
    let (block, bytes) = if block < 16 && bytes > 8 {
        (bytes, block)
    } else {
        (block, bytes)
    };
    Ok(Coding::Rice {
        block,
        bytes: if bytes > 2 { 4 } else { bytes },
    })
}
