//! `shearq bias` on catalogues with known m and c that no page of `tests/cases` can make.

use std::fmt::Write;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use serde_json::Value;
use shearq_files::frames::frame;
use shearq_files::frames::polars::{Column, NamedFrom, Series};
use shearq_files::table::{self, FileFormat};
use shearq_quantities::Shear;

use crate::support::{Folder, assert_has, fits_extension, fits_image, shell};

const M: [f64; 2] = [0.02, -0.03];
const C: [f64; 2] = [1e-3, -2e-3];
const GALAXIES: usize = 2000;

/// Shears that are added in the catalogues noshear, 1p, 1m, 2p and 2m.
const SHEARS: [[f64; 2]; 5] = [
    [0.0, 0.0],
    [0.01, 0.0],
    [-0.01, 0.0],
    [0.0, 0.01],
    [0.0, -0.01],
];
const NAMES: [&str; 5] = ["noshear", "1p", "1m", "2p", "2m"];

struct Normal(ChaCha8Rng);

impl Normal {
    fn draw(&mut self, rms: f64) -> f64 {
        let number: f64 = StandardNormal.sample(&mut self.0);
        rms * number
    }

    fn pair(&mut self, rms: f64) -> [f64; 2] {
        [0; 2].map(|_| self.draw(rms))
    }
}

fn normal(seed: u64) -> Normal {
    Normal(ChaCha8Rng::seed_from_u64(seed))
}

/// Ellipticities and responses (of 0.8 on average) of the same galaxies under a shear.
fn galaxies(seed: u64, g: [f64; 2]) -> Vec<[[f64; 2]; 2]> {
    let mut normal = normal(seed);
    let galaxy = |_| {
        let e = [0, 1].map(|k| normal.draw(0.2) + 0.8 * ((1.0 + M[k]) * g[k] + C[k]));
        [e, normal.pair(0.2).map(|scatter| 0.8 + scatter)]
    };
    (0..GALAXIES).map(galaxy).collect()
}

/// Writes tables of the same galaxies under opposite shears, and gives the names of the files.
fn pair(
    folder: &Folder,
    name: &str,
    shear: f64,
    table: impl Fn(f64, &mut Normal) -> String,
) -> String {
    for (sign, g) in [("plus", shear), ("minus", -shear)] {
        folder.write(&format!("{name}-{sign}.csv"), table(g, &mut normal(12)));
    }
    format!("{name}-plus.csv {name}-minus.csv")
}

fn rows(folder: &Folder, line: &str) -> Vec<Value> {
    let found = folder.json(&format!("bias {line}"));
    found["rows"].as_array().unwrap().clone()
}

fn number(row: &Value, key: &str) -> f64 {
    row[key].as_f64().unwrap_or_else(|| panic!("{key}: {row}"))
}

/// m1 and m2 of a row.
fn assert_m(row: &Value, expected: [f64; 2], tolerance: f64) {
    for (key, expected) in ["m1", "m2"].into_iter().zip(expected) {
        let off = (number(row, key) - expected).abs();
        assert!(off < tolerance, "{key}, expected {expected}: {row}");
    }
}

/// Catalogues of shearq state what the noise of their star does to m and c.
#[test]
fn errors_contain_the_noise_of_a_star_that_all_galaxies_share() {
    type Keys<'a> = &'a [(&'a str, &'a str)];
    let folder = Folder::new();
    let write = |name: &str, format, g: f64, keys: Keys<'_>| {
        // Every hundredth galaxy is flagged.
        let flag = |id: usize| f64::from(id.is_multiple_of(100));
        let all: Vec<_> = galaxies(3, [g; 2]).into_iter().enumerate().collect();
        let column = |name: &str, of: &dyn Fn(usize, [[f64; 2]; 2]) -> f64| {
            let values = all.iter().map(|(id, galaxy)| of(*id, *galaxy));
            Column::new(name.into(), values.collect::<Vec<f64>>())
        };
        let e = |id, e| if flag(id) > 0.0 { f64::NAN } else { e };
        let table = frame(vec![
            column("id", &|id, _| id as f64),
            column("e1", &|id, [own, _]| e(id, own[0])),
            column("e2", &|id, [own, _]| e(id, own[1])),
            column("R11", &|_, [_, r]| r[0]),
            column("R22", &|_, [_, r]| r[1]),
            column("flags", &|id, _| flag(id)),
            column("g1", &|_, _| g),
            column("g2", &|_, _| g),
            column("first_energy", &|_, _| 1.0),
        ]);
        let metadata = keys
            .iter()
            .map(|(key, value)| ((*key).into(), (*value).into()));
        table::write(
            &folder.at(name),
            format,
            &table.unwrap(),
            &metadata.collect(),
        )
        .unwrap();
    };
    let pair = |name: &str, format, [plus, minus]: [Keys<'_>; 2]| {
        write(&format!("plus.{name}"), format, 0.02, plus);
        write(&format!("minus.{name}"), format, -0.02, minus);
        folder.json(&format!("bias plus.{name} minus.{name}"))
    };
    let noise = ("psfnoise", "3.00e-1 4.00e-3");
    let creator = ("creator", "shearq 0.3.0");
    let one = [creator, noise, ("psf", "a")];
    let other = [creator, noise, ("psf", "b")];
    let (parquet, fits) = (FileFormat::Parquet, FileFormat::Fits);
    let without = pair("0.parquet", parquet, [&[], &[]]);
    assert!(!without["notes"].to_string().contains("star"), "{without}");
    // Each of two stars has half of the galaxies, and an error of c under one sign only is one of m, too.
    let half = 0.5f64.sqrt();
    let two = [
        (0.3 * half).hypot(4e-3 / 0.02 * half),
        (4e-3 * half).hypot(0.3 * 0.02 * half),
    ];
    let shared = "a star that several units share";
    for (name, format, second, [m, c], said) in [
        ("1.parquet", parquet, &one, [0.3, 4e-3], shared),
        ("1.fits", fits, &one, [0.3, 4e-3], shared),
        ("2.parquet", parquet, &other, two, "2 stars"),
    ] {
        let found = pair(name, format, [&one, second]);
        assert_has(&found["notes"].to_string(), said);
        for (key, more) in [("m1", m), ("m2", m), ("c1", c), ("c2", c)] {
            let (row, own) = (&found["rows"][0], &without["rows"][0]);
            assert_eq!(row[key], own[key]);
            let key = format!("{key}_error");
            let ratio = number(row, &key) / number(own, &key).hypot(more);
            // The two halves of the galaxies differ by their responses, 0.2/√4000 of 0.8.
            assert!((ratio - 1.0).abs() < 0.02, "{name} {key}: {ratio}");
        }
    }
    // Of another program it means something else.
    let bad = [("psfnoise", "x")];
    let found = pair("3.parquet", parquet, [&bad, &bad]);
    assert_eq!(found["rows"], without["rows"]);
    write("bad.parquet", parquet, 0.02, &[creator, bad[0]]);
    folder.refuses("bias bad.parquet", "`psfnoise`");
}

