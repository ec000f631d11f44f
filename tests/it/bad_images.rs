//! Images and PSFs that are damaged, odd, or not there: one error that names file and fault, or a
//! flag, and nothing lost of what was done before.

use std::fs;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_files::frames::polars::df;

use crate::support::{PACKED, Small, fits_image, floats, pixels_of};

const RAW: [&str; 2] = ["--submission", "23/raw/star"];
const FUNCTIONAL: [&str; 2] = ["--submission", "23/raw/func"];

/// Replaces a file, and expects an error that names it and says all of `expected`.
fn refuse(small: &Small, file: &str, bytes: &[u8], settings: &[&str], expected: &[&str]) {
    fs::write(small.at(file), bytes).unwrap();
    let message = small.fail_to_measure(settings);
    let name = file.rsplit('/').next().unwrap();
    for part in [&[name], expected].concat() {
        assert!(message.contains(part), "{part}: {message}");
    }
    assert_eq!(message.lines().count(), 1, "{message}");
}

#[test]
fn damaged_images_are_refused_and_those_before_are_kept() {
    let small = Small::new("2");
    let second = "data/set02/galaxies-002.fits";
    let whole = fs::read(small.at(second)).unwrap();
    let card = |key: &str, value: &str| {
        let mut bytes = whole.clone();
        let name = format!("{key:<8}=");
        let at = bytes.windows(9).position(|w| w == name.as_bytes()).unwrap();
        let text = format!("{name} {value:>20}");
        bytes[at..at + text.len()].copy_from_slice(text.as_bytes());
        bytes
    };
    let cases: Vec<(Vec<u8>, &[&str])> = vec![
        (
            whole[..whole.len() / 2].to_vec(),
            &["truncated", "it can hold 296640 bytes; expected 592704"],
        ),
        (whole[..2880].to_vec(), &["truncated"]),
        (whole[..1000].to_vec(), &["has no END in 1000 bytes"]),
        (vec![], &["the file is empty; expected a FITS image"]),
        (
            b"This is no image.".to_vec(),
            &["starts with `This i`", "`SIMPLE`"],
        ),
        (
            card("NAXIS1", "4000000000"),
            &["4000000000 × 384", "expected 1 to 200000"],
        ),
        (
            card("NAXIS1", "199999"),
            &["truncated or its header damaged"],
        ),
        (card("NAXIS1", "-384"), &["cannot open the image"]),
        (card("BITPIX", "12"), &["cannot open the image"]),
        (
            card("STAMP", "0"),
            &["header key STAMP is 0; expected a whole number, 1 to 1024"],
        ),
        (
            card("STAMP", "47"),
            &["384 × 384 pixels; expected 8 × 8 stamps of 47"],
        ),
        (card("NGRID", "7"), &["expected 7 × 7 stamps of 48"]),
        (
            card("NGRID", "'eight'"),
            &["header key NGRID is not a number"],
        ),
    ];
    for (bytes, expected) in cases {
        refuse(&small, second, &bytes, &RAW, expected);
        let kept = fs::read_dir(small.at("out/set02")).unwrap().count();
        assert_eq!(kept, 1, "the first image's catalogue");
    }
    fs::write(small.at(second), &whole).unwrap();
    fs::remove_file(small.at(second)).unwrap();
    fs::create_dir(small.at(second)).unwrap();
    let message = small.fail_to_measure(&RAW);
    assert!(
        message.contains("galaxies-002.fits: cannot open the file: this is a folder"),
        "{message}"
    );
}

