//! Mutated files through every reader: whatever the bytes, a value or an error, soon, and without a
//! panic. Each input follows from its reader and number, so that a finding can be repeated.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use shearq_catalogue::foreign::Foreign;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::run::Run;
use shearq_files::table;
use shearq_measure::StampSource;
use shearq_pipeline::measure::ImageSource;
use shearq_results::submit::{Kind, read_spectrum};
use shearq_submissions::{Configuration, Registry};

use crate::support::{Folder, PACKED, fits_image, gzip, pixels_of, without_checksums};

/// Inputs of each reader in the ordinary test.
const INPUTS: u64 = 300;
/// Images of each kind in the long one.
const MANY_IMAGES: u64 = 40_000;
/// Files of each other kind in it.
const MANY_OTHERS: u64 = 10_000;
/// Longest that one input may take. It takes a millisecond; the rest is for busy machines.
const LONGEST: Duration = Duration::from_secs(5);
/// Most memory that one may take, in bytes, where no other test takes any at the same time.
const LARGEST: u64 = 200 << 20;

#[test]
fn mutated_files_are_read_or_refused() {
    fuzz_images(INPUTS);
    fuzz_others(INPUTS);
}

#[test]
#[ignore = "minutes of the same with other inputs"]
fn many_mutated_files_are_read_or_refused() {
    fuzz_images(MANY_IMAGES);
    fuzz_others(MANY_OTHERS);
}

/// Feeds `count` mutations of `seeds` to `read`, which says whether it took one.
fn fuzz(
    reader: &str,
    seeds: &[Vec<u8>],
    count: u64,
    mutate: fn(&mut Vec<u8>, &mut ChaCha8Rng),
    mut read: impl FnMut(&[u8]) -> bool,
) {
    for seed in seeds {
        assert!(read(seed), "{reader}: an input that is not mutated");
    }
    let start = Instant::now();
    let (mut taken, mut longest, mut largest) = (0, Duration::ZERO, 0);
    for number in 0..count {
        let mut random = ChaCha8Rng::seed_from_u64(number);
        let mut bytes = seeds[random.random_range(0..seeds.len())].clone();
        for _ in 0..random.random_range(1..=4) {
            mutate(&mut bytes, &mut random);
        }
        let before = Memory::start();
        let begun = Instant::now();
        // A panic ends the test here, with the number printed by it.
        let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| read(&bytes)));
        let took = begun.elapsed();
        assert!(result.is_ok(), "{reader}: input {number} panics");
        assert!(took < LONGEST, "{reader}: input {number} takes {took:?}");
        largest = largest.max(before.taken());
        if count > INPUTS {
            assert!(
                largest < LARGEST,
                "{reader}: input {number} takes {largest} bytes"
            );
        }
        taken += u64::from(result.unwrap_or(false));
        longest = longest.max(took);
    }
    let rate = count as f64 / start.elapsed().as_secs_f64();
    eprintln!(
        "{reader}: {count} inputs, {rate:.0} a second, {taken} read, the others refused; longest {longest:.1?}; most memory {:.1} MB",
        largest as f64 / 1e6
    );
}

/// Memory of the process before something is done.
struct Memory(u64);

impl Memory {
    /// Forgets the most that was held before.
    fn start() -> Self {
        // Where the system does not let it, the most ever held counts.
        let _ = fs::write("/proc/self/clear_refs", "5");
        Memory(Memory::held("VmRSS:"))
    }

    /// Bytes held since, at most, beyond those held then.
    fn taken(&self) -> u64 {
        Memory::held("VmHWM:").saturating_sub(self.0)
    }

    fn held(key: &str) -> u64 {
        let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
        let line = status.lines().find_map(|line| line.strip_prefix(key));
        let kilobytes = line.and_then(|line| line.split_whitespace().next()?.parse().ok());
        kilobytes.unwrap_or(0) * 1024
    }
}

/// Changes bytes, or the length.
fn mutate_bytes(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    if bytes.is_empty() {
        return;
    }
    let at = random.random_range(0..bytes.len());
    match random.random_range(0..6) {
        0 => bytes[at] ^= 1 << random.random_range(0..8),
        1 => bytes[at] = random.random(),
        2 => bytes.truncate(at),
        3 => {
            let end = (at + random.random_range(1..64)).min(bytes.len());
            let piece = bytes[at..end].to_vec();
            bytes.splice(at..at, piece);
        }
        4 => {
            let end = (at + random.random_range(1..64)).min(bytes.len());
            bytes.drain(at..end);
        }
        _ => {
            // Digits and signs where there are some already.
            let digits: Vec<usize> = (0..bytes.len().min(4096))
                .filter(|k| bytes[*k].is_ascii_digit())
                .collect();
            if !digits.is_empty() {
                let at = digits[random.random_range(0..digits.len())];
                bytes[at] = b"0123456789-+.eE"[random.random_range(0..15)];
            }
        }
    }
}