/// Layouts of public catalogues and pipelines with the same numbers: names of e1 or e2 (`K`) in a sheared catalogue (`S`).
#[test]
fn sheared_catalogues_are_recognised_in_any_layout() {
    let folder = Folder::new();
    // Of a galaxy, [(catalogue, [e1, e2])].
    let sheared =
        |[own, r]: [[f64; 2]; 2]| SHEARS.map(|shear| [0, 1].map(|j| own[j] + r[j] * shear[j]));
    let arms = [("plus", 0.02), ("minus", -0.02)];
    // Means of both components, over the mean response.
    let expected = {
        let of = |g: f64| {
            let mut sums = [[0.0; 2]; 2];
            for [own, r] in galaxies(1, [g; 2]) {
                (0..2).for_each(|k| {
                    sums[k][0] += own[k];
                    sums[k][1] += r[k];
                });
            }
            sums.map(|[e, r]| e / r)
        };
        let (plus, minus) = (of(0.02), of(-0.02));
        [0, 1].map(|k| (plus[k] - minus[k]) / 0.04 - 1.0)
    };
    let truth = |files: &[String]| {
        let line = |file: &String| {
            let g = if file.contains("plus") { 0.02 } else { -0.02 };
            format!("{file},{g},{g}\n")
        };
        let lines: Vec<String> = files.iter().map(line).collect();
        folder.write("truth.csv", format!("catalogue,g1,g2\n{}", lines.concat()));
        files.join(" ")
    };
    let columns = [
        ("eK", "eK_S"),
        ("noshear_eK", "S_eK"),
        ("00/gK", "S/gK"),
        ("eK_noshear", "eK.S"),
        ("eK", "eKS"),
        ("g_noshear_K", "g_S_K"),
        ("EK_UNSHEARED", "EK_SHEARED_S"),
    ];
    for (base, name) in columns {
        for (sign, g) in arms {
            let name = |k: usize, at: usize| {
                let of = |name: &str| {
                    name.replace('K', &(k + 1).to_string())
                        .replace('S', NAMES[at])
                };
                match (at, base) {
                    (0, "EK_UNSHEARED") => format!("E{}_UNSHEARED", k + 1),
                    (0, base) => of(base),
                    (_, "EK_UNSHEARED") => {
                        format!("E{}_SHEARED_{}", k + 1, NAMES[at].to_uppercase())
                    }
                    _ => of(name),
                }
            };
            let names = (0..5).flat_map(|at| [name(0, at), name(1, at)]);
            let mut text = names.collect::<Vec<_>>().join(",") + "\n";
            for galaxy in galaxies(1, [g; 2]) {
                let numbers = sheared(galaxy).into_iter().flatten().map(|e| e.to_string());
                text += &(numbers.collect::<Vec<_>>().join(",") + "\n");
            }
            folder.write(&format!("{sign}.csv"), text);
        }
        let files = truth(&["plus.csv".into(), "minus.csv".into()]);
        let found = rows(&folder, &format!("{files} --truth truth.csv"));
        // Rounding of differences of 0.01.
        assert_m(&found[0], expected, 1e-9);
    }
    // Rows with a text in a column of any name, and numbers, which the user must confirm.
    let numbers = ["0", "1", "2", "3", "4"];
    for (names, given) in [(NAMES, ""), (numbers, "--columns version=kind")] {
        for (sign, g) in arms {
            let mut text = String::from("kind,e1,e2\n");
            for (at, name) in names.iter().enumerate() {
                for galaxy in galaxies(1, [g; 2]) {
                    let [e1, e2] = sheared(galaxy)[at];
                    writeln!(text, "{name},{e1},{e2}").unwrap();
                }
            }
            folder.write(&format!("{sign}.csv"), text);
        }
        let files = truth(&["plus.csv".into(), "minus.csv".into()]);
        let found = rows(&folder, &format!("{files} --truth truth.csv {given}"));
        assert_m(&found[0], expected, 1e-9);
    }
    folder.refuses(
        "bias plus.csv minus.csv --truth truth.csv",
        "version=kind if 0 is noshear",
    );
    // A file for each sheared catalogue.
    let mut files = Vec::new();
    for (sign, g) in arms {
        for (at, name) in NAMES.iter().enumerate() {
            let mut text = String::from("e1,e2\n");
            for galaxy in galaxies(1, [g; 2]) {
                let [e1, e2] = sheared(galaxy)[at];
                writeln!(text, "{e1},{e2}").unwrap();
            }
            let file = format!("{sign}_{name}.csv");
            folder.write(&file, text);
            files.push(file);
        }
    }
    let all = truth(&files);
    let found = rows(&folder, &format!("{all} --truth truth.csv"));
    assert_m(&found[0], expected, 1e-9);
    files.pop();
    let some = truth(&files);
    folder.refuses(
        &format!("bias {some} --truth truth.csv"),
        "there is no row of 2m",
    );
}

/// Columns that are given as e1 and e2, and what is said of them.
#[test]
fn numbers_that_are_no_ellipticities_are_named() {
    let folder = Folder::new();
    let shapes: Vec<[f64; 2]> = galaxies(4, [0.0; 2]).iter().map(|[e, _]| *e).collect();
    type Kind<'a> = (&'a str, &'a dyn Fn([f64; 2]) -> [f64; 2]);
    let kinds: [Kind<'_>; 5] = [
        ("e1 is never negative", &|[a, b]| {
            [a.hypot(b), 0.5 * b.atan2(a)]
        }),
        ("are no ellipticities", &|[a, b]| [100.0 * a, 100.0 * b]),
        ("are no ellipticities", &|[a, b]| [22.0 + a, 21.0 + b]),
        ("which no method of measuring shapes leaves", &|[a, b]| {
            [0.3 + 0.1 * a, b]
        }),
        ("|e| above 1", &|[a, b]| [2.5 * a, 2.5 * b]),
    ];
    for (expected, kind) in kinds {
        let mut text = String::from("e1,e2\n");
        for e in &shapes {
            let [a, b] = kind(*e);
            writeln!(text, "{a},{b}").unwrap();
        }
        folder.write("c.csv", text);
        match expected == "are no ellipticities" {
            true => folder.refuses("bias c.csv", expected),
            false => assert_has(&folder.run("bias c.csv").replace('\n', " "), expected),
        }
    }
}