#[test]
fn images_of_other_shapes_and_types_work_or_are_refused() {
    let small = Small::new("2");
    let first = "data/set02/galaxies-001.fits";
    let (pixels, side) = pixels_of(&small.at(first));
    let stamp = &["STAMP   =                   48"][..];
    let float = floats(&pixels);
    let cases: Vec<(Vec<u8>, &[&str])> = vec![
        (
            fits_image(-32, &[side * side], stamp, &float),
            &["1 dimensions; expected 2"],
        ),
        (
            fits_image(-32, &[side, side, 1], stamp, &float),
            &["3 dimensions; expected 2"],
        ),
        (
            fits_image(-32, &[side, side - 40], stamp, &float),
            &["384 × 344 pixels; expected 8 × 7"],
        ),
        (
            fits_image(-32, &[0, side], stamp, &[]),
            &["0 × 384 pixels; expected 1 to"],
        ),
        (fits_image(8, &[], &[], &[]), &["0 dimensions; expected 2"]),
        (
            fits_image(-32, &[side; 2], &["BSCALE  = 'abc     '"], &float),
            &["the header key BSCALE is not a number"],
        ),
        (
            fits_image(-32, &[side; 2], &["BSCALE  =                  0.0"], &float),
            &["the header key BSCALE is 0; expected"],
        ),
        (
            fits_image(-32, &[side; 2], &["BZERO   =                1E400"], &float),
            &["the header key BZERO is"],
        ),
    ];
    for (bytes, expected) in cases {
        refuse(&small, first, &bytes, &RAW, expected);
    }
    let table = small.at("data/set02/table.fits");
    let columns = df!("a" => [1.0]).unwrap();
    shearq_files::fits::write_table(&table, &columns, &[]).unwrap();
    let expected = ["the first extension is a table; expected a two-dimensional image"];
    refuse(&small, first, &fs::read(&table).unwrap(), &RAW, &expected);

    // Whole numbers are the same image in every type that can hold them.
    let whole: Vec<i16> = pixels.iter().map(|v| (v * 50.0) as i16).collect();
    let mut found = Vec::new();
    for bytes in [
        fits_image(
            16,
            &[side, side],
            stamp,
            &whole
                .iter()
                .flat_map(|v| v.to_be_bytes())
                .collect::<Vec<_>>(),
        ),
        fits_image(
            32,
            &[side, side],
            stamp,
            &whole
                .iter()
                .flat_map(|v| i32::from(*v).to_be_bytes())
                .collect::<Vec<_>>(),
        ),
        fits_image(
            64,
            &[side, side],
            stamp,
            &whole
                .iter()
                .flat_map(|v| i64::from(*v).to_be_bytes())
                .collect::<Vec<_>>(),
        ),
        fits_image(
            -64,
            &[side, side],
            stamp,
            &whole
                .iter()
                .flat_map(|v| f64::from(*v).to_be_bytes())
                .collect::<Vec<_>>(),
        ),
    ] {
        // gzip is recognised by the content, whatever the name.
        for bytes in [gzip(&bytes), bytes] {
            fs::write(small.at(first), bytes).unwrap();
            small.measure(&RAW);
            found.push(small.measured("02", "e1"));
        }
    }
    assert!(
        found
            .iter()
            .all(|e1| *e1 == found[0] && e1.iter().all(|e| e.is_finite()))
    );

    // A pixel with the value of BLANK has none.
    let cards = [
        "STAMP   =                   48",
        "BLANK   =               -32768",
    ];
    let mut blank = whole;
    blank[0] = i16::MIN;
    let bytes: Vec<u8> = blank.iter().flat_map(|v| v.to_be_bytes()).collect();
    fs::write(
        small.at(first),
        fits_image(16, &[side, side], &cards, &bytes),
    )
    .unwrap();
    assert!(
        small
            .measure(&RAW)
            .contains("flagged: pixels are missing (1)")
    );
}

