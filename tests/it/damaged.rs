//! Bytes of images and catalogues that are damaged inside, and stamps and stars without light: an error, or a flag.

use std::fs;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::support::{Folder, PACKED, assert_has, pixels_of, shell, without_checksums};

const RAW: &str = "--submission 23/raw/star";
const FIRST: &str = "data/set02/galaxies-001.fits";

#[test]
fn damaged_tiles_end_in_an_error() {
    let folder = Folder::with_set(2);
    for name in PACKED {
        let whole = fs::read(format!("tests/data/{name}.fits")).unwrap();
        // The table follows two headers of 2880 bytes and the zeros that fill a block.
        let mut blocks = whole[2 * 2880..].chunks_exact(2880);
        let table = 2880 * (2 + blocks.position(|block| block[0] == 0).unwrap());
        let length = u32::from_be_bytes(whole[table..table + 4].try_into().unwrap());
        // Half of the bytes, none, more than any tile takes, and a place beyond the file.
        for (at, value) in [
            (0, length / 2),
            (0, 0),
            (0, 1_000_000_000),
            (4, 2_000_000_000),
        ] {
            let mut bytes = whole.clone();
            bytes[table + at..table + at + 4].copy_from_slice(&value.to_be_bytes());
            folder.write(FIRST, bytes);
            folder.remove("out");
            let measure = format!("measure --data data --out out {RAW}");
            folder.refuses(&measure, "galaxies-001.fits: ");
        }
    }
}

#[test]
fn stamps_without_a_galaxy_are_flagged_and_noise_is_measured() {
    let folder = Folder::with_set(2);
    let (mut pixels, side) = pixels_of(&folder.at(FIRST));
    let mut fill = |cell: usize, value: &dyn Fn(usize, usize, f32) -> f32| {
        for (x, y) in (0..48 * 48).map(|k| (k % 48, k / 48)) {
            let pixel = &mut pixels[y * side + cell * 48 + x];
            *pixel = value(x, y, *pixel);
        }
    };
    fill(0, &|_, _, _| 0.0);
    fill(1, &|_, _, _| 7.0);
    fill(2, &|_, _, _| -7.0);
    let infinite = |x, y, v| if (x, y) == (40, 3) { f32::INFINITY } else { v };
    fill(3, &infinite);
    fill(4, &|_, _, v| v * 1e-30);
    fill(5, &|_, _, v| v * 1e30);
    // Noise alone, of which denoising leaves nothing.
    fill(6, &|x, y, _| {
        ((x * 7919 + y * 104_729) % 101) as f32 / 50.5 - 1.0
    });
    folder.image(FIRST, &[side, side], &["STAMP   = 48"], &pixels);
    for (submission, noise) in [("23/raw/star", 0.0), ("as-printed/23/den/star", 4.0)] {
        let said = folder.measure(&format!("--submission {submission}"));
        assert_has(&said, "nothing to scale the brightness by");
        let [flags, e1] = folder.numbers("out/set02/catalogue-001.parquet", ["flags", "e1"]);
        assert_eq!(flags[..8], [4.0, 4.0, 4.0, 1.0, 4.0, 4.0, noise, 0.0]);
        let mut pairs = e1.iter().zip(&flags);
        assert!(pairs.all(|(e, flag)| e.is_nan() == (*flag != 0.0)));
    }
}

#[test]
fn noise_alone_has_no_response() {
    let folder = Folder::with_set(2);
    let (mut pixels, side) = pixels_of(&folder.at(FIRST));
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    pixels.fill_with(|| StandardNormal.sample(&mut rng));
    folder.image(FIRST, &[side, side], &["STAMP   = 48"], &pixels);
    let said = folder.measure("--submission 48/linear/star");
    assert_has(
        &said,
        "the mean response to shear is not positive by 3 standard errors",
    );
}

#[test]
fn a_star_that_cannot_be_used_flags_its_galaxy_alone() {
    let folder = Folder::with_set(19);
    let stars = "data/set19/psf-001.fits";
    let (mut pixels, side) = pixels_of(&folder.at(stars));
    for y in 0..48 {
        pixels[y * side..y * side + 48].fill(0.0);
    }
    // The central pixels of each star.
    let write = |size: usize| {
        let (width, first) = (side / 48 * size, (48 - size) / 2);
        let place = |at: usize| at / size * 48 + first + at % size;
        let pixel = |k: usize| pixels[place(k / width) * side + place(k % width)];
        let cut: Vec<f32> = (0..width * width).map(pixel).collect();
        folder.image(stars, &[width; 2], &[&format!("STAMP   = {size}")], &cut);
    };
    let unusable = "flagged: the PSF cannot be used (1)";
    write(48);
    assert_has(&folder.measure(RAW), unusable);
    let [flags] = folder.numbers("out/set19/catalogue-001.parquet", ["flags"]);
    assert_eq!(flags.iter().filter(|flag| **flag != 0.0).count(), 1);
    folder.write("wide.toml", "extends = \"23/raw/star\"\n[psf]\nsize = 48\n");
    // The linear method takes what there is, from a least size on.
    for (size, submission, needs) in [(40, "wide.toml", 48), (30, "48/linear/star", 32)] {
        write(size);
        folder.remove("out");
        let measure = format!("measure --data data --out out --submission {submission}");
        let words = format!("{size} pixels a side; the configuration requires {needs}");
        folder.refuses(&measure, &words);
    }
    write(40);
    assert_has(&folder.measure("--submission 48/linear/star"), unusable);
}

/// Whatever the bytes, there is one error or none; polars' own panics are caught and stay silent.
#[test]
fn damaged_parquet_is_one_error_without_a_panic_message() {
    let folder = Folder::with_set(2);
    folder.measure(RAW);
    let whole = fs::read(folder.at("out/set02/catalogue-001.parquet")).unwrap();
    let whole = without_checksums(whole);
    // Every 41st byte of the pages' headers and of the footer.
    let places = (0..whole.len()).step_by(41);
    for at in places.filter(|at| *at < 200 || *at + 1500 > whole.len()) {
        let mut bytes = whole.clone();
        bytes[at] ^= 0x7f;
        folder.write("c.parquet", bytes);
        let output = shell(
            folder.root(),
            "shearq score --truth data/set02/truth.csv c.parquet",
        );
        let message = String::from_utf8(output.stderr).unwrap();
        let ended = output.status.code().is_some_and(|code| code <= 1);
        let one = message.lines().count() <= 1 && !message.contains("panicked");
        assert!(ended && one, "byte {at}: {message}");
    }
}