/// HATS and dask write a catalogue as a folder of files.
#[test]
fn a_folder_of_parts_is_one_catalogue() {
    let folder = Folder::new();
    let write = |name: &str, g: f64, part: std::ops::Range<usize>| {
        let all = &galaxies(3, [g; 2])[part];
        let column = |name: &str, of: &dyn Fn(&[[f64; 2]; 2]) -> f64| {
            Column::new(name.into(), all.iter().map(of).collect::<Vec<f64>>())
        };
        let table = frame(vec![
            column("e1", &|[e, _]| e[0]),
            column("e2", &|[e, _]| e[1]),
            column("R11", &|[_, r]| r[0]),
            column("R22", &|[_, r]| r[1]),
            column("g1", &|_| g),
            column("g2", &|_| g),
        ]);
        let path = folder.at(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        table::write(
            &path,
            FileFormat::Parquet,
            &table.unwrap(),
            &Default::default(),
        )
        .unwrap();
    };
    for (sign, g) in [("plus", 0.02), ("minus", -0.02)] {
        write(&format!("{sign}.parquet"), g, 0..GALAXIES);
        write(
            &format!("{sign}/dataset/Norder=1/Dir=0/Npix=7.parquet"),
            g,
            0..500,
        );
        write(
            &format!("{sign}/dataset/Norder=1/Dir=0/Npix=8/part0.parquet"),
            g,
            500..GALAXIES,
        );
        folder.write(&format!("{sign}/dataset/_common_metadata"), "no rows");
    }
    let whole = rows(&folder, "plus.parquet minus.parquet");
    assert_eq!(rows(&folder, "plus minus"), whole);
    // The same galaxies under another name of a file.
    std::fs::copy(folder.at("plus.parquet"), folder.at("more.parquet")).unwrap();
    folder.refuses(
        "bias plus.parquet more.parquet",
        "the same galaxies as plus.parquet",
    );
}

#[test]
fn mean_distortions_are_divided_by_the_responsivity() {
    let folder = Folder::new();
    // REGAUSS distortions with HSC's columns: weights, and noise that moves some moduli above 1.
    let start = "i_hsmshaperegauss";
    let head =
        ["e1", "e2", "derived_weight", "derived_rms_e"].map(|name| format!("{start}_{name}"));
    let files = pair(&folder, "hsc", 0.03, |g, normal| {
        let mut text = format!("{},g1,g2\n", head.join(","));
        for id in 0..GALAXIES {
            let [s1, s2] = normal.pair(0.2);
            let sheared = Shear::new(s1, s2).sheared_by(Shear::new(g, -g));
            let (chi, [n1, n2]) = (sheared.to_distortion(), normal.pair(0.3));
            let (weight, rms) = (1 + id % 4, 0.36 + 0.01 * (id % 4) as f64);
            let (e1, e2) = (chi.e1 + n1, chi.e2 + n2);
            writeln!(text, "{e1},{e2},{weight},{rms},{g},{}", -g).unwrap();
        }
        text
    });
    let content = |file: &str| std::fs::read_to_string(folder.at(file)).unwrap();
    // ⟨w χ⟩/(2 ⟨w⟩ (1 − ⟨w e_rms²⟩/⟨w⟩)) by plain loops.
    let (mut e, mut response, mut noisy) = ([[0.0; 2]; 2], [0.0; 2], [0.0; 2]);
    for (place, file) in files.split(' ').enumerate() {
        for line in content(file).lines().skip(1) {
            let values: Vec<f64> = line.split(',').map(|own| own.parse().unwrap()).collect();
            let [e1, e2, w, rms, ..] = values[..] else {
                panic!("{line}")
            };
            e[place][0] += w * e1;
            e[place][1] += w * e2;
            response[place] += 2.0 * w * (1.0 - rms * rms);
            noisy[place] += 2.0 * w * (1.0 - 0.5 * (e1 * e1 + e2 * e2) + 0.09);
        }
    }
    let expected = |response: [f64; 2]| {
        [0.03, -0.03].map(|g| {
            let k = usize::from(g < 0.0);
            (e[0][k] / response[0] - e[1][k] / response[1]) / (2.0 * g) - 1.0
        })
    };
    // The first is a ratio for each catalogue, the estimate one of both: the difference is of second order.
    assert_m(&rows(&folder, &files)[0], expected(response), 1e-3);
    let printed = folder.run(&format!("bias {files}"));
    let words = printed.split_whitespace().collect::<Vec<_>>().join(" ");
    let columns = "Columns: HSC Y3.[..]rms_e=i_hsmshaperegauss_derived_rms_e";
    assert_has(&words, columns);
    assert_has(&words, "e_rms from i_hsmshaperegauss_derived_rms_e");
    assert!(!words.contains("Left out"), "{words}");
    // Without the column, the scatter of the catalogue less its noise.
    for file in files.split(' ') {
        let text = (6..10).fold(content(file), |text, k| {
            text.replace(&format!(",0.3{k},"), ",0.3,")
        });
        folder.write(file, text);
    }
    let sigma = "rms_e=none,sigma_e=i_hsmshaperegauss_derived_rms_e";
    let found = rows(&folder, &format!("{files} --columns {sigma}"));
    assert_m(&found[0], expected(noisy), 1e-3);
}

/// Rows of metadetect as its own examples write them: the sheared catalogue as text, the ellipticity as a vector of two, and an
/// identifier above 2⁵³. A text is no weight.
#[test]
fn vectors_texts_and_long_integers_are_read() {
    let folder = Folder::new();
    let first = 1_000_000_000_000_000_000_i64;
    for (name, g) in [("plus", 0.02), ("minus", -0.02)] {
        let base = galaxies(1, [g; 2]);
        let (mut bytes, mut vectors, mut ids, mut names) = (vec![], vec![], vec![], vec![]);
        let mut flat = String::from("shear_type,id,wmom_g_1,wmom_g_2,g1,g2\n");
        for (sheared, shear) in NAMES.into_iter().zip(SHEARS) {
            for (id, [own, _]) in (first..).zip(&base) {
                let e = [0, 1].map(|j| own[j] + 0.8 * shear[j]);
                bytes.extend(format!("{sheared:<7}map").into_bytes());
                bytes.extend(id.to_be_bytes());
                bytes.extend([e[0], e[1], g, g].into_iter().flat_map(f64::to_be_bytes));
                writeln!(flat, "{sheared},{id},{},{},{g},{g}", e[0], e[1]).unwrap();
                vectors.push(Series::new("".into(), e));
                ids.push(id);
                names.push(sheared);
            }
        }
        folder.write(&format!("{name}.csv"), flat);
        let mut cards = vec!["TFIELDS =                    6".to_owned()];
        let formats = ["7A", "3A", "K", "2D", "D", "D"];
        let columns = ["shear_type", "WEIGHT_IMAGE", "ID", "g", "g1", "g2"]
            .into_iter()
            .zip(formats);
        for (k, (column, format)) in (1..).zip(columns) {
            cards.push(format!("TTYPE{k}  = '{column:<8}'"));
            cards.push(format!("TFORM{k}  = '{format:<8}'"));
        }
        let cards: Vec<&str> = cards.iter().map(String::as_str).collect();
        let sides = [7 + 3 + 8 + 4 * 8, ids.len()];
        let primary = crate::support::fits_image(8, &[], &[], &[]);
        let table = fits_extension("BINTABLE", 8, &sides, &cards, &bytes);
        folder.write(&format!("{name}.fits"), [primary, table].concat());
        let count = ids.len();
        let table = frame(vec![
            Column::new("mdet_step".into(), names),
            Column::new("WEIGHT_IMAGE".into(), vec!["map"; count]),
            Column::new("id".into(), ids),
            Column::new("wmom_g".into(), vectors),
            Column::new("g1".into(), vec![g; count]),
            Column::new("g2".into(), vec![g; count]),
        ]);
        let path = folder.at(&format!("{name}.parquet"));
        table::write(
            &path,
            FileFormat::Parquet,
            &table.unwrap(),
            &Default::default(),
        )
        .unwrap();
    }
    let [csv, fits, parquet] = ["csv", "fits", "parquet"].map(|ending| {
        let files = format!("plus.{ending} minus.{ending}");
        let printed = folder.run(&format!("bias {files}"));
        assert_has(&printed, "galaxies with the same identifier");
        rows(&folder, &files)
    });
    // Only rounding is left of shapes and responses.
    assert_m(&csv[0], M, 1e-9);
    assert!((number(&csv[0], "r1") - 0.8).abs() < 1e-9);
    assert_eq!(number(&csv[0], "n"), 2.0 * GALAXIES as f64);
    // Identifiers that are rounded would make 16 units.
    assert!(number(&csv[0], "units") > 500.0, "{}", csv[0]);
    assert_eq!([&fits, &parquet], [&csv; 2]);
}

#[test]
fn sheared_flags_and_weights_give_their_response() {
    let folder = Folder::new();
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let shape = |_| [(); 2].map(|()| rng.random_range(-0.5..0.5));
    let shapes: Vec<[f64; 2]> = (0..20_000).map(shape).collect();
    let failed = |id: usize| id.is_multiple_of(40);
    // The size of a galaxy under a shear that is added to `g`.
    let size = |id: usize, shape: &[f64; 2], g: f64, added: [f64; 2]| {
        let along: f64 = (0..2).map(|k| shape[k] * (g + added[k])).sum();
        0.5 + (id as f64 * 0.618_034).fract() * (1.0 + 2.0 * along)
    };
    for (weighted, name) in [(true, "y3"), (false, "selected")] {
        let weight = |size: f64| match weighted {
            true => 1.0 / (0.2 + 0.5 / size),
            false => 1.0,
        };
        let sheared = |column: &str| {
            NAMES[1..].iter().fold(format!(",{column}"), |all, name| {
                format!("{all},{column}_{name}")
            })
        };
        let weights = if weighted {
            sheared("weight")
        } else {
            String::new()
        };
        let files = pair(&folder, name, 0.02, |g, _| {
            let start = "coadd_object_id,e_1,e_2,R11,R12,R21,R22,g1,g2,flags";
            let mut text = format!("{start}{}{weights}\n", sheared("flags_select"));
            for (id, shape) in shapes.iter().enumerate() {
                let e = match failed(id) {
                    true => [0.7; 2],
                    false => shape.map(|shape| shape + g),
                };
                let flag = u8::from(failed(id));
                write!(text, "{id},{},{},1,0,0,1,{g},{g},{flag}", e[0], e[1]).unwrap();
                let sizes = SHEARS.map(|added| size(id, shape, g, added));
                for size in sizes {
                    write!(text, ",{}", u8::from(size < 0.7)).unwrap();
                }
                for size in sizes.iter().filter(|_| weighted) {
                    write!(text, ",{}", weight(*size)).unwrap();
                }
                text.push('\n');
            }
            text
        });
        // ⟨e⟩ of each catalogue with its own choice and weights in an arm, and the sum of weights.
        let mean = |g: f64, catalogue: usize, k: usize| {
            let mut sums = [0.0; 2];
            for (id, shape) in shapes.iter().enumerate().filter(|(id, _)| !failed(*id)) {
                let size = size(id, shape, g, SHEARS[catalogue]);
                if size >= 0.7 {
                    sums[0] += weight(size) * (shape[k] + g);
                    sums[1] += weight(size);
                }
            }
            (sums[0] / sums[1], sums[1])
        };
        let found = &rows(&folder, &files)[0];
        for k in 0..2 {
            // Each arm has its own response.
            let [plus, minus] = [0.02, -0.02].map(|g| {
                let [plus, minus] = [1, 2].map(|catalogue| mean(g, catalogue + 2 * k, k).0);
                ((plus - minus) / 0.02, mean(g, 0, k).1)
            });
            let expected = 1.0 + (plus.0 * plus.1 + minus.0 * minus.1) / (plus.1 + minus.1);
            let r = number(found, &format!("r{}", k + 1));
            assert!((r - expected).abs() < 1e-9, "{name}: {r}, {expected}");
            // The choice matters.
            assert!((r - 1.0).abs() > 0.02, "{r}");
        }
    }
}

/// Distortions of a method that responds by 0.8 m, of the same galaxies with each artificial shear: e1 and e2 by sheared catalogue.
fn sheared_distortions(g: f64, normal: &mut Normal) -> Vec<[[f64; 2]; 5]> {
    let galaxy = |_| {
        let [s1, s2] = normal.pair(0.2);
        SHEARS.map(|[a1, a2]| {
            let shear = Shear::new(g * (1.0 + M[0]) + a1, a2 - g * (1.0 + M[1]));
            let chi = Shear::new(s1, s2).sheared_by(shear).to_distortion();
            [0.8 * chi.e1, 0.8 * chi.e2]
        })
    };
    (0..GALAXIES).map(galaxy).collect()
}

/// ⟨χ⟩/⟨R⟩ needs no conversion: half of it was m of −0.5, without a word.
#[test]
fn distortions_are_divided_by_the_response_that_they_have() {
    let folder = Folder::new();
    let tables = |name: &str, head: &str, row: &dyn Fn(&[[f64; 2]; 5]) -> String| {
        pair(&folder, name, 0.02, |g, normal| {
            let start = format!("{head},g1,g2\n");
            sheared_distortions(g, normal)
                .iter()
                .fold(start, |text, own| {
                    text + &format!("{},{g},{}\n", row(own), -g)
                })
        })
    };
    let response = |own: &[[f64; 2]; 5], k: usize| (own[1 + 2 * k][k] - own[2 + 2 * k][k]) / 0.02;
    let with_response = |names: &str| {
        let head = format!("{names},R11,R22");
        tables("r", &head, &|own| {
            let [e1, e2] = own[0];
            format!("{e1},{e2},{},{}", response(own, 0), response(own, 1))
        })
    };
    let in_columns = |first: &str| {
        let head: Vec<String> = NAMES
            .iter()
            .flat_map(|name| {
                let end = if *name == "noshear" { "" } else { name };
                let joint = if end.is_empty() { "" } else { "_" };
                [1, 2].map(|k| format!("{first}e{k}{joint}{end}"))
            })
            .collect();
        tables("s", &head.join(","), &|own| {
            let all: Vec<String> = own.iter().flatten().map(f64::to_string).collect();
            all.join(",")
        })
    };
    // 2000 galaxies whose responses scatter by a tenth, of both numerator and denominator.
    let tolerance = 2e-3;
    for names in ["corrected_e1,corrected_e2", "e1,e2"] {
        let files = with_response(names);
        let found = &rows(&folder, &files)[0];
        // Without R12 and R21, whose means in this sample change m by about its error.
        assert_m(found, M, 3.0 * number(found, "m1_error"));
        for option in ["distortion", "responsivity"] {
            let line = format!("bias {files} --ellipticity {option}");
            folder.refuses(&line, "`R11`[..]this response is not used");
        }
    }
    for first in ["corrected_", ""] {
        let files = in_columns(first);
        assert_m(&rows(&folder, &files)[0], M, tolerance);
        // The sheared distortions are converted like the others.
        let line = format!("{files} --ellipticity distortion");
        assert_m(&rows(&folder, &line)[0], M, tolerance);
        let line = format!("bias {files} --ellipticity responsivity");
        folder.refuses(&line, "this response is not used");
    }
}

#[test]
fn measured_shears_are_not_taken_for_true_ones() {
    let folder = Folder::new();
    let table = |name: &str, head: &str, g: fn(f64, f64) -> f64| {
        let mut normal = normal(5);
        let mut text = format!("e1,e2,{head}\n");
        for _ in 0..GALAXIES {
            let ([e1, e2], [n1, n2]) = (normal.pair(0.25), normal.pair(0.03));
            writeln!(text, "{},{},{},{}", e1 + n1, e2 + n2, g(e1, n1), g(e2, n2)).unwrap();
        }
        folder.write(name, text);
    };
    table("a.csv", "gamma1,gamma2", |e, n| (e + n) / 1.35);
    folder.refuses("bias a.csv", "look like measured shears[..]g1=none,g2=none");
    table("b.csv", "g1,g2", |e, n| 0.9 * e - n);
    folder.refuses("bias b.csv", "look like measured shears");
    assert!(rows(&folder, "b.csv --columns g1=none,g2=none")[0]["m1"].is_null());
    // Stated by the user, or scattering like true shears.
    let stated = rows(&folder, "b.csv --columns g1=g1,g2=g2");
    assert!(stated[0]["m1"].is_number());
    table("c.csv", "gamma1,gamma2", |_, n| n);
    assert!(rows(&folder, "c.csv")[0]["m1"].is_number());
}

#[test]
fn catalogues_of_one_list_have_the_same_columns() {
    let folder = Folder::new();
    let table = |name: &str, head: &str| {
        let mut text = format!("{head}\n");
        for (id, galaxy) in galaxies(3, [0.02; 2]).iter().enumerate() {
            let values = head.split(',').map(|name| match name {
                "id" => id as f64,
                "seed" => (id / 2) as f64,
                "e1" | "e_1" => galaxy[0][0],
                "e2" | "e_2" => galaxy[0][1],
                "flag" => f64::from(u8::from(id % 10 == 0)),
                "psf_e1" | "psf_e2" => 0.01 * (id % 7) as f64,
                _ => 1.0 + (id % 3) as f64,
            });
            let values: Vec<String> = values.map(|own| own.to_string()).collect();
            text += &(values.join(",") + "\n");
        }
        folder.write(name, text);
    };
    table("plain.csv", "id,e1,e2");
    folder.write(
        "t.csv",
        "catalogue,g1,g2\nplain.csv,0.02,0.02\nother.csv,-0.02,-0.02\n",
    );
    for (head, role) in [
        ("id,e1,e2,w", "w"),
        ("id,e1,e2,R11,R22", "R11"),
        ("id,e1,e2,flag", "flag"),
        ("e1,e2", "id"),
        ("id,e_1,e_2", "e1"),
        ("id,e1,e2,psf_e1,psf_e2", "psf_e1"),
        ("id,e1,e2,seed", "units"),
    ] {
        table("other.csv", head);
        let expected = format!("not the columns of plain.csv (found `[..]` for {role}, expected");
        let list = "bias plain.csv other.csv --truth t.csv";
        folder.refuses(list, &expected);
    }
    // A column that only the second one has, and a seed of each row.
    let files = pair(&folder, "masked", 0.02, |g, _| {
        let mut text = String::from("id,seed,e1,e2,g1,g2");
        text += if g < 0.0 { ",mask\n" } else { "\n" };
        for (id, galaxy) in galaxies(3, [g; 2]).iter().enumerate() {
            let (seed, [a, b]) = (id as f64 + 1e6 * g, galaxy[0]);
            write!(text, "{id},{seed},{a},{b},{g},{g}").unwrap();
            text += if g < 0.0 { ",0\n" } else { "\n" };
        }
        text
    });
    let found = folder.json(&format!("bias {files}"));
    let notes = found["notes"].to_string();
    assert_has(&notes, ".csv: Not used: mask. Try: --columns flag=mask if");
    assert_has(&notes, "id=id");
    assert!(!notes.contains("same `seed`"), "{notes}");
}

#[test]
fn repeated_rows_values_and_identifiers_are_named() {
    let folder = Folder::new();
    let all = |_: usize| 1;
    let notes = |copies: &dyn Fn(usize) -> usize, id: &dyn Fn(usize) -> usize, zero: usize| {
        let files = pair(&folder, "c", 0.02, |g, _| {
            let mut text = "id,e1,e2,g1,g2\n".to_owned();
            for (row, [[e1, e2], _]) in galaxies(3, [g; 2]).into_iter().enumerate() {
                let (e1, e2) = if row < zero { (0.0, 0.0) } else { (e1, e2) };
                for _ in 0..copies(row) {
                    writeln!(text, "{},{e1},{e2},{g},{g}", id(row)).unwrap();
                }
            }
            text
        });
        folder.json(&format!("bias {files}"))["notes"].to_string()
    };
    let plain = notes(&all, &|row| row, 0);
    assert!(!plain.contains("Repeated"), "{plain}");
    assert_has(
        &notes(&all, &|row| row, 100),
        "Repeated values: `e1` and `e2` are exactly 0 and 0 in 200 of 4000 rows",
    );
    assert_has(
        &notes(&|_| 4, &|row| row, 0),
        "Repeated rows: 12000 of 16000",
    );
    assert_has(
        &notes(&all, &|row| row / 2, 0),
        "Repeated identifiers: 2000 of 4000",
    );
    let half = notes(&all, &|row| if row % 2 == 0 { 0 } else { row }, 0);
    assert_has(&half, "Repeated identifiers: 1998 of 4000");
    // Zeros in 5 % of the rows are a warning, in 0.5 % a remark.
    for (zeros, is_warning) in [(100, true), (10, false)] {
        notes(&all, &|row| row, zeros);
        let said = folder.said("bias c-plus.csv c-minus.csv -q");
        assert_eq!(
            said.contains("warning: repeated values"),
            is_warning,
            "{said}"
        );
    }
}

#[test]
fn shears_of_ksb_and_numbers_of_chips_are_read() {
    let folder = Folder::new();
    let read = |header: &str, row: &dyn Fn(usize, [f64; 2]) -> String| {
        let files = pair(&folder, "k", 0.02, |g, _| {
            let galaxies = galaxies(3, [g; 2]).into_iter().enumerate();
            let rows = galaxies.map(|(at, [e, _])| row(at, e) + &format!(",{g},{g}\n"));
            format!("{header},g1,g2\n{}", rows.collect::<String>())
        });
        number(&rows(&folder, &files)[0], "m1")
    };
    let plain = read("e1,e2", &|_, [e1, e2]| format!("{e1},{e2}"));
    // GalSim's tables of KSB, in which all distortions are −10.
    let ksb = "corrected_e1,corrected_e2,corrected_g1,corrected_g2";
    let ksb = read(ksb, &|_, [e1, e2]| format!("-10,-10,{e1},{e2}"));
    let chips = read("ccd,e1,e2", &|at, [e1, e2]| {
        format!("{:02},{e1},{e2}", at % 62)
    });
    assert_eq!((ksb, chips), (plain, plain));
}

#[test]
fn texts_that_no_row_has_and_angles_in_degrees_are_named() {
    let folder = Folder::new();
    let files = pair(&folder, "c", 0.02, |g, _| {
        let mut text = "band,e,pa,e1,e2,g1,g2\n".to_owned();
        for (row, [[e1, e2], _]) in galaxies(3, [g; 2]).into_iter().enumerate() {
            let (e, pa) = (e1.hypot(e2), e2.atan2(e1).to_degrees() / 2.0);
            let band = ["r", "i"][row % 2];
            writeln!(text, "{band},{e},{pa},{e1},{e2},{g},{g}").unwrap();
        }
        text
    });
    let none = format!("bias {files} --where \"band == 'z'\"");
    folder.refuses(&none, "no galaxy can be used[..]no row has `band == 'z'`");
    let all = format!("bias {files} --where \"band != 'z'\"");
    assert_has(
        &folder.json(&all)["notes"].to_string(),
        "No row has the text of `band == 'z'`",
    );
    let some = format!("bias {files} --where \"band != 'r'\"");
    let notes = folder.json(&some)["notes"].to_string();
    assert!(!notes.contains("No row has"), "{notes}");
    let degrees = "--columns 'e1=e*cos(2*pa),e2=e*sin(2*pa)'";
    folder.refuses(
        &format!("bias {files} {degrees}"),
        "angles up to[..]radians(ANGLE)",
    );
    folder.refuses(
        &format!("bias {files} --where 'cos(pa) > -2'"),
        "radians(ANGLE)",
    );
    let line = format!("{files} --columns 'e1=e*cos(radians(2*pa)),e2=e*sin(radians(2*pa))'");
    let same = rows(&folder, &line)[0]["m1"].as_f64().unwrap();
    let plain = rows(&folder, &files)[0]["m1"].as_f64().unwrap();
    assert!((same - plain).abs() < 1e-9, "{same} {plain}");
    // A condition may start with a minus.
    folder.json(&format!("bias {files} --where '-e1 < 2'"));
}

#[test]
fn formulas_and_bits_of_flags_make_columns() {
    let folder = Folder::new();
    let files = pair(&folder, "q", 0.02, |g, _| {
        let mut text = "P,Q1,Q2,bits,g1,g2\n".to_owned();
        for (row, [[e1, e2], _]) in galaxies(3, [g; 2]).into_iter().enumerate() {
            let (p, bad) = (1.0 + (row % 5) as f64, row % 10 == 0);
            let shift = if bad { 1.0 } else { 0.0 };
            let bits = if bad { 6 } else { 8 * (row % 2) };
            writeln!(text, "{p},{},{},{bits},{g},{g}", (e1 + shift) * p, -e2 * p).unwrap();
        }
        text
    });
    let line = format!("{files} --columns 'e1=Q1/P,e2=-Q2/P,flag=bits & 4'");
    let expected = [0, 1].map(|k| 0.8 * (1.0 + M[k]) - 1.0);
    assert_m(&rows(&folder, &line)[0], expected, 1e-9);
    let line = format!("bias {files} --columns e1=Q1/R,e2=Q2");
    folder.refuses(&line, "there is no column `R`");
}

/// S/N, size and m of simulated galaxies, and their number.
const KINDS: [(f64, f64, f64, usize); 4] = [
    (8.0, 1.0, -0.10, 400),
    (8.0, 2.0, -0.06, 300),
    (20.0, 1.0, -0.03, 200),
    (20.0, 2.0, 0.01, 100),
];

#[test]
fn simulated_galaxies_are_weighted_to_those_of_a_survey() {
    let folder = Folder::new();
    let files = pair(&folder, "sim", 0.02, |g, normal| {
        let mut text = String::from("id,e1,e2,w,snr,size,g1,g2\n");
        let kinds = KINDS.iter().flat_map(|own| std::iter::repeat_n(own, own.3));
        for (id, (snr, size, m, _)) in kinds.enumerate() {
            let [a, b] = normal.pair(0.2).map(|shape| shape + (1.0 + m) * g);
            writeln!(text, "{id},{a},{b},{},{snr},{size},{g},{g}", 1 + id % 3).unwrap();
        }
        text
    });
    // Weights per kind in two tomographic bins, and galaxies that no simulation has.
    let shares = [("1", [4.0, 1.0, 2.0, 1.0]), ("low", [1.0, 1.0, 3.0, 5.0])];
    let mut survey = String::from("snr,size,shape_weight,TOMOBIN,flag,mask\n");
    for (bin, weights) in shares {
        for ((snr, size, ..), weight) in KINDS.iter().zip(weights) {
            for _ in 0..2 {
                writeln!(survey, "{snr},{size},{},{bin},0,0", weight / 2.0).unwrap();
            }
        }
    }
    survey.push_str("60,1,2,low,0,0\n20,9,0,low,0,0\n20,1,50,low,1,0\n");
    folder.write("survey.csv", survey);
    let command = format!("bias {files} --bins snr:5,10,50,90 --bins size:0.5,1.5,2.5");
    // Weights and flags are not left out because of a fault of other columns.
    folder.write("odd.csv", "snr,size,w,R11\n20,1,1,0.7\n");
    let refused = format!("{command} --like odd.csv");
    folder.refuses(&refused, "none for R22 (found snr, size, w, R11)");
    let found = folder.json(&format!("{command} --like survey.csv"));
    let rows = found["rows"].as_array().unwrap();
    let mean = |weights: [f64; 4]| {
        let sum: f64 = KINDS.iter().zip(weights).map(|(own, w)| w * own.2).sum();
        sum / weights.iter().sum::<f64>()
    };
    let all = [0, 1, 2, 3].map(|k| shares[0].1[k] + shares[1].1[k]);
    let expected = [
        ("like survey.csv", mean(all)),
        ("like survey.csv, TOMOBIN 1", mean(shares[0].1)),
        ("like survey.csv, TOMOBIN low", mean(shares[1].1)),
    ];
    assert_eq!(rows.len(), 4);
    for (row, (label, m)) in rows[1..].iter().zip(expected) {
        assert_eq!(row["bin"], label);
        // The shapes cancel, whatever the weights.
        assert_m(row, [m; 2], 1e-9);
        assert_eq!(number(row, "n"), 2000.0);
    }
    // As they are, the simulated galaxies have another m.
    assert!((number(&rows[0], "m1") - expected[0].1).abs() > 0.01);
    let notes = found["notes"].to_string();
    assert_has(&notes, "snr 50 to 90, size 0.5 to 1.5 (10.00 %)");
    assert_has(&notes, "w=shape_weight, flag=flag, tomographic bin=TOMOBIN");
    assert_has(&notes, "Not used of the survey: mask.");
    // A formula weights both, and a condition holds for both.
    let numbers = [3, 1, 2, 4];
    let mut plain = String::from("snr,size\n");
    for ((snr, size, ..), number) in KINDS.iter().zip(numbers) {
        plain += &format!("{snr},{size}\n").repeat(number);
    }
    folder.write("plain.csv", plain.clone());
    let weighted = [0, 1, 2, 3].map(|k| KINDS[k].0 * KINDS[k].1 * numbers[k] as f64);
    let faint = [weighted[0], weighted[1], 0.0, 0.0];
    for (options, weights) in [
        ("", weighted),
        ("--where 'snr < 15'", faint),
        ("--where 'snr - 20'", faint),
    ] {
        let line = format!("{command} --columns w=snr*size {options} --like plain.csv");
        let found = folder.json(&line);
        assert_m(&found["rows"][1], [mean(weights); 2], 1e-9);
    }
    // The survey may write its columns in another case.
    folder.write("capitals.csv", plain.replace("snr,size", "SNR,Size"));
    let capitals = folder.json(&format!("{command} --where 'snr < 15' --like capitals.csv"));
    assert_m(&capitals["rows"][1], [mean([3.0, 1.0, 0.0, 0.0]); 2], 1e-9);
    // Without a survey, bins without galaxies are a mistake.
    folder.refuses(&command, "no galaxy that counts has snr 50 to 90");
}

#[test]
fn paired_galaxies_have_the_error_of_pairs() {
    let folder = Folder::new();
    let files = pair(&folder, "own", 0.02, |g, normal| {
        let mut text = String::from("id,e1,e2,flag,g1,g2\n");
        for id in 0..GALAXIES {
            let [a, b] = normal.pair(0.3);
            // One in a hundred fails under one sign only.
            let flag = u8::from(id % 100 == if g > 0.0 { 3 } else { 53 });
            writeln!(text, "{id},{},{},{flag},{g},{g}", a + 1.1 * g, b + 0.9 * g).unwrap();
        }
        text
    });
    let [all, paired] = ["", " --paired"].map(|option| {
        let line = format!("{files}{option}");
        (folder.run(&format!("bias {line}")), rows(&folder, &line))
    });
    assert_has(&all.0, "count under one of two opposite shears only");
    assert!(number(&all.1[0], "m1_error") > 0.02, "{}", all.1[0]);
    assert_has(&paired.0, "are used: 40 rows have no");
    assert_m(&paired.1[0], [0.1, -0.1], 1e-9);
    assert!(number(&paired.1[0], "m1_error") < 1e-9);
    assert_eq!(number(&paired.1[0], "n"), 2.0 * 0.98 * GALAXIES as f64);
    folder.refuses(
        "bias own-plus.csv --g1 0.02 --g2 0.02 --paired",
        "--paired needs the same galaxies",
    );
    // Without identifiers, the numbers of the rows pair them.
    let shorten =
        "tail -n +3 own-plus.csv | cat head - > short-plus.csv; cp own-minus.csv short-minus.csv";
    shell(
        folder.root(),
        &format!("head -n 1 own-plus.csv > head; {shorten}"),
    );
    folder.refuses(
        "bias short-plus.csv short-minus.csv --paired --columns id=none",
        "no column of identifiers states which of them are the same galaxies",
    );
    folder.run("bias short-plus.csv short-minus.csv --paired");
}

#[test]
fn shears_beside_a_convergence_are_no_reduced_ones() {
    let folder = Folder::new();
    let said = |header: &str, kappa: f64, options: &str| {
        let files = pair(&folder, "g", 0.02, |g, _| {
            let galaxies = galaxies(3, [g; 2]).into_iter();
            let rows = galaxies.map(|[[e1, e2], _]| format!("{e1},{e2},{g},{g},{kappa}\n"));
            format!("e1,e2,{header}\n{}", rows.collect::<String>())
        });
        folder.said(&format!("bias {files} {options}"))
    };
    let advised = "'g1=gamma1/(1-kappa),g2=gamma2/(1-kappa)'";
    let columns = "gamma1,gamma2,kappa";
    assert_has(
        &said(columns, 0.08, ""),
        &format!("Try: --columns {advised}"),
    );
    for (columns, kappa, options) in [
        (columns, 0.08, &*format!("--columns {advised}")),
        (columns, 0.0, ""),
        ("g1,g2,kappa", 0.08, ""),
    ] {
        let said = said(columns, kappa, options);
        assert!(!said.contains("reduced shear"), "{said}");
    }
}

#[test]
fn limits_are_tested_in_each_bin() {
    let folder = Folder::new();
    let files = pair(&folder, "own", 0.02, |g, normal| {
        let mut text = String::from("id,e1,e2,kind,also kind,tile,g1,g2\n");
        for id in 0..300 {
            let [a, b] = normal.pair(0.3);
            // Quotation marks and `*` are characters like any others.
            let kinds = [("disc", 0.0), ("bulge", 0.05), ("star's", 0.0), ("d*", 0.0)];
            let (kind, m) = kinds[id % 4];
            let e = [a, b].map(|shape| shape + (1.0 + m) * g);
            let tile = 374_845_632_990_629_248_i64 + id as i64 % 2;
            writeln!(text, "{id},{},{},{kind},{kind},{tile},{g},{g}", e[0], e[1]).unwrap();
        }
        text
    });
    // Floats merge the two.
    let tiles = rows(&folder, &format!("{files} --bins tile"));
    let counts: Vec<f64> = tiles.iter().map(|row| number(row, "n")).collect();
    assert_eq!(counts, [600.0, 300.0, 300.0]);
    let line = format!("bias {files} --bins kind --fail-above m=0.02");
    let output = shell(folder.root(), &format!("shearq {line}"));
    let [printed, told] =
        [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text));
    assert_eq!(output.status.code(), Some(1));
    assert_has(&told, "kind bulge: |m1| exceeds its limit");
    assert!(!told.contains("disc") && !told.contains("all:"), "{told}");
    assert_has(&printed, "Exceeds its limit");
    for column in ["kind", "`also kind`"] {
        let found = rows(&folder, &format!("{files} --bins '{column}'"));
        let bins: Vec<&str> = found
            .iter()
            .map(|row| row["bin"].as_str().unwrap())
            .collect();
        let kinds = ["bulge", "d*", "disc", "star's"].map(|kind| format!("{column} {kind}"));
        assert_eq!(bins[0], "all");
        assert_eq!(bins[1..], kinds);
        assert_m(&found[1], [0.05; 2], 1e-9);
        // `d*` is a text, and not a pattern that discs fit.
        assert_eq!(number(&found[2], "n"), 150.0);
    }
}

