//! Commands of the pages of `tests/cases` that make or show what no text can hold: images and tables of FITS.
//!
//! * `image FROM TO WHAT...`: an image of the pixels of another. WHAT is applied in order: `size=WxH` or other axes,
//!   `pads=STAMP,SIDE` (zeros around each stamp), `cube=STAMP,SIDE` (the central pixels of the stamps of a mosaic), `copy=STAMP` (the first
//!   stamp everywhere), `number=SIDE` (of the square of pixels from 0), `shift=X,Y`, `scale=F`, `add=F`, `background=F` (of
//!   the peak), `snr=F` (adds noise), `pixel=X,Y,F` (from 1),
//!   `bitpix=N`, or a card such as `STAMP=48` or `CTYPE1="RA---TAN"`.
//! * `card FROM TO KEY=VALUE`: a copy with another value of a key. `card FROM TO KEY CARD`: a copy with any card in the
//!   place of the last one of this key; `"` stands for `'`.
//! * `tables TO NAME=CSV...`: a file of tables, each from a CSV of numbers.
//! * `extensions TO NAME=IMAGE...`: a file of named images.
//! * `missing FROM`: prints the places of pixels that are NaN, from 1.
//! * `stamps FROM SIDE`: prints the first pixel of each stamp of a mosaic.
//! * `csv FROM TO COLUMN...`: writes columns of a catalogue as CSV, or prints why it cannot be read.
//! * `sign PRIVATE ENTRY TEAM TIME`: writes a receipt for an entry of the past, with the key of a challenge.

use std::fs;
use std::path::Path;

use shearq_challenge::seal::{Key, Receipt, sha256};
use shearq_files::fits::write_table;
use shearq_files::frames::frame;
use shearq_files::frames::polars::Column;
use shearq_files::table;

use crate::support::{
    contents, csv, fits_extension, fits_image, floats, mosaic, pixels_of, stamps, text,
};