#[test]
fn compressed_images_are_read_and_damaged_ones_refused() {
    let small = Small::new("2");
    let first = "data/set02/galaxies-001.fits";
    // The image that tests/data/rice.fits holds, as fpack writes it: 8 × 8 stamps of 24 pixels.
    let side = 192;
    let value = |k: i32| {
        let (dx, dy) = (2 * (k % side % 24) - 23, 2 * (k / side % 24) - 23);
        (4000 - 9 * (2 * dx * dx + dx * dy + 3 * dy * dy)).max(0) as i16
    };
    let pixels: Vec<u8> = (0..side * side)
        .flat_map(|k| value(k).to_be_bytes())
        .collect();
    let plain = fits_image(
        16,
        &[192, 192],
        &["STAMP   =                   24"],
        &pixels,
    );
    let rice = include_bytes!("../data/rice.fits");
    let mut found = Vec::new();
    let mut all = vec![plain.clone(), rice.to_vec()];
    for name in ["gzip", "hcompress", "hcompress32", "plio", "lossless"] {
        all.push(fs::read(format!("tests/data/{name}.fits")).unwrap());
    }
    all.push(gzip(rice));
    for bytes in all {
        fs::write(small.at(first), bytes).unwrap();
        fs::remove_file(small.at("data/set02/galaxies-002.fits")).unwrap_or_default();
        small.measure(&RAW);
        found.push((small.measured("02", "e1"), small.measured("02", "e2")));
    }
    assert!(found.iter().all(|measured| *measured == found[0]));
    assert!(found[0].0.iter().all(|e1| e1.is_finite()));
    refuse(
        &small,
        first,
        &rice[..rice.len() - 4000],
        &RAW,
        &["truncated"],
    );
    let packed = gzip(&plain);
    refuse(
        &small,
        first,
        &packed[..packed.len() / 2],
        &RAW,
        &["cannot unpack the gzip file"],
    );
    let mut bomb = packed.clone();
    let size = bomb.len();
    bomb[size - 4..].copy_from_slice(&u32::MAX.to_le_bytes());
    refuse(&small, first, &bomb, &RAW, &["cannot unpack the gzip file"]);
    let mut corrupt = packed;
    corrupt[size / 2] ^= 0xff;
    refuse(
        &small,
        first,
        &corrupt,
        &RAW,
        &["cannot unpack the gzip file"],
    );
}

/// A compressed image of those in tests/data with a card of its second header in the place of another.
fn with_card(name: &str, old: &str, new: &str) -> Vec<u8> {
    let mut bytes = fs::read(format!("tests/data/{name}.fits")).unwrap();
    let place = |key: &str| {
        let card = format!("{key:<8}");
        let cards = bytes.chunks_exact(80).skip(36);
        36 + cards
            .clone()
            .position(|c| c.starts_with(card.as_bytes()))
            .unwrap()
    };
    let at = 80 * place(old);
    bytes[at..at + 80].copy_from_slice(format!("{new:<80}").as_bytes());
    bytes
}

#[test]
fn what_cfitsio_would_divide_by_is_refused_however_it_is_written() {
    let small = Small::new("2");
    let first = "data/set02/galaxies-001.fits";
    let mut cases: Vec<(Vec<u8>, &str)> = Vec::new();
    for (old, new, expected) in [
        (
            "ZTILE1",
            "ZTILE1  = 0",
            "ZTILE1 is 0; expected a whole number, 1 to 200000",
        ),
        ("ZTILE1", "ztile1  = 0", "ZTILE1 is 0"),
        ("ZTILE1", "HIERARCH ZTILE1 = 0", "ZTILE1 is 0"),
        ("ZTILE1", "HIERARCH ztile1=0", "ZTILE1 is 0"),
        ("ZTILE1", "ZTILE1 =0", "ZTILE1 is 0"),
        ("ZTILE1", "ZTILE1  = '0       '", "ZTILE1 is '0"),
        ("ZTILE1", "ZTILE1  = 0.5", "ZTILE1 is 0.5"),
        ("ZTILE1", "ZTILE1  = -1", "ZTILE1 is -1"),
        ("ZVAL1", "ZVAL1   = 0", "ZVAL1 is 0"),
        ("ZVAL1", "ZVAL1   = 1E-3", "ZVAL1 is 1E-3"),
        // Before the card that says that this is Rice compression.
        ("TFIELDS", "ZVAL1   = 0", "the second one named ZVAL1"),
        ("STAMP", "ZTILE1  = 0", "the second one named ZTILE1"),
        (
            "ZTILE2",
            "ZTILE2  = 200000",
            "in a row of tiles; expected at most",
        ),
        (
            "ZNAXIS",
            "ZNAXIS  = 7",
            "7 dimensions; expected 2, or 3 for a cube",
        ),
        ("ZBITPIX", "ZBITPIX = 64", "ZBITPIX is 64"),
        ("ZCMPTYPE", "ZCMPTYPE= 'BZIP2_1 '", "ZCMPTYPE is BZIP2_1"),
        ("ZNAME1", "ZDITHER0= -99999999", "ZDITHER0 is -99999999"),
        (
            "ZNAME1",
            "ZQUANTIZ= 'NONE    '",
            "ZQUANTIZ is NONE for integers",
        ),
        (
            "ZNAME1",
            "A=111111111111111111111111111111111111111111111111111111111111111111111111111111",
            "is too long",
        ),
    ] {
        cases.push((with_card("rice", old, new), expected));
    }
    // Far down the header.
    let mut long = with_card("rice", "ZTILE1", "ZTILE1  = 0");
    long.splice(2880 + 8 * 80..2880 + 8 * 80, vec![b' '; 40 * 2880]);
    cases.push((long, "ZTILE1 is 0"));
    for (bytes, expected) in cases {
        refuse(&small, first, &bytes, &RAW, &[expected]);
        refuse(&small, first, &gzip(&bytes), &RAW, &[expected]);
    }
}