/// A table of the same galaxies under a shear: its columns by name, in a row.
type Columns<'a> = &'a dyn Fn(usize, [f64; 2]) -> Vec<String>;

fn table_of(folder: &Folder, name: &str, g: f64, header: &str, columns: Columns<'_>) {
    let mut text = header.to_owned() + "\n";
    for (row, [e, _]) in galaxies(3, [g; 2]).into_iter().enumerate() {
        text += &(columns(row, e).join(",") + "\n");
    }
    folder.write(name, text);
}

#[test]
fn baselines_compare_galaxies_columns_and_bins() {
    let folder = Folder::new();
    // Ellipticities times a factor, which depends on the bin.
    let write = |header: &str, id: &dyn Fn(usize) -> String, factor: [f64; 2]| {
        for (name, g) in [("p.csv", 0.02), ("m.csv", -0.02)] {
            table_of(&folder, name, g, header, &|row, [e1, e2]| {
                let factor = factor[row % 2];
                let own = |name: &str| match name {
                    "e1" => (e1 * factor).to_string(),
                    "e2" => (e2 * factor).to_string(),
                    "g1" | "g2" => g.to_string(),
                    "snr" => (10 + 10 * (row % 2)).to_string(),
                    "seed" => (row / 5).to_string(),
                    "id" => id(row),
                    _ => "1".to_owned(),
                };
                header.split(',').map(own).collect()
            });
        }
    };
    let header = "id,e1,e2,w,g1,g2,snr";
    let number = |row: usize| row.to_string();
    write(header, &number, [1.0; 2]);
    folder.run("baseline record all -- bias p.csv m.csv");
    folder.run("baseline record bins -- bias p.csv m.csv --bins snr:5,15,25");
    folder.run("baseline check");
    let other = "the galaxies are not the baseline's";
    let moved = [1.005; 2];
    write(header, &number, moved);
    folder.refuses("baseline check all", "1 of 1 configurations moved");
    write(header, &|row| (row + 7000).to_string(), moved);
    folder.refuses("baseline check all", other);
    write(header, &|row| (row + 7).to_string(), moved);
    folder.refuses("baseline check all", other);
    write(header, &|row| format!("galaxy{row}"), moved);
    folder.refuses("baseline check all", other);
    write(&format!("{header},seed"), &number, moved);
    folder.refuses("baseline check all", &format!("{other}[..]units by `seed`"));
    write("id,e1,e2,g1,g2,snr", &number, [1.0; 2]);
    let output = shell(folder.root(), "shearq baseline check all");
    assert_eq!(output.status.code(), Some(1));
    assert_has(
        &String::from_utf8_lossy(&output.stdout),
        "the setting changed: w: w ≠ none",
    );
    // m of both together is the same.
    write(header, &number, [1.02, 0.98]);
    folder.run("baseline check all");
    let output = shell(folder.root(), "shearq baseline check bins");
    assert_eq!(output.status.code(), Some(1));
    assert_has(&String::from_utf8_lossy(&output.stdout), "m1, snr 5");
    for (option, remedy) in [
        ("--fail-above m=1e-9", "--tolerance"),
        ("--bins snr:5,15,25 --like p.csv", "without --like"),
    ] {
        folder.refuses(
            &format!("baseline record more -- bias p.csv m.csv {option}"),
            remedy,
        );
    }
}