/// Changes header cards of a FITS file, or its bytes.
fn mutate_fits(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    const CARD: usize = 80;
    const KEYS: &str = "SIMPLE,BITPIX,NAXIS,NAXIS1,NAXIS2,NAXIS3,PCOUNT,GCOUNT,EXTEND,BSCALE,BZERO,BLANK,STAMP,NGRID,\
        NOISESIG,ZBITPIX,ZNAXIS,ZNAXIS1,ZNAXIS2,ZTILE1,ZTILE2,ZCMPTYPE,TFIELDS,TFORM1,THEAP,END,ZIMAGE,\
        ZVAL1,ZVAL2,ZNAME1,ZNAME2,ZQUANTIZ,ZDITHER0,ZBLANK,ZSCALE,ZZERO,TFORM2,TTYPE1,TTYPE2,ztile1,\
        HIERARCH ZTILE2,HIERARCH zval1";
    const VALUES: &str = "0,1,-1,2,3,7,8,16,32,64,-32,-64,999,200000,16000000,2147483647,-2147483648,9223372036854775807,\
        1E300,T,'RICE_1  ','1PB(99999999)',NaN,'GZIP_1  ','GZIP_2  ','PLIO_1  ','HCOMPRESS_1',\
        'NONE    ','SUBTRACTIVE_DITHER_1','1PI     ','1QB     '";
    let cards = bytes.len().min(4 * 2880) / CARD;
    if cards == 0 || random.random_bool(0.4) {
        return mutate_bytes(bytes, random);
    }
    let card = random.random_range(0..cards) * CARD;
    match random.random_range(0..5) {
        0 | 1 => {
            // The value of a key that is there, or a new card in the place of another.
            let mut word = |words: &str| {
                let at = random.random_range(0..words.split(',').count());
                words.split(',').nth(at).unwrap().to_owned()
            };
            let (key, value) = (word(KEYS), word(VALUES));
            let name = format!("{key:<8}= ");
            let found = (0..cards)
                .map(|k| k * CARD)
                .find(|at| bytes[*at..].starts_with(name.as_bytes()));
            let text = format!("{:<CARD$}", format!("{name}{value:>20}"));
            let at = found.unwrap_or(card);
            bytes[at..at + CARD].copy_from_slice(text.as_bytes());
        }
        2 => {
            let other = random.random_range(0..cards) * CARD;
            let copy = bytes[other..other + CARD].to_vec();
            bytes[card..card + CARD].copy_from_slice(&copy);
        }
        3 => bytes[card..card + CARD].fill(b' '),
        _ => {
            let at = card + random.random_range(0..CARD);
            bytes[at] = random.random_range(b' '..=b'~');
        }
    }
}

/// Through `measure`'s reader: the image and its star, row by row.
fn fuzz_images(count: u64) {
    let small = Folder::with_set(2);
    let data = small.at("data");
    let (pixels, side) = pixels_of(&data.join("set02/galaxies-001.fits"));
    // Every second pixel, for speed: 8 × 8 stamps of 24 pixels.
    let half: Vec<i16> = (0..side * side)
        .filter(|k| k % side % 2 == 0 && k / side % 2 == 0)
        .map(|k| (pixels[k] * 50.0) as i16)
        .collect();
    let stamp = ["STAMP   =                   24"];
    let bytes: Vec<u8> = half.iter().flat_map(|v| v.to_be_bytes()).collect();
    let whole = fits_image(16, &[side / 2, side / 2], &stamp, &bytes);
    let bytes: Vec<u8> = half
        .iter()
        .flat_map(|v| f32::from(*v).to_be_bytes())
        .collect();
    let real = fits_image(-32, &[side / 2, side / 2], &stamp, &bytes);
    let packed = PACKED.map(|name| fs::read(format!("tests/data/{name}.fits")).unwrap());
    let submission = Registry::embedded()
        .unwrap()
        .get("23/raw/star")
        .unwrap()
        .configuration;
    let folder = DataFolder::open(&data).unwrap();
    let image = folder.galaxies(2, 1);
    let plain = [whole, real];
    let all = [&plain[..], &packed].concat();
    let read = |bytes: &[u8]| {
        fs::write(&image, bytes).unwrap();
        read_image(&folder, &submission)
    };
    fuzz("FITS image", &plain, count, mutate_fits, read);
    fuzz("compressed FITS image", &packed, count, mutate_fits, read);
    fuzz(
        "FITS image in gzip",
        &all,
        count / 4,
        mutate_fits,
        |bytes| read(&gzip(bytes)),
    );
    let gzipped = all.iter().map(|bytes| gzip(bytes)).collect::<Vec<_>>();
    fuzz(
        "gzip of a FITS image",
        &gzipped,
        count / 4,
        mutate_bytes,
        read,
    );
    fs::write(&image, &plain[0]).unwrap();
    let star = folder.psf_star(2, 1);
    let seed = fs::read(&star).unwrap();
    fuzz("FITS star", &[seed], count / 10, mutate_fits, |bytes| {
        fs::write(&star, bytes).unwrap();
        read_image(&folder, &submission)
    });
}