#[test]
fn damaged_tiles_are_refused_before_they_are_unpacked() {
    let small = Small::new("2");
    let first = "data/set02/galaxies-001.fits";
    for name in PACKED {
        let whole = fs::read(format!("tests/data/{name}.fits")).unwrap();
        let key = |name: &str| {
            let name = format!("{name:<8}= ");
            let cards = whole.chunks_exact(80).skip(36);
            let card = cards
                .clone()
                .find(|c| c.starts_with(name.as_bytes()))
                .unwrap();
            let value = String::from_utf8_lossy(&card[10..30]).trim().to_owned();
            value.parse::<usize>().unwrap()
        };
        let table = 2 * 2880
            + 2880
                * whole[2 * 2880..]
                    .chunks_exact(2880)
                    .position(|b| b[0] == 0)
                    .unwrap();
        let heap = table + key("NAXIS1") * key("NAXIS2");
        let length = u32::from_be_bytes(whole[table..table + 4].try_into().unwrap());
        let spoil = |change: &dyn Fn(&mut Vec<u8>)| {
            let mut bytes = whole.clone();
            change(&mut bytes);
            refuse(&small, first, &bytes, &RAW, &["tile 1"]);
        };
        let size = |value: u32| {
            move |b: &mut Vec<u8>| b[table..table + 4].copy_from_slice(&value.to_be_bytes())
        };
        // Half of the bytes, none, more than any tile takes, and a place beyond the file.
        spoil(&size(length / 2));
        spoil(&size(0));
        spoil(&size(1_000_000_000));
        spoil(&|b| b[table + 4..table + 8].copy_from_slice(&2_000_000_000u32.to_be_bytes()));
        if name.starts_with("hcompress") {
            // The side that the pixels themselves tell.
            spoil(&|b| b[heap + 4] = 0xff);
            spoil(&|b| b[heap + 22..heap + 25].fill(0xff));
        }
        if name == "plio" {
            spoil(&|b| b[heap + 6..heap + 10].fill(0x7f));
        }
    }
}

/// Measures with 1 GB of address space, which must fail with an error.
fn refuse_in_little_memory(small: &Small, file: &str, bytes: &[u8], expected: &str) {
    fs::write(small.at(file), bytes).unwrap();
    let command = format!(
        "ulimit -v 1000000; exec {} measure --threads 2 --data {} --out {} {}",
        env!("CARGO_BIN_EXE_shearq"),
        small.at("data").display(),
        small.at("out").display(),
        RAW.join(" ")
    );
    let output = std::process::Command::new("sh")
        .args(["-c", &command])
        .output()
        .unwrap();
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{message}");
    assert!(message.contains(expected), "{expected}: {message}");
}