#[test]
fn both_sides_of_a_comparison_are_judged() {
    let folder = Folder::new();
    let header = "id,e1,e2,flag,g1,g2";
    type Change<'a> = &'a dyn Fn(f64, usize) -> (String, bool, f64);
    let write = |name: &str, change: Change<'_>| {
        for (sign, g) in [("p", 0.02), ("m", -0.02)] {
            table_of(
                &folder,
                &format!("{name}-{sign}.csv"),
                g,
                header,
                &|row, [e1, e2]| {
                    let (id, flagged, g) = change(g, row);
                    let flag = u8::from(flagged).to_string();
                    let [e1, e2, g] = [e1, e2, g].map(|own| own.to_string());
                    vec![id, e1, e2, flag, g.clone(), g]
                },
            );
        }
        format!("{name}-p.csv {name}-m.csv")
    };
    let id = |row: usize| row.to_string();
    let own = write("own", &|g, row| (id(row), false, g));
    let against = |theirs: &str| {
        let line = format!("bias {own} --against {theirs}");
        (folder.said(&format!("{line} -q")), folder.run(&line))
    };
    let (said, _) = against(&own);
    assert_eq!(said, "");
    let disjoint = write("ids", &|g, row| (id(row + 10_000), false, g));
    assert_has(
        &against(&disjoint).0,
        "--against: the galaxies of both sides do not pair by[..]different galaxies",
    );
    let flagged = write("flags", &|g, row| (id(row), (row % 2 == 0) == (g > 0.0), g));
    let (said, printed) = against(&flagged);
    assert_has(
        &said,
        "--against: about[..]under one of two opposite shears",
    );
    assert_has(&printed, "--against: Left out: 2000 rows with a flag");
    let truth = write("truth", &|g, row| (id(row), false, 1.5 * g));
    folder.refuses(
        &format!("bias {own} --against {truth}"),
        "other true shears (found (-0.020000, -0.020000)",
    );
    // Flags of the other sign in one catalogue: few galaxies of one count, and none under both.
    let inverted = write("not", &|g, row| (id(row), (row % 50 == 0) == (g > 0.0), g));
    assert_has(
        &folder.said(&format!("bias {inverted} -q")),
        "under one of two opposite shears only",
    );
}