fn read_image(folder: &DataFolder, submission: &Configuration) -> bool {
    let id = ImageId { set: 2, image: 1 };
    let Ok(mut source) = ImageSource::open(folder, id, submission) else {
        return false;
    };
    (0..source.rows().len()).all(|row| source.stamps(row).is_ok() && source.psfs(row).is_ok())
}

/// Through the readers of everything else.
fn fuzz_others(count: u64) {
    let small = Folder::with_set(2);
    let measure = "--submission 23/raw/star";
    small.measure(&format!("{measure} --catalogue-format fits"));
    let bytes = |name: &str| fs::read(small.at(name)).unwrap();
    let fits = bytes("out/set02/catalogue-001.fits");
    small.measure(measure);
    let parquet = without_checksums(bytes("out/set02/catalogue-001.parquet"));
    let text = |content: &str| vec![content.as_bytes().to_vec()];
    let table = |name: &str, seeds: &[Vec<u8>], mutate| {
        let path = small.at(name);
        fuzz(name, seeds, count, mutate, |bytes| {
            fs::write(&path, bytes).unwrap();
            table::read(&path, Some(&["x", "y", "e1", "e2"]), table::MAX_ROWS).is_ok()
        });
    };
    table("table.fits.gz", &[gzip(&fits)], mutate_bytes);
    table("table.fits", &[fits], mutate_fits);
    table("table.parquet", &[parquet], mutate_bytes);
    let ascii = "# x y e1 e2\n24.5 24.5 0.1 -2e-3\n72.5 24.5 NaN 0\n";
    let csv = "x,y,e1,e2\n24.5,24.5,0.1,-2e-3\n72.5,24.5,NaN,0\n";
    let index = "# note, by me\n;x;y;e1;e2\n0;24.5;24.5;0.1;\n1;72.5;24.5;\"NaN\";0\n";
    let texts = [text(ascii), text(csv), text(index)].concat();
    let gzipped: Vec<Vec<u8>> = texts.iter().map(|text| gzip(text)).collect();
    table("table.csv", &texts, mutate_bytes);
    table("table.csv.gz", &gzipped, mutate_bytes);
    let other = |name: &str, seeds: &[Vec<u8>], read: &dyn Fn(&Path) -> bool| {
        let path = small.at(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fuzz(name, seeds, count, mutate_bytes, |bytes| {
            fs::write(&path, bytes).unwrap();
            read(&path)
        });
    };
    let truth = bytes("data/set02/truth.csv");
    other("truth.csv", &[truth], &|path| {
        table::read_truth(path, table::MAX_ROWS).is_ok()
    });
    other("NN_set2.dat", &text("2 57.6 1e-5\n3 100 2e-5\n"), &|path| {
        Kind::of(path).is_some() && read_spectrum(path).is_ok()
    });
    let foreign = "name = \"x\"\ncatalogues = \"{set}-{image:03}.csv\"\nellipticity = \"shear\"\n";
    other("foreign.toml", &text(foreign), &|path| {
        Foreign::read(path).is_ok()
    });
    let registry = Registry::embedded().unwrap();
    let own = shearq_submissions::Template::Linear.text().unwrap();
    let extended = "extends = \"23/den/star\"\n[stamp]\nsize = 29\n";
    other(
        "own.toml",
        &[text(&own), text(extended)].concat(),
        &|path| registry.get(path.to_str().unwrap()).is_ok(),
    );
    let layout = "galaxies = \"{set}/{image}.fits\"\nfield_degrees = 10.0\nstamp = 48\n";
    other("folder/layout.toml", &text(layout), &|path| {
        DataFolder::open(path.parent().unwrap()).is_ok()
    });
    let run = bytes("out/run.json");
    other("folder/run.json", &[run], &|path| {
        matches!(Run::read(path.parent().unwrap()), Ok(Some(_)))
    });
    let submission = registry.get("23/raw/func").unwrap().configuration;
    let folder = DataFolder::open(small.at("data")).unwrap();
    let psf = bytes("data/set02/psf-001.csv");
    other("data/set02/psf-001.csv", &[psf], &|_| {
        read_image(&folder, &submission)
    });
}