#[test]
fn memory_is_not_taken_on_the_word_of_a_header() {
    let small = Small::new("2");
    let first = "data/set02/galaxies-001.fits";
    // One tile of 20000² pixels.
    let mut tile = with_card("rice", "ZTILE1", "ZTILE1  = 20000");
    for key in ["ZTILE2", "ZNAXIS1", "ZNAXIS2"] {
        let name = format!("{key:<8}= ");
        let at = tile
            .windows(10)
            .rposition(|w| w == name.as_bytes())
            .unwrap();
        tile[at..at + 30].copy_from_slice(format!("{name}{:>20}", 20000).as_bytes());
    }
    for bytes in [gzip(&tile), tile] {
        refuse_in_little_memory(&small, first, &bytes, "in a row of tiles; expected at most");
    }
    // A gzip file that says it expands to three gigabytes of an image that has no grid, and blanks.
    let header = fits_image(16, &[40_001, 40_001], &[], &[]);
    let mut bomb = gzip(&[header, vec![0; 16 << 20]].concat());
    let end = bomb.len() - 4;
    bomb[end..].copy_from_slice(&3_200_000_000u32.to_le_bytes());
    refuse_in_little_memory(
        &small,
        first,
        &bomb,
        "expected at most 1073741824 in a gzip file",
    );
    let bomb = gzip(&fits_image(16, &[20_001, 20_001], &[], &[0; 1 << 20]));
    refuse_in_little_memory(&small, first, &bomb, "expected 416 × 416 stamps");
}

#[test]
fn the_words_of_cfitsio_reach_the_user() {
    let small = Small::new("2");
    let first = "data/set02/galaxies-001.fits";
    // The primary image is empty, and what is wrong is in the extension.
    for (key, card, expected) in [
        ("TFORM1", "TFORM1  = 'Y       '", "TFORM"),
        ("NAXIS1", "NAXIS1  = 9", "sum of column widths"),
        (
            "TTYPE1",
            "TTYPE1  = 'NOTHING '",
            "couldn't find COMPRESSED_DATA column",
        ),
    ] {
        let bytes = with_card("rice", key, card);
        refuse(&small, first, &bytes, &RAW, &["cfitsio error", expected]);
    }
}

/// A gzip file of blocks that are stored, not compressed.
pub fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut packed = vec![0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 255];
    let blocks = bytes.chunks(usize::from(u16::MAX));
    let last = blocks.len() - 1;
    for (k, block) in blocks.enumerate() {
        let length = block.len() as u16;
        packed.push(u8::from(k == last));
        packed.extend(length.to_le_bytes());
        packed.extend((!length).to_le_bytes());
        packed.extend(block);
    }
    // The checksum of RFC 1952, bit by bit.
    let mut sum = u32::MAX;
    for byte in bytes {
        sum ^= u32::from(*byte);
        for _ in 0..8 {
            sum = (sum >> 1) ^ (0xedb8_8320 * (sum & 1));
        }
    }
    packed.extend((!sum).to_le_bytes());
    packed.extend((bytes.len() as u32).to_le_bytes());
    packed
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
fn noise_alone_has_no_shear() {
    let small = Small::new("2");
    let first = "data/set02/galaxies-001.fits";
    let (mut pixels, side) = pixels_of(&small.at(first));
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    pixels.fill_with(|| StandardNormal.sample(&mut rng));
    let cards = ["STAMP   =                   48"];
    let image = fits_image(-32, &[side, side], &cards, &floats(&pixels));
    fs::write(small.at(first), image).unwrap();
    small.measure(&["--submission", "48/linear/star"]);
    let e1 = small.measured("02", "e1");
    assert!(e1[..64].iter().all(|e| e.is_nan()), "{e1:?}");
}