#[test]
fn catalogues_without_a_row_that_counts_are_named() {
    let folder = Folder::new();
    let write = |name: &str, g: f64, flag: u8| {
        table_of(&folder, name, g, "id,e1,e2,flag,g1,g2", &|row, [e1, e2]| {
            let numbers = [row as f64, e1, e2, f64::from(flag), g, g];
            numbers.map(|own| own.to_string()).to_vec()
        });
    };
    write("plus.csv", 0.02, 0);
    write("minus.csv", -0.02, 1);
    let none = "minus.csv: no row of this catalogue counts (found 2000 rows: 2000 with a flag";
    folder.refuses("bias plus.csv minus.csv", none);
    folder.write("minus.csv", "id,e1,e2,flag,g1,g2\n");
    folder.refuses("bias plus.csv minus.csv", "counts (found 0 rows");
    write("minus.csv", -0.02, 0);
    folder.run("bias plus.csv minus.csv");
}

#[test]
fn galaxies_are_not_warned_of_if_their_identifiers_pair() {
    let folder = Folder::new();
    let mut files = Vec::new();
    // Catalogues p0, p1, m1 and m0.
    for (name, g, first) in [
        ("a", 0.02, 0),
        ("b", 0.02, 1000),
        ("c", -0.02, 1000),
        ("d", -0.02, 0),
    ] {
        let mut text = "id,e1,e2,g1,g2\n".to_owned();
        let all = galaxies(3, [g; 2]).into_iter().enumerate();
        for (id, [[e1, e2], _]) in all.skip(first).take(1000) {
            writeln!(text, "{id},{e1},{e2},{g},{g}").unwrap();
        }
        folder.write(&format!("{name}.csv"), text);
        files.push(format!("{name}.csv"));
    }
    assert_eq!(folder.said(&format!("bias {} -q", files.join(" "))), "");
}

