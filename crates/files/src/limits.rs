//! Largest sizes that are accepted, so that a damaged file cannot claim absurd ones.

/// Most rows of a table that may fill the largest grid, of 4000 × 4000 cells.
pub const MAX_ROWS: usize = 4000 * 4000;
/// Most pixels per side of an image.
pub(crate) const MAX_SIDE: usize = 200_000;