#[test]
fn stars_that_cannot_be_used_are_refused_with_the_reason() {
    let small = Small::new("2");
    let star = "data/set02/psf-001.fits";
    let (pixels, side) = pixels_of(&small.at(star));
    let image = |change: &dyn Fn(usize, usize) -> f32| {
        let changed: Vec<f32> = (0..side * side)
            .map(|k| change(k % side, k / side))
            .collect();
        fits_image(-32, &[side, side], &[], &floats(&changed))
    };
    let at = |x: usize, y: usize| pixels[y % side * side + x % side];
    let cases: Vec<(Vec<u8>, &[&str])> = vec![
        (image(&|_, _| 0.0), &["sum to 0; expected a positive sum"]),
        (
            image(&|x, y| -at(x, y)),
            &["sum to -0.9", "expected a positive sum"],
        ),
        (
            image(&|x, y| if (x, y) == (4, 9) { f32::NAN } else { at(x, y) }),
            &["pixel (5, 10)", "not a finite number"],
        ),
        (
            image(&|x, y| at(x + 20, y)),
            &[
                "(-20.0, ",
                "px off the centre",
                "expected 15 × 15 pixels around the star",
            ],
        ),
        (image(&|x, y| at(x, y + 28)), &["+20.0) px off the centre"]),
        (
            fits_image(-32, &[14, 14], &[], &[0; 784]),
            &["14 pixels a side; the configuration requires 15"],
        ),
        (
            fits_image(-32, &[side, 40], &[], &floats(&pixels[..side * 40])),
            &["48 × 40 pixels; expected one stamp, or 8 × 8"],
        ),
        (
            fits_image(
                -32,
                &[side, side],
                &["STAMP   =                   20"],
                &floats(&pixels),
            ),
            &["48 × 48 pixels; expected one stamp, or 8 × 8"],
        ),
    ];
    for (bytes, expected) in cases {
        refuse(&small, star, &bytes, &RAW, expected);
        assert!(!small.at("out").exists());
    }
    // A stamp larger than the galaxies' is cut like any other, and STAMP tells it from a grid.
    let mut wide = vec![0.0; 384 * 384];
    for (k, value) in pixels.iter().enumerate() {
        wide[(168 + k / side) * 384 + 168 + k % side] = *value;
    }
    fs::write(small.at(star), image(&at)).unwrap();
    small.measure(&RAW);
    let expected = small.measured("02", "e1");
    let cards = ["STAMP   =                  384"];
    fs::write(
        small.at(star),
        fits_image(-32, &[384, 384], &cards, &floats(&wide)),
    )
    .unwrap();
    small.measure(&RAW);
    assert_eq!(small.measured("02", "e1"), expected);
    fs::remove_file(small.at(star)).unwrap();
    let message = small.fail_to_measure(&RAW);
    assert!(
        message.contains("psf-001.fits: cannot open the file"),
        "{message}"
    );
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

#[test]
fn functional_psfs_with_mistakes_are_named_with_their_line() {
    let small = Small::new("2");
    let header = "x,y,profile,beta,fwhm,e1,e2\n";
    let rows: [(&str, &[&str]); 11] = [
        (
            "24.5,24.5,moffat,3,0,0,0\n",
            &["line 2", "FWHM must be a positive number of pixels, not 0"],
        ),
        ("24.5,24.5,moffat,3,NaN,0,0\n", &["line 2", "not NaN"]),
        (
            "24.5,24.5,moffat,3,1e9,0,0\n",
            &["FWHM of 1000000000 px; expected at most the 15"],
        ),
        (
            "24.5,24.5,moffat,3,4,1.2,0\n",
            &["line 2", "(1.2, 0)", "below 1"],
        ),
        (
            "24.5,24.5,moffat,0,4,0,0\n",
            &["line 2", "beta must be a number above 1"],
        ),
        (
            "24.5,24.5,gaussian,3,4,0,0\n",
            &["`gaussian`; expected `moffat` or `kolmogorov`"],
        ),
        (
            "24.5,24.5,moffat,three,4,0,0\n",
            &["line 2", "`three` in column `beta`"],
        ),
        (
            "24.5,24.5,moffat,3,4\n",
            &["line 2", "5 fields; expected 7"],
        ),
        (
            "9999,24.5,moffat,3,4,0,0\n2,2,moffat,3,4,0,0\n",
            &["(9999, 24.5) is outside the grid"],
        ),
        (
            "24.5,24.5,moffat,3,4,0,0\n72.5,24.5,moffat,3,4,0,0\n",
            &["2 rows; expected one, or one for each of the 64"],
        ),
        ("", &["0 rows; expected one"]),
    ];
    let table = "data/set02/psf-001.csv";
    for (row, expected) in rows {
        refuse(
            &small,
            table,
            format!("{header}{row}").as_bytes(),
            &FUNCTIONAL,
            expected,
        );
    }
    refuse(
        &small,
        table,
        b"x,y\n",
        &FUNCTIONAL,
        &["the header is `x,y`; expected `x,y,profile"],
    );
    refuse(
        &small,
        table,
        b"\xff\xfe",
        &FUNCTIONAL,
        &["cannot read the PSF parameters"],
    );
}