#[test]
fn places_in_other_units_than_pixels_are_refused() {
    let folder = Folder::new();
    let mut normal = normal(4);
    let write = |unit: f64, normal: &mut Normal| {
        let (mut catalogue, mut truth) = ("x,y,e1,e2\n".to_owned(), "x,y,g1,g2\n".to_owned());
        for row in 0..400 {
            let [x, y] = [row % 20, row / 20].map(|k| unit * f64::from(k));
            let [g1, g2] = normal.pair(0.02);
            writeln!(catalogue, "{x},{y},{},{}", g1 + 1e-4 * x, g2).unwrap();
            // One in ten is absent.
            if row % 10 != 0 {
                writeln!(truth, "{x},{y},{g1},{g2}").unwrap();
            }
        }
        folder.write("c.csv", catalogue);
        folder.write("t.csv", truth);
    };
    let line = "bias c.csv --truth t.csv --truth-sign standard";
    for (unit, words) in [
        (0.01, "places have another true shear within 1"),
        // Neighbours are a unit apart, and the radius contains them.
        (1.0, "have another true shear within 1"),
        (48.0, "no galaxy within 1 pixel"),
    ] {
        write(unit, &mut normal);
        folder.refuses(line, words);
    }
    folder.run(&format!("{line} --drop-missing"));
    // Sparse places of which one in ten has a neighbour that is absent from the table.
    let (mut catalogue, mut truth) = ("x,y,e1,e2\n".to_owned(), "x,y,g1,g2\n".to_owned());
    for row in 0..400 {
        let x = 10.0 * f64::from(row);
        let [g1, g2] = normal.pair(0.02);
        writeln!(catalogue, "{x},0,{g1},{g2}").unwrap();
        writeln!(truth, "{x},0,{g1},{g2}").unwrap();
        if row % 10 == 0 {
            writeln!(catalogue, "{},0.5,{g2},{g1}", x + 0.5).unwrap();
        }
    }
    folder.write("c.csv", catalogue);
    folder.write("t.csv", truth);
    folder.refuses(line, "40 of 440 rows are within 1 pixel of a place");
}

#[test]
fn bits_above_those_of_floats_are_read_from_integers() {
    let folder = Folder::new();
    for (sign, g) in [("plus", 0.02), ("minus", -0.02)] {
        let all = galaxies(3, [g; 2]);
        let bad = |row: usize| row.is_multiple_of(10);
        let column = |name: &str, of: &dyn Fn(usize) -> f64| {
            Column::new(name.into(), (0..all.len()).map(of).collect::<Vec<f64>>())
        };
        let shift = |row: usize| if bad(row) { 1.0 } else { 0.0 };
        let bits = |row: usize| i64::from(bad(row)) * 5 + ((row as i64 % 2) << 60);
        let bits: Vec<i64> = (0..all.len()).map(bits).collect();
        let table = frame(vec![
            column("e1", &|row| all[row][0][0] + shift(row)),
            column("e2", &|row| all[row][0][1]),
            Column::new("bits".into(), bits.clone()),
            column("g1", &|_| g),
            column("g2", &|_| g),
        ]);
        let path = folder.at(&format!("{sign}.parquet"));
        let table = table.unwrap();
        table::write(&path, FileFormat::Parquet, &table, &Default::default()).unwrap();
        let mut text = "e1,e2,bits,g1,g2\n".to_owned();
        for (row, bits) in bits.iter().enumerate() {
            let [e1, e2] = all[row][0];
            writeln!(text, "{},{e2},{bits},{g},{g}", e1 + shift(row)).unwrap();
        }
        folder.write(&format!("{sign}.csv"), text);
    }
    let expected = [0, 1].map(|k| 0.8 * (1.0 + M[k]) - 1.0);
    for option in ["--columns 'flag=bits & 4'", "--where 'not bits & 4 == 4'"] {
        let found = rows(&folder, &format!("plus.parquet minus.parquet {option}"));
        assert_eq!(number(&found[0], "n"), 0.9 * 2.0 * GALAXIES as f64);
        assert_m(&found[0], expected, 1e-9);
        folder.refuses(
            &format!("bias plus.csv minus.csv {option}"),
            "column `bits` has numbers of 2⁵³ or more",
        );
    }
}

