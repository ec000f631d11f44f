//! `score` and `bias` use one sign of the true g2: the stated one, else one that is significant, else none.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::support::{fail, succeed, text};

const SIDE: usize = 24;

/// Shears of all cells in the standard sign.
type Field = Vec<[f64; 2]>;

/// Normal numbers of this rms.
fn random(seed: u64, rms: f64) -> Field {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
    (0..SIDE * SIDE)
        .map(|_| [rms * normal(), rms * normal()])
        .collect()
}

/// E modes: γ(k) has the phase 2φ of its wave vector.
fn waves() -> Field {
    let of = |cell: usize| {
        let (x, y) = ((cell % SIDE) as f64, (cell / SIDE) as f64);
        let mut g = [0.0; 2];
        for (k, (kx, ky)) in [
            (1.0, 2.0),
            (3.0, -1.0),
            (-2.0, 5.0),
            (6.0, 3.0),
            (4.0, -7.0),
        ]
        .into_iter()
        .enumerate()
        {
            let phase = std::f64::consts::TAU * (kx * x + ky * y) / SIDE as f64 + k as f64;
            let norm = 0.03 * phase.cos() / (kx * kx + ky * ky);
            g[0] += norm * (kx * kx - ky * ky);
            g[1] += norm * 2.0 * kx * ky;
        }
        g
    };
    (0..SIDE * SIDE).map(of).collect()
}

/// A table with a row per cell: `first` names its leading columns, positions or numbers.
fn table(path: &Path, first: &str, names: &str, comment: &str, rows: &Field) {
    let mut text = format!("{first},{names}\n{comment}");
    for (cell, [a, b]) in rows.iter().enumerate() {
        let place = [cell % SIDE, cell / SIDE].map(|k| 24.5 + 48.0 * k as f64);
        match first {
            "id" => write!(text, "{cell}").unwrap(),
            _ => write!(text, "{},{}", place[0], place[1]).unwrap(),
        }
        writeln!(text, ",{a},{b}").unwrap();
    }
    fs::write(path, text).unwrap();
}

fn sum(a: &Field, b: &Field) -> Field {
    let pairs = a.iter().zip(b);
    pairs.map(|(a, b)| [a[0] + b[0], a[1] + b[1]]).collect()
}

/// The true shears as a file with this sign contains them.
fn written(field: &Field, sign: &str) -> Field {
    let factor = if sign == "challenge" { -1.0 } else { 1.0 };
    field.iter().map(|[g1, g2]| [*g1, factor * g2]).collect()
}

/// Files of a truth and of two images.
struct Case {
    folder: tempfile::TempDir,
    images: Vec<PathBuf>,
}

impl Case {
    fn new(measured: &Field, noise: f64) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let image = |k: u64| {
            let path = folder.path().join(format!("catalogue-{k}.csv"));
            table(&path, "x,y", "e1,e2", "", &sum(measured, &random(k, noise)));
            path
        };
        let images = vec![image(1), image(2)];
        Case { folder, images }
    }

    fn truth(&self, first: &str, comment: &str, rows: &Field) -> PathBuf {
        let path = self.folder.path().join("truth.csv");
        table(&path, first, "g1,g2", comment, rows);
        path
    }

    fn arguments<'a>(
        &'a self,
        command: &'a str,
        truth: &'a Path,
        more: &[&'a str],
    ) -> Vec<&'a str> {
        let mut all = vec![command, "--truth", text(truth)];
        all.extend(self.images.iter().map(|path| text(path)));
        all.extend(more);
        all
    }

    /// What a command prints, without line breaks.
    fn printed(&self, command: &str, truth: &Path, more: &[&str]) -> String {
        let printed = succeed(&self.arguments(command, truth, more));
        printed.split_whitespace().collect::<Vec<_>>().join(" ")
    }

    /// Both commands use this sign for this reason, and m2 of `bias` is small.
    fn agree(&self, truth: &Path, more: &[&str], sign: &str, why: &str) {
        let line = format!("Sign of g2 in the truth: {sign}, {why}");
        for command in ["score", "bias"] {
            let printed = self.printed(command, truth, more);
            assert!(printed.contains(&line), "{command}: {line}: {printed}");
        }
        let found =
            succeed(&self.arguments("bias", truth, &[more, &["--format", "json"]].concat()));
        let found: serde_json::Value = serde_json::from_str(&found).unwrap();
        let m = found["rows"][0]["m2"].as_f64().unwrap();
        // Noise of 0.01 of 1152 galaxies on shears of 0.02 is 0.015.
        assert!(m.abs() < 0.08, "{line}: {m}");
    }

    /// Both commands refuse the truth and name the option.
    fn refuse(&self, truth: &Path) {
        for command in ["score", "bias"] {
            let error = fail(&self.arguments(command, truth, &[]));
            assert!(
                error.contains("truth.csv: cannot determine the sign of g2")
                    && error.contains("--truth-sign standard"),
                "{command}: {error}"
            );
        }
    }
}