/// Runs a command of this module in `root`, and gives what it prints; `None` if it is another.
pub fn run(command: &str, root: &Path) -> Option<String> {
    // Words may have spaces in single quotes.
    let quoted = command.split('\'').enumerate();
    let words: Vec<String> = quoted
        .flat_map(|(k, part)| match k % 2 {
            0 => part.split_whitespace().map(str::to_owned).collect(),
            _ => vec![part.to_owned()],
        })
        .collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let at = |name: &str| match name.strip_prefix("[tests/data]/") {
        Some(name) => Path::new("tests/data").join(name),
        None => root.join(name),
    };
    match words.as_slice() {
        ["image", from, to, what @ ..] => fs::write(at(to), image(&at(from), what)).unwrap(),
        ["card", from, to, what @ ..] => {
            let mut bytes = fs::read(at(from)).unwrap();
            let (key, card) = match what {
                [key, card] => ((*key).to_owned(), card.replace('"', "'")),
                _ => {
                    let (key, value) = what[0].split_once('=').unwrap();
                    (key.to_owned(), format!("{key:<8}= {value:>20}"))
                }
            };
            let key = format!("{key:<8}");
            let mut cards = bytes.chunks_exact_mut(80).rev();
            let old = cards.find(|old| old.starts_with(key.as_bytes())).unwrap();
            old.copy_from_slice(format!("{card:<80}").as_bytes());
            fs::write(at(to), bytes).unwrap();
        }
        ["tables", to, tables @ ..] => {
            let mut file = Vec::new();
            for (name, table) in tables.iter().filter_map(|table| table.split_once('=')) {
                let bytes = table_of(&at(table), &at("one.fits"), name);
                file.extend(&bytes[if file.is_empty() { 0 } else { 2880 }..]);
            }
            fs::write(at(to), file).unwrap();
        }
        ["extensions", to, images @ ..] => {
            let mut file = fits_image(8, &[], &["EXTEND  = T"], &[]);
            for (name, from) in images.iter().filter_map(|image| image.split_once('=')) {
                let (pixels, width) = pixels_of(&at(from));
                let (sides, name) = (
                    [width, pixels.len() / width],
                    format!("EXTNAME = '{name:<8}'"),
                );
                file.extend(fits_extension(
                    "IMAGE",
                    -32,
                    &sides,
                    &[&name],
                    &floats(&pixels),
                ));
            }
            fs::write(at(to), file).unwrap();
        }
        ["missing", from] => {
            let (pixels, width) = pixels_of(&at(from));
            let places = (0..pixels.len()).filter(|k| pixels[*k].is_nan());
            let places = places.map(|k| format!("{},{}", k % width + 1, k / width + 1));
            return Some(places.collect::<Vec<_>>().join(" "));
        }
        ["stamps", from, side] => {
            let (pixels, width) = pixels_of(&at(from));
            let side: usize = side.parse().unwrap();
            let rows = pixels.chunks(width).step_by(side);
            let corners = rows.flat_map(|row| row.iter().step_by(side));
            let shown: Vec<String> = corners.map(ToString::to_string).collect();
            return Some(shown.join(" "));
        }
        ["csv", from, to, names @ ..] => {
            let read = match table::read(&at(from), Some(names), table::MAX_ROWS) {
                Ok(read) => read,
                Err(error) => return Some(error.to_string().replace(text(root), "[CASE]")),
            };
            let column = |name: &&str| table::numbers(&read, name, Path::new(from)).unwrap();
            let columns: Vec<_> = names.iter().map(column).collect();
            let row = |k: usize| columns.iter().map(|c| c[k].to_string()).collect::<Vec<_>>();
            let rows = (0..read.height()).map(|k| row(k).join(",") + "\n");
            fs::write(at(to), names.join(",") + "\n" + &rows.collect::<String>()).unwrap();
        }
        ["sign", private, entry, team, time] => {
            let (key, entry) = (Key::read(&at(private)).unwrap().unwrap(), at(entry));
            let content = match entry.is_dir() {
                true => {
                    let files = contents(&entry).into_iter();
                    let lines = files.map(|(name, file)| format!("{name} {}\n", sha256(&file)));
                    lines.collect::<String>().into_bytes()
                }
                false => fs::read(&entry).unwrap(),
            };
            let receipt = Receipt::sign(&key, team, time.parse().unwrap(), &sha256(&content));
            receipt.write(&entry).unwrap();
        }
        _ => return None,
    }
    Some(String::new())
}

fn numbers<const N: usize>(text: &str) -> [f64; N] {
    let numbers: Vec<f64> = text.split([',', 'x']).map(|n| n.parse().unwrap()).collect();
    numbers.try_into().expect("numbers")
}

