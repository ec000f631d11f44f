//! Which format a table has, by its first bytes: archives and pipelines name files in many ways (`.parq`, `.cat`, `.ftz`).

use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use flate2::bufread::MultiGzDecoder;

use crate::FileError;
use crate::open::open;

/// What the first bytes of a file show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Content {
    Fits,
    Parquet,
    Arrow,
    /// Text, or nothing that is known.
    Text,
    /// A format that is not read: its name, and what converts it.
    Other(&'static str, &'static str),
}

// RFC 1952, Sect. 2.3.1.
pub(crate) const GZIP_MAGIC: [u8; 2] = [0x1f, 0x8b];

const PANDAS: &str = "pandas, which reads it and writes Parquet by to_parquet";
// Groups, and those of metadetect's artificial shears, are read by the Python package. python/tests/test_hdf5.py runs both lines.
const HDF5: &str = "python3 -c 'import shearq, sys; print(shearq.bias(sys.argv[1], g1=float(sys.argv[2]), g2=float(sys.argv[3])))' FILE:GROUP G1 G2, \
    or for other commands python3 -c 'import h5py, pandas, sys; \
    pandas.DataFrame({name: column[:] for name, column in h5py.File(sys.argv[1])[sys.argv[2]].items()}).to_parquet(sys.argv[3])' FILE GROUP table.parquet";
const ASTROPY: &str = "astropy.table.Table.read, and write(\"table.parquet\")";
const NUMPY: &str = "numpy.load, and astropy.table.Table(array).write(\"table.parquet\")";

// Signatures of formats that are not read, from their specifications. An Arrow stream begins with the mark of a continued message.
const OTHERS: [(&[u8], &str, &str); 13] = [
    (b"PAR1", "Parquet, compressed by gzip", "gunzip first"),
    (
        b"ARROW1",
        "an Arrow file, compressed by gzip",
        "gunzip first",
    ),
    (b"FEA1", "Feather, version 1", PANDAS),
    (
        b"\xff\xff\xff\xff",
        "an Arrow stream",
        "pyarrow.ipc.open_stream, and pyarrow.parquet.write_table",
    ),
    (b"\x89HDF\r\n\x1a\n", "HDF5", HDF5),
    (b"\x93NUMPY", "NumPy's (.npy)", NUMPY),
    (b"#ASDF", "ASDF", ASTROPY),
    (b"BZh", "compressed by bzip2", "bunzip2 first"),
    (b"\xfd7zXZ\0", "compressed by xz", "unxz first"),
    (b"\x28\xb5\x2f\xfd", "compressed by zstd", "unzstd first"),
    (
        b"PK\x03\x04",
        "a ZIP archive (also of .npz and .xlsx)",
        "unzip first",
    ),
    (b"{", "JSON", PANDAS),
    (b"[", "JSON", PANDAS),
];

// The longest signature has nine bytes.
const SIGNATURE_BYTES: u64 = 16;

impl Content {
    /// Of a file that cannot be opened, text; reading it reports the fault.
    pub(crate) fn of(path: &Path) -> Self {
        let Ok(file) = open(path) else {
            return Content::Text;
        };
        let mut file = BufReader::with_capacity(1 << 12, file);
        let mut start = Vec::new();
        let packed = file
            .fill_buf()
            .is_ok_and(|start| start.starts_with(&GZIP_MAGIC));
        // A damaged archive is reported when it is read.
        _ = match packed {
            true => MultiGzDecoder::new(file)
                .take(SIGNATURE_BYTES)
                .read_to_end(&mut start),
            false => file.take(SIGNATURE_BYTES).read_to_end(&mut start),
        };
        let mut others = OTHERS.iter();
        if start.starts_with(b"SIMPLE  =") {
            Content::Fits
        } else if start.starts_with(b"PAR1") && !packed {
            Content::Parquet
        } else if start.starts_with(b"ARROW1") && !packed {
            Content::Arrow
        } else if let Some((_, name, remedy)) = others.find(|(own, ..)| start.starts_with(own)) {
            Content::Other(name, remedy)
        } else {
            Content::Text
        }
    }

    /// Refuses a format that is not read.
    pub(crate) fn check(self, path: &Path) -> Result<(), FileError> {
        match self {
            Content::Other(name, remedy) => Err(FileError::new(
                path,
                format!(
                    "the file is {name}, which is not read (expected a text, FITS, Parquet or Arrow table)"
                ),
            )
            .hint(remedy)),
            Content::Fits | Content::Parquet | Content::Arrow | Content::Text => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn first_bytes_decide_whatever_the_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("table.csv");
        let of = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            Content::of(&path)
        };
        let gzip = |bytes: &[u8]| {
            let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
            packed.write_all(bytes).unwrap();
            packed.finish().unwrap()
        };
        let fits = b"SIMPLE  =                    T";
        assert_eq!(of(fits), Content::Fits);
        assert_eq!(of(&gzip(fits)), Content::Fits);
        assert_eq!(of(b"PAR1 and more"), Content::Parquet);
        assert_eq!(of(b"ARROW1\0\0 and more"), Content::Arrow);
        assert_eq!(of(&gzip(b"e1,e2\n")), Content::Text);
        assert_eq!(of(b""), Content::Text);
        assert_eq!(of(&gzip(b"e1,e2\n")[..4]), Content::Text);
        for (signature, name, _) in OTHERS {
            // Plain Parquet and Arrow are read.
            let found = of(&gzip(&[signature, b"more"].concat()));
            assert!(
                matches!(found, Content::Other(own, _) if own == name),
                "{name}"
            );
            let error = found.check(&path).unwrap_err();
            assert!(error.to_string().contains(name) && error.hint.is_some());
        }
        assert_eq!(Content::of(&folder.path().join("absent")), Content::Text);
    }
}