#[test]
fn score_and_bias_use_one_sign_of_the_true_g2() {
    for (field, why) in [
        (waves(), "in which the true shear is an E-mode field"),
        (random(9, 0.03), "which e2 of the catalogues follows"),
    ] {
        let case = Case::new(&field, 0.01);
        for sign in ["standard", "challenge"] {
            let rows = written(&field, sign);
            let plain = case.truth("x,y", "", &rows);
            case.agree(&plain, &[], sign, why);
            case.agree(&plain, &["--truth-sign", sign], sign, "as specified");
            let stated = case.truth("x,y", &format!("# g2sign: {sign}\n"), &rows);
            case.agree(&stated, &[], sign, "as the file states");
            let other = if sign == "standard" {
                "challenge"
            } else {
                "standard"
            };
            for command in ["score", "bias"] {
                let error = fail(&case.arguments(command, &stated, &["--truth-sign", other]));
                let expected =
                    format!("the file states `g2sign: {sign}`, but `{other}` was specified");
                assert!(error.contains(&expected), "{command}: {error}");
            }
        }
    }
    // Shapes of 0.3 hide a slope of 1: 0.3/0.03/√1152 = 0.3.
    let noisy = Case::new(&random(9, 0.03), 0.3);
    noisy.refuse(&noisy.truth("x,y", "", &random(9, 0.03)));
    for command in ["score", "bias"] {
        let truth = noisy.truth("x,y", "", &random(9, 0.03));
        succeed(&noisy.arguments(command, &truth, &["--truth-sign", "standard"]));
        let zero: Field = random(9, 0.03).iter().map(|g| [g[0], 0.0]).collect();
        let printed = noisy.printed(command, &noisy.truth("x,y", "", &zero), &[]);
        assert!(!printed.contains("Sign of g2"), "{printed}");
    }
    // E-mode fields need no catalogues.
    let noisy = Case::new(&waves(), 0.3);
    let plain = noisy.truth("x,y", "", &written(&waves(), "challenge"));
    for command in ["score", "bias"] {
        let printed = noisy.printed(command, &plain, &[]);
        assert!(
            printed.contains("truth: challenge, in which"),
            "{command}: {printed}"
        );
    }
}

#[test]
fn tables_by_identifier_follow_the_same_rule_in_shards_too() {
    let field = random(9, 0.03);
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let files: Vec<PathBuf> = [1, 2].map(|k| at(&format!("c-{k}.csv"))).into();
    let truth = at("truth.csv");
    let measure = |noise: f64| {
        for (k, file) in (1..).zip(&files) {
            table(file, "id", "e1,e2", "", &sum(&field, &random(k, noise)));
        }
    };
    measure(0.01);
    table(&truth, "id", "g1,g2", "", &written(&field, "challenge"));
    let arguments = [
        "bias",
        "--truth",
        text(&truth),
        text(&files[0]),
        text(&files[1]),
    ];
    let whole = succeed(&arguments);
    assert!(
        whole.contains("Sign of g2 in the truth: challenge, which e2"),
        "{whole}"
    );
    let sums: Vec<PathBuf> = ["1", "2"].map(|k| at(&format!("sums-{k}"))).into();
    for (k, path) in (1..).zip(&sums) {
        let shard = format!("{k}/2");
        succeed(&[&arguments[..], &["--shard", &shard, "--sums", text(path)]].concat());
    }
    let merged = succeed(&["bias", "--merge", text(&sums[0]), text(&sums[1])]);
    assert_eq!(merged, whole);
    // Sums with the other sign do not belong to them.
    table(
        &truth,
        "id",
        "g1,g2",
        "# g2sign: standard\n",
        &written(&field, "challenge"),
    );
    let error = fail(&arguments);
    assert!(
        error.contains("e2 follows minus the true g2")
            && error.contains("the statement `standard`"),
        "{error}"
    );
    succeed(
        &[
            &arguments[..],
            &["--shard", "2/2", "--sums", text(&sums[1])],
        ]
        .concat(),
    );
    let error = fail(&["bias", "--merge", text(&sums[0]), text(&sums[1])]);
    assert!(error.contains("different signs of g2"), "{error}");
    measure(0.3);
    table(&truth, "id", "g1,g2", "", &field);
    let error = fail(&arguments);
    assert!(error.contains("cannot determine the sign of g2"), "{error}");
    let error = fail(
        &[
            &arguments[..],
            &["--shard", "1/2", "--sums", text(&sums[0])],
        ]
        .concat(),
    );
    assert!(error.contains("cannot determine the sign of g2"), "{error}");
}
