//! What makes results the same results: every digit of a setting, and the data they were measured from.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use shearq_dataset::run::{read_record, write_record};
use shearq_files::fits::{ImageReader, ImageWriter, Value};
use shearq_render::table::{Cell, Heading, Table, TableFormat};

/// Finite numbers of every size.
fn numbers(count: usize) -> Vec<f64> {
    let mut random = ChaCha8Rng::seed_from_u64(17);
    let mut numbers = vec![
        0.0,
        -0.0,
        f64::MIN_POSITIVE,
        f64::MAX,
        5e-324,
        1.8554865613500826,
    ];
    // Settings are near one more often than numbers of random bits.
    numbers.extend((0..count).map(|_| random.random::<f64>() * 10.0));
    let bits = (0..count).map(|_| f64::from_bits(random.random()));
    numbers.extend(bits.filter(|number| number.is_finite()));
    numbers
}

#[test]
fn every_number_is_read_as_it_was_written() {
    let folder = tempfile::tempdir().unwrap();
    let numbers = numbers(40_000);
    let bits = |numbers: &[f64]| numbers.iter().map(|n| n.to_bits()).collect::<Vec<_>>();
    let path = folder.path().join("numbers.json");
    write_record(&path, &numbers).unwrap();
    let read: Vec<f64> = read_record(&path).unwrap().unwrap();
    assert!(bits(&read) == bits(&numbers), "JSON");
    for some in numbers.chunks(1000) {
        let table = toml::Table::from_iter([("n".to_owned(), some.to_vec().into())]);
        let read: toml::Table = toml::to_string(&table).unwrap().parse().unwrap();
        let read = read["n"]
            .as_array()
            .unwrap()
            .iter()
            .map(|n| n.as_float().unwrap());
        assert!(bits(&read.collect::<Vec<_>>()) == bits(some), "TOML");
    }
    let table = Table {
        headings: vec![Heading::new("n", "N")],
        rows: numbers.iter().map(|&n| vec![Cell::number(n, 2)]).collect(),
        ..Table::default()
    };
    let csv = table.render(TableFormat::Csv);
    let read: Vec<f64> = csv
        .lines()
        .skip(1)
        .map(|line| line.parse().unwrap())
        .collect();
    assert!(bits(&read) == bits(&numbers), "CSV");
}

#[test]
fn every_number_of_a_header_is_read_as_it_was_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("header.fits");
    // cfitsio reads what is below the normal numbers as zero.
    let numbers: Vec<f64> = numbers(500)
        .into_iter()
        .filter(|n| *n == 0.0 || n.is_normal())
        .collect();
    let names: Vec<String> = (0..numbers.len()).map(|k| format!("N{k}")).collect();
    let header: Vec<(&str, Value)> = names
        .iter()
        .map(String::as_str)
        .zip(numbers.iter().map(|&n| Value::Real(n)))
        .collect();
    let mut image = ImageWriter::create(&path, 1, 1, &header).unwrap();
    image.write_rows(&[0.0]).unwrap();
    image.finish().unwrap();
    let image = ImageReader::open(&path).unwrap();
    for (name, number) in names.iter().zip(numbers) {
        let read = image.number(name).unwrap().unwrap();
        assert!(
            read.to_bits() == number.to_bits() || (read, number) == (0.0, 0.0),
            "{number:e}: {read:e}"
        );
    }
}