#[test]
fn names_that_occur_twice_are_refused_and_exact_ones_preferred() {
    let folder = Folder::new();
    for (name, g) in [("p.csv", 0.02), ("m.csv", -0.02)] {
        table_of(&folder, name, g, "E1,E2,e1,e2,g1,g2", &|_, [e1, e2]| {
            let numbers = [2.0 * e1, 2.0 * e2, e1, e2, g, g];
            numbers.map(|own| own.to_string()).to_vec()
        });
    }
    let expected = [0, 1].map(|k| 0.8 * (1.0 + M[k]) - 1.0);
    assert_m(&rows(&folder, "p.csv m.csv")[0], expected, 1e-9);
    let names = ["e1", "e1", "e2", "g1", "g2"];
    let mut cards = vec!["TFIELDS =                    5".to_owned()];
    for (k, name) in (1..).zip(names) {
        cards.push(format!("TTYPE{k}  = '{name:<8}'"));
        cards.push(format!("TFORM{k}  = 'D       '"));
    }
    let cards: Vec<&str> = cards.iter().map(String::as_str).collect();
    let rows = (0..10).flat_map(|row| [0.1, 0.2, 0.1 * f64::from(row), 0.02, 0.02]);
    let bytes: Vec<u8> = rows.flat_map(f64::to_be_bytes).collect();
    let head = fits_image(8, &[], &["EXTEND  =                    T"], &[]);
    let table = fits_extension("BINTABLE", 8, &[40, 10], &cards, &bytes);
    folder.write("twice.fits", [head, table].concat());
    folder.refuses("bias twice.fits", "two columns named `e1`");
}

/// A baseline of catalogues of a shear field whose axes changed, and a description with the axes of the catalogues.
#[test]
fn axes_of_a_shear_field_are_compared_and_turned() {
    let folder = Folder::new();
    // Fewer cells determine no convention.
    folder.run("simulate --fixed-psf one --images 2 --grid 16 --seed 5 --out data --sets 2");
    let truth = folder.numbers("data/set02/truth.csv", ["x", "y", "g1", "g2"]);
    let write = |sign: f64| {
        for image in 1..=2 {
            let mut normal = normal(image);
            let mut text = "x,y,e1,e2,R11,R22,R12,R21\n".to_owned();
            let [x, y, g1, g2] = &truth;
            let shears = g1.iter().zip(g2);
            for ((x, y), (g1, g2)) in x.iter().zip(y).zip(shears) {
                let [a, b] = normal.pair(1e-3);
                let (e1, e2) = (0.8 * g1 + a, sign * (0.8 * g2 + 0.3 * g1 + b));
                writeln!(text, "{x},{y},{e1},{e2},0.8,0.8,0,{}", sign * 0.3).unwrap();
            }
            folder.write(&format!("c-{image}.csv"), text);
        }
    };
    let description = "name = \"F\"\ncatalogues = \"c-{image}.csv\"\n";
    folder.write("own.toml", description);
    folder.write("turned.toml", format!("{description}e2_sign = -1\n"));
    let score = |name: &str| {
        let line = format!("score --data data --foreign {name}.toml --sets 2 --convention 5");
        let found = folder.json(&line);
        found["rows"][0]["q"].as_f64().unwrap()
    };
    write(1.0);
    let expected = score("own");
    let line = "score --data data --foreign own.toml --sets 2";
    folder.run(&format!("baseline record own -- {line}"));
    assert_has(&folder.run("baseline check"), "convention: 5 (standard)");
    write(-1.0);
    let turned = score("turned");
    assert!(
        (turned / expected - 1.0).abs() < 1e-9,
        "{turned} {expected}"
    );
    let output = shell(folder.root(), "shearq baseline check");
    assert_eq!(output.status.code(), Some(1));
    assert_has(
        &String::from_utf8_lossy(&output.stdout),
        "the setting changed: convention: 5 (standard) ≠ 6 (e2 flipped)",
    );
    folder.run("baseline check --update");
    folder.run("baseline check");
}

#[test]
fn sums_with_other_true_shears_do_not_merge() {
    let folder = Folder::new();
    for (name, g) in [("p.csv", 0.02), ("m.csv", -0.02)] {
        table_of(&folder, name, g, "id,e1,e2", &|row, [e1, e2]| {
            [row as f64, e1, e2].map(|own| own.to_string()).to_vec()
        });
    }
    let shard = |number: usize, g: f64| {
        folder.write(
            "t.csv",
            format!("catalogue,g1,g2\np.csv,{g},{g}\nm.csv,-{g},-{g}\n"),
        );
        folder.run(&format!(
            "bias p.csv m.csv --truth t.csv --shard {number}/2 --sums s{number}"
        ));
    };
    shard(1, 0.02);
    shard(2, 0.03);
    folder.refuses("bias --merge s1 s2", "different true shears in --truth");
    shard(2, 0.02);
    folder.run("bias --merge s1 s2");
}

#[test]
fn sheared_rows_that_never_count_are_refused() {
    let folder = Folder::new();
    let write = |name: &str, g: f64, flagged: &str| {
        let mut text = "metastep,e1,e2,flags,g1,g2\n".to_owned();
        for (step, shear) in NAMES.iter().zip(SHEARS) {
            let flag = u8::from(*step == flagged);
            for [e, r] in galaxies(1, [g; 2]) {
                let [e1, e2] = [0, 1].map(|k| e[k] + r[k] * shear[k]);
                writeln!(text, "{step},{e1},{e2},{flag},{g},{g}").unwrap();
            }
        }
        folder.write(name, text);
    };
    write("plus.csv", 0.02, "1p");
    write("minus.csv", -0.02, "");
    folder.refuses(
        "bias plus.csv minus.csv",
        "plus.csv: there is no row of 1p that counts",
    );
}

#[test]
fn galaxies_that_select_left_out_do_not_count() {
    let folder = Folder::with_set(2);
    folder.measure("--submission 48/linear/star");
    folder.run("select --measured out --where 'x < 200' --out selected");
    let found = folder.json("bias selected");
    let notes = found["notes"].to_string();
    assert!(!notes.contains("Repeated values"), "{notes}");
    assert_has(&notes, "rows with a weight of zero or less");
    assert!(number(&found["rows"][0], "n") < 128.0, "{found}");
}

#[test]
fn ellipticities_of_the_psf_turn_with_those_of_galaxies() {
    let folder = Folder::new();
    for (name, sign) in [("right", 1.0), ("mirrored", -1.0)] {
        pair(&folder, name, 0.02, |g, normal| {
            let mut text = "id,e1,e2,R11,R22,psf_e1,psf_e2,g1,g2\n".to_owned();
            for id in 0..GALAXIES {
                let (noise, psf) = (normal.pair(0.2), normal.pair(0.05));
                let e = [0, 1].map(|k| g + noise[k] + [0.1, 0.3][k] * psf[k]);
                let [e2, psf2] = [e[1], psf[1]].map(|x| sign * x);
                let [e1, psf1] = [e[0], psf[0]];
                writeln!(text, "{id},{e1},{e2},1,1,{psf1},{psf2},{g},{g}").unwrap();
            }
            text
        });
    }
    let found = ["right", "mirrored"].map(|name| {
        let columns = match name {
            "mirrored" => "--columns e2=-e2",
            _ => "",
        };
        let line = format!("{name}-plus.csv {name}-minus.csv {columns}");
        rows(&folder, &line)[0].clone()
    });
    for (key, expected) in [("alpha1", 0.1), ("alpha2", 0.3)] {
        let [right, mirrored] = found.each_ref().map(|row| number(row, key));
        // Their errors are 0.2/0.05/√4000 = 0.06.
        assert!((right - expected).abs() < 0.2, "{key}: {right}");
        assert!(
            (mirrored - right).abs() < 1e-12,
            "{key}: {right} {mirrored}"
        );
    }
}
