//! FITS images by strips of rows, and FITS binary tables. The only user of cfitsio, which only reads.
//!
//! cfitsio must not be called from several threads at a time, so every call goes through one lock. Images
//! are read and written row by row in FITS order: the first row of the file is y = 1, row-major.
//! gzip and tile-compressed (fpack) images are read like plain ones.

mod file;
mod read;
mod selection;
mod write;

pub use read::{
    ImageReader, Pixel, TableHead, first_texts, read_table, read_table_keys, read_table_parts,
    read_vector, tables,
};
pub use selection::{ImageHead, Planes, Selection, image_heads};
pub use write::{ImageWriter, Value, write_table, write_vector};