fn image(from: &Path, what: &[&str]) -> Vec<u8> {
    let (mut pixels, width) = pixels_of(from);
    let mut sides = vec![width, pixels.len() / width];
    let (mut bitpix, mut cards) = (-32, Vec::new());
    for (key, value) in what.iter().map(|what| what.split_once('=').unwrap()) {
        match key {
            "size" => {
                sides = value.split('x').map(|side| side.parse().unwrap()).collect();
                pixels.resize(sides.iter().product(), 0.0);
            }
            "cube" => {
                let [stamp, side] = numbers(value).map(|side| side as usize);
                let (first, all) = ((stamp - side) / 2, stamps(&pixels, sides[0], stamp));
                let place = |k: usize| (first + k / side) * stamp + first + k % side;
                let cut = |own: &Vec<f32>| (0..side * side).map(|k| own[place(k)]).collect();
                pixels = all.iter().map(cut).collect::<Vec<Vec<f32>>>().concat();
                sides = vec![side, side, all.len()];
            }
            "pads" => {
                let [stamp, side] = numbers(value).map(|side| side as usize);
                let (first, n) = ((side - stamp) / 2, sides[0] / stamp);
                let padded = stamps(&pixels, sides[0], stamp)
                    .into_iter()
                    .flat_map(|own| {
                        let mut new = vec![0.0; side * side];
                        for (k, row) in own.chunks(stamp).enumerate() {
                            new[(first + k) * side + first..][..stamp].copy_from_slice(row);
                        }
                        new
                    });
                pixels = mosaic(&padded.collect::<Vec<_>>(), side, n);
                sides = vec![n * side; 2];
            }
            "copy" => {
                let all = stamps(&pixels, sides[0], value.parse().unwrap());
                pixels = mosaic(
                    &all[0].repeat(all.len()),
                    value.parse().unwrap(),
                    all.len().isqrt(),
                );
            }
            "scale" => {
                let factor: f32 = value.parse().unwrap();
                pixels.iter_mut().for_each(|v| *v *= factor);
            }
            "add" => {
                let light: f32 = value.parse().unwrap();
                pixels.iter_mut().for_each(|v| *v += light);
            }
            "background" => {
                let peak = pixels.iter().copied().fold(0.0, f32::max);
                let light = value.parse::<f32>().unwrap() * peak;
                pixels.iter_mut().for_each(|pixel| *pixel += light);
            }
            "snr" => {
                let power = pixels.iter().map(|v| v * v).sum::<f32>().sqrt();
                let rms = power / value.parse::<f32>().unwrap();
                // Uniform numbers of variance one.
                let mut state = 1u32;
                for pixel in &mut pixels {
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    *pixel += rms * 12f32.sqrt() * ((state >> 8) as f32 / (1 << 24) as f32 - 0.5);
                }
            }
            "number" => {
                let (side, width) = (value.parse::<usize>().unwrap(), sides[0]);
                let stamp = |k: usize| k / width / side * (width / side) + k % width / side;
                pixels = (0..pixels.len()).map(|k| stamp(k) as f32).collect();
            }
            "shift" => {
                let [dx, dy] = numbers(value).map(|by| by as i64);
                let [w, h] = [sides[0], sides[1]].map(|side| side as i64);
                let old = pixels.clone();
                let place =
                    |k: i64| ((k / w - dy).rem_euclid(h) * w + (k % w - dx).rem_euclid(w)) as usize;
                pixels = (0..w * h).map(|k| old[place(k)]).collect();
            }
            "pixel" => {
                let [x, y, v] = numbers(value);
                pixels[(y as usize - 1) * sides[0] + x as usize - 1] = v as f32;
            }
            "bitpix" => bitpix = value.parse().unwrap(),
            key => cards.push(format!("{key:<8}= {:>20}", value.replace('"', "'"))),
        }
    }
    let bytes = |pixel: &f32| match bitpix {
        8 => vec![*pixel as u8],
        16 => (*pixel as i16).to_be_bytes().to_vec(),
        32 => (*pixel as i32).to_be_bytes().to_vec(),
        64 => (*pixel as i64).to_be_bytes().to_vec(),
        -64 => f64::from(*pixel).to_be_bytes().to_vec(),
        _ => pixel.to_be_bytes().to_vec(),
    };
    let cards: Vec<&str> = cards.iter().map(String::as_str).collect();
    let bytes: Vec<u8> = pixels.iter().flat_map(bytes).collect();
    fits_image(bitpix, &sides, &cards, &bytes)
}

/// A FITS file of one table with the columns of a CSV file.
fn table_of(table: &Path, scratch: &Path, name: &str) -> Vec<u8> {
    let head = fs::read_to_string(table).unwrap();
    let names: Vec<&str> = head.lines().next().unwrap().split(',').collect();
    let columns = names.iter().zip(csv(table, &names));
    let columns = columns.map(|(name, values)| Column::new((*name).into(), values));
    let _ = fs::remove_file(scratch);
    write_table(scratch, &frame(columns.collect()).unwrap(), &[]).unwrap();
    let mut bytes = fs::read(scratch).unwrap();
    fs::remove_file(scratch).unwrap();
    let mut cards = bytes.chunks_exact_mut(80);
    let card = cards.find(|card| card.starts_with(b"EXTNAME ")).unwrap();
    let quoted = format!("'{name}'");
    card.copy_from_slice(format!("{:<80}", format!("EXTNAME = {quoted:<20}")).as_bytes());
    bytes
}
