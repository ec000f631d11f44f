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
    let all = numbers(40_000);
    let bits = |numbers: &[f64]| numbers.iter().map(|n| n.to_bits()).collect::<Vec<_>>();
    let path = folder.path().join("numbers.json");
    write_record(&path, &all).unwrap();
    let read: Vec<f64> = read_record(&path).unwrap().unwrap();
    assert!(bits(&read) == bits(&all), "JSON");
    let table = Table {
        headings: vec![Heading::new("n", "N")],
        rows: all.iter().map(|&n| vec![Cell::number(n, 2)]).collect(),
        ..Table::default()
    };
    let csv = table.render(TableFormat::Csv);
    let read = csv.lines().skip(1).map(|line| line.parse().unwrap());
    assert!(bits(&read.collect::<Vec<f64>>()) == bits(&all), "CSV");
    let path = folder.path().join("header.fits");
    let names: Vec<String> = (0..1000).map(|k| format!("N{k}")).collect();
    // cfitsio reads what is below the normal numbers as zero.
    let all = numbers(500)
        .into_iter()
        .filter(|n| *n == 0.0 || n.is_normal());
    let header: Vec<(&str, Value)> = names
        .iter()
        .map(String::as_str)
        .zip(all.map(Value::Real))
        .collect();
    let mut image = ImageWriter::create(&path, 1, 1, &header).unwrap();
    image.write_rows(&[0.0]).unwrap();
    image.finish().unwrap();
    let image = ImageReader::open(&path).unwrap();
    for (name, value) in header {
        let Value::Real(number) = value else {
            panic!("{name} is a number");
        };
        let read = image.number(name).unwrap().unwrap();
        let same = read.to_bits() == number.to_bits() || (read, number) == (0.0, 0.0);
        assert!(same, "{number:e}: {read:e}");
    }
}
