//! Bytes of images and catalogues that are damaged inside, and stamps and stars without light: an error, or a flag.

use std::fs;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::support::{PACKED, Small, fits_image, floats, pixels_of, shearq, text};

const RAW: [&str; 2] = ["--submission", "23/raw/star"];

#[test]
fn damaged_tiles_end_in_an_error() {
    let small = Small::new("2");
    let first = "data/set02/galaxies-001.fits";
    for name in PACKED {
        let whole = fs::read(format!("tests/data/{name}.fits")).unwrap();
        let table = 2 * 2880
            + 2880
                * whole[2 * 2880..]
                    .chunks_exact(2880)
                    .position(|b| b[0] == 0)
                    .unwrap();
        let length = u32::from_be_bytes(whole[table..table + 4].try_into().unwrap());
        let spoil = |change: &dyn Fn(&mut Vec<u8>)| {
            let mut bytes = whole.clone();
            change(&mut bytes);
            fs::write(small.at(first), bytes).unwrap();
            let message = small.fail_to_measure(&RAW);
            assert!(message.contains("galaxies-001.fits: "), "{message}");
        };
        let size = |value: u32| {
            move |b: &mut Vec<u8>| b[table..table + 4].copy_from_slice(&value.to_be_bytes())
        };
        // Half of the bytes, none, more than any tile takes, and a place beyond the file.
        spoil(&size(length / 2));
        spoil(&size(0));
        spoil(&size(1_000_000_000));
        spoil(&|b| b[table + 4..table + 8].copy_from_slice(&2_000_000_000u32.to_be_bytes()));
    }
}

#[test]
fn stamps_without_a_galaxy_are_flagged_and_noise_is_measured() {
    let small = Small::new("2");
    let first = "data/set02/galaxies-001.fits";
    let (mut pixels, side) = pixels_of(&small.at(first));
    let mut fill = |cell: usize, value: &dyn Fn(usize, usize, f32) -> f32| {
        for y in 0..48 {
            for x in 0..48 {
                let pixel = &mut pixels[y * side + cell * 48 + x];
                *pixel = value(x, y, *pixel);
            }
        }
    };
    fill(0, &|_, _, _| 0.0);
    fill(1, &|_, _, _| 7.0);
    fill(2, &|_, _, _| -7.0);
    fill(3, &|x, y, v| {
        if (x, y) == (40, 3) { f32::INFINITY } else { v }
    });
    fill(4, &|_, _, v| v * 1e-30);
    fill(5, &|_, _, v| v * 1e30);
    // Noise alone, of which denoising leaves nothing.
    fill(6, &|x, y, _| {
        ((x * 7919 + y * 104_729) % 101) as f32 / 50.5 - 1.0
    });
    let cards = ["STAMP   =                   48"];
    fs::write(
        small.at(first),
        fits_image(-32, &[side, side], &cards, &floats(&pixels)),
    )
    .unwrap();
    for (submission, noise) in [("23/raw/star", 0.0), ("as-printed/23/den/star", 4.0)] {
        let said = small.measure(&["--submission", submission]);
        assert!(
            said.contains("nothing to scale the brightness by"),
            "{said}"
        );
        let flags = small.measured("02", "flags");
        assert_eq!(flags[..8], [4.0, 4.0, 4.0, 1.0, 4.0, 4.0, noise, 0.0]);
        let e1 = small.measured("02", "e1");
        assert!(
            e1.iter()
                .zip(&flags)
                .all(|(e, flag)| e.is_nan() == (*flag != 0.0))
        );
    }
}

#[test]
fn noise_alone_has_no_response() {
    let small = Small::new("2");
    let first = "data/set02/galaxies-001.fits";
    let (mut pixels, side) = pixels_of(&small.at(first));
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    pixels.fill_with(|| StandardNormal.sample(&mut rng));
    let cards = ["STAMP   =                   48"];
    let image = fits_image(-32, &[side, side], &cards, &floats(&pixels));
    fs::write(small.at(first), image).unwrap();
    let said = small.measure(&["--submission", "48/linear/star"]);
    let expected = "the mean response to shear is not positive by 3 standard errors";
    assert!(said.contains(expected), "{said}");
}

#[test]
fn a_star_that_cannot_be_used_flags_its_galaxy_alone() {
    let small = Small::new("19");
    let stars = "data/set19/psf-001.fits";
    let (mut pixels, side) = pixels_of(&small.at(stars));
    for y in 0..48 {
        pixels[y * side..y * side + 48].fill(0.0);
    }
    let write = |size: usize| {
        // The middle of each star.
        let (count, first) = (side / 48, (48 - size) / 2);
        let place = |at: usize| at / size * 48 + first + at % size;
        let places = (0..count * size).flat_map(|y| (0..count * size).map(move |x| (y, x)));
        let cut: Vec<f32> = places
            .map(|(y, x)| pixels[place(y) * side + place(x)])
            .collect();
        let card = format!("STAMP   = {size:>20}");
        let image = fits_image(-32, &[count * size; 2], &[card.as_str()], &floats(&cut));
        fs::write(small.at(stars), image).unwrap();
    };
    write(48);
    let said = small.measure(&RAW);
    assert!(
        said.contains("flagged: the PSF cannot be used (1)"),
        "{said}"
    );
    assert_eq!(
        small
            .measured("19", "flags")
            .iter()
            .filter(|f| **f != 0.0)
            .count(),
        1
    );
    let wide = small.at("wide.toml");
    fs::write(&wide, "extends = \"23/raw/star\"\n[psf]\nsize = 48\n").unwrap();
    // The linear method takes what there is, from a least size on.
    let linear = ["--submission", "48/linear/star"];
    for (size, submission, needs) in [(40, wide.to_str().unwrap(), 48), (30, linear[1], 32)] {
        write(size);
        let message = small.fail_to_measure(&["--submission", submission]);
        let expected = format!("{size} pixels a side; the configuration requires {needs}");
        assert!(message.contains(&expected), "{message}");
    }
    write(40);
    let said = small.measure(&linear);
    assert!(
        said.contains("flagged: the PSF cannot be used (1)"),
        "{said}"
    );
}

/// Whatever the bytes, there is one error or none; polars' own panics are caught and stay silent.
#[test]
fn damaged_parquet_is_one_error_without_a_panic_message() {
    let small = Small::new("2");
    small.measure(&["--submission", "23/raw/star"]);
    let whole = fs::read(small.at("out/set02/catalogue-001.parquet")).unwrap();
    let truth = small.at("data/set02/truth.csv");
    let path = small.at("c.parquet");
    // Every 41st byte of the pages' headers and of the footer.
    for at in (0..whole.len())
        .step_by(41)
        .filter(|at| *at < 200 || *at + 1500 > whole.len())
    {
        let mut bytes = whole.clone();
        bytes[at] ^= 0x7f;
        fs::write(&path, bytes).unwrap();
        let output = shearq(&["score", "--truth", text(&truth), text(&path)]);
        let message = String::from_utf8(output.stderr).unwrap();
        assert!(
            output.status.code().is_some_and(|code| code <= 1),
            "byte {at}: {message}"
        );
        assert!(
            message.lines().count() <= 1 && !message.contains("panicked"),
            "{message}"
        );
    }
}
