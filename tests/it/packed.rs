//! Packed submissions: the same bytes each time, verified by their manifest, unpacked whole or not at all.

use std::fs;
use std::path::{Path, PathBuf};

use flate2::Compression;
use flate2::write::GzEncoder;

use crate::submitted::Packed;
use crate::support::{contents, fail, succeed, text};

fn pack(packed: &Packed, out: &Path) {
    let measured = packed.at("out");
    let command = ["pack", "--measured", text(&measured), "--method", "NN"];
    succeed(&[&command, &["--out", text(out)][..]].concat());
}

/// Packs an archive of `files`, as anyone could.
fn archive(path: &Path, files: &[(&str, &[u8])]) {
    let file = fs::File::create(path).unwrap();
    let mut builder = tar::Builder::new(GzEncoder::new(file, Compression::fast()));
    for (name, content) in files {
        let mut header = tar::Header::new_gnu();
        header.set_size(content.len() as u64);
        header.set_mode(0o644);
        // `set_path` refuses some of the names that a reader must refuse.
        header.as_old_mut().name[..name.len()].copy_from_slice(name.as_bytes());
        header.set_cksum();
        builder.append(&header, *content).unwrap();
    }
    builder.into_inner().unwrap().finish().unwrap();
}

#[test]
fn archives_are_reproducible_and_unpack_to_what_was_packed() {
    let packed = Packed::new();
    let (one, two, out) = (
        packed.at("one.tar.gz"),
        packed.at("two.tgz"),
        packed.at("unpacked"),
    );
    pack(&packed, &one);
    pack(&packed, &two);
    assert_eq!(fs::read(&one).unwrap(), fs::read(&two).unwrap());
    // No time and no system in gzip's header (RFC 1952: MTIME at 4 to 7, OS at 9).
    assert_eq!(fs::read(&one).unwrap()[4..10], [0, 0, 0, 0, 0, 255]);
    succeed(&["unpack", text(&one), "--out", text(&out), "--verify"]);
    assert_eq!(contents(&out), contents(&packed.at("sent")));
    succeed(&["unpack", text(&one), "--verify"]);
    assert_eq!(packed.check(&one), (vec![], 0));
    let manifest = fs::read_to_string(out.join("manifest.json")).unwrap();
    for held in [
        "\"method\": \"NN\"",
        "g10_v1_objs_8_2.NN.dat",
        "\"lambda\"",
        "\"seed\"",
    ] {
        // The seed is that of the simulation, where there is one.
        assert_eq!(manifest.contains(held), held != "\"seed\"", "{held}");
    }
    // What is there is not touched.
    for arguments in [
        ["unpack", text(&one), "--out", text(&out)],
        ["unpack", text(&one), "--out", text(&one)],
    ] {
        assert!(fail(&arguments).contains("exists already"));
    }
    let (measured, sent) = (packed.at("out"), packed.at("sent"));
    let before = fs::read(&one).unwrap();
    for there in [&sent, &one] {
        let again = ["pack", "--measured", text(&measured), "--out", text(there)];
        assert!(fail(&again).contains("exists already; expected a new"));
    }
    assert_eq!(fs::read(&one).unwrap(), before);
}

/// What `score` prints of a submission or catalogues, as numbers by name.
fn scores(packed: &Packed, input: &[&str]) -> serde_json::Value {
    let data = packed.at("data");
    let arguments = [&["score", "--data", text(&data), "--format", "json"], input];
    let mut found: serde_json::Value = serde_json::from_str(&succeed(&arguments.concat())).unwrap();
    found["rows"].take()
}

/// ASCII keeps nine decimals of ellipticities and thirteen digits of powers.
fn assert_close(found: &serde_json::Value, expected: &serde_json::Value) {
    let (found, expected) = (
        found["q"].as_f64().unwrap(),
        expected["q"].as_f64().unwrap(),
    );
    assert!((found / expected - 1.0).abs() < 1e-6, "{found} {expected}");
}

#[test]
fn a_submission_is_scored_as_it_is_sent() {
    let packed = Packed::new();
    let (out, sent) = (packed.at("out"), packed.at("sent"));
    let measured = scores(&packed, &["--measured", text(&out)]);
    let folder = scores(&packed, &["--packed", text(&sent)]);
    assert_close(&folder[0], &measured[0]);
    // As `tar czf … -C folder .` packs it.
    let archive_path = packed.at("by-tar.tgz");
    let file = fs::File::create(&archive_path).unwrap();
    let mut builder = tar::Builder::new(GzEncoder::new(file, Compression::fast()));
    builder.append_dir_all(".", &sent).unwrap();
    builder.into_inner().unwrap().finish().unwrap();
    assert_eq!(scores(&packed, &["--packed", text(&archive_path)]), folder);
    assert_eq!(packed.check(&archive_path), (vec![], 0));
    let unpacked = packed.at("unpacked");
    succeed(&[
        "unpack",
        text(&archive_path),
        "--verify",
        "--out",
        text(&unpacked),
    ]);
    assert_eq!(contents(&unpacked), contents(&sent));
    let spectra = packed.at("spectra.tar.gz");
    let pack = ["pack", "--measured", text(&out), "--method", "NN"];
    succeed(&[&pack[..], &["--kind", "spectra", "--out", text(&spectra)]].concat());
    assert_close(
        &scores(&packed, &["--packed", text(&spectra)])[0],
        &measured[0],
    );
    let refused = |path: &Path, expected: &str| {
        let data = packed.at("data");
        let message = fail(&["score", "--data", text(&data), "--packed", text(path)]);
        assert!(message.contains(expected), "{message}");
    };
    // Files of an archive are named as its members.
    let line = b"24.5 24.5 0.1 many\n";
    archive(&archive_path, &[("g10_v1_objs_8_1.NN.dat", line)]);
    refused(
        &archive_path,
        "by-tar.tgz/g10_v1_objs_8_1.NN.dat: line 1: `many`",
    );
    let good = b"24.5 24.5 0.1 0.1\n";
    for (name, expected) in [
        ("NN_set8.dat", "catalogues and spectra; expected one kind"),
        ("g10_v1_objs_8_2.MM.dat", "several methods: MM, NN"),
        (
            "g10_v1_objs_10000_2.NN.dat",
            "the name is neither g10_v1_objs_",
        ),
    ] {
        archive(
            &archive_path,
            &[("g10_v1_objs_8_1.NN.dat", good), (name, good)],
        );
        refused(&archive_path, expected);
    }
    refused(&packed.at("absent"), "there is no such folder");
    refused(
        &packed.file(1),
        "this is a file; expected a folder or an archive",
    );
    fs::write(packed.file(1), good).unwrap();
    refused(&sent, "the files disagree with manifest.json");
}

#[test]
fn catalogues_of_another_program_are_packed_as_they_are_scored() {
    let packed = Packed::new();
    let description = packed.at("other.toml");
    // Distortions with the other sign of e2, counted from 0, of which one is flagged.
    for image in 1..=3 {
        let mut lines = String::from(",xpos,ypos,g1,g2,bad\n");
        for (k, line) in fs::read_to_string(packed.file(image))
            .unwrap()
            .lines()
            .enumerate()
        {
            let v: Vec<f64> = line.split(' ').map(|f| f.parse().unwrap()).collect();
            let larger = 2.0 / (1.0 + v[2] * v[2] + v[3] * v[3]);
            let (e1, e2) = (v[2] * larger, -v[3] * larger);
            let bad = u8::from(k == 5);
            lines += &format!("{k},{},{},{e1},{e2},{bad}\n", v[0] - 1.0, v[1] - 1.0);
        }
        fs::write(packed.at(&format!("other-8-{image}.csv")), lines).unwrap();
    }
    let text_of = |catalogues: &str| {
        format!(
            "name = \"their/method\"\ncatalogues = \"{catalogues}\"\nellipticity = \"distortion\"\nx = \"xpos\"\ny = \"ypos\"\ne1 = \"g1\"\ne2 = \"g2\"\nflag = \"bad\"\nposition_offset = 1.0\ne2_sign = -1\n"
        )
    };
    fs::write(&description, text_of("other-{set}-{image}.csv")).unwrap();
    let foreign = scores(&packed, &["--foreign", text(&description)]);
    let data = packed.at("data");
    for kind in ["catalogues", "spectra"] {
        let out = packed.at(kind);
        let pack = [
            "pack",
            "--foreign",
            text(&description),
            "--data",
            text(&data),
        ];
        succeed(&[&pack[..], &["--kind", kind, "--out", text(&out)]].concat());
        assert_close(&scores(&packed, &["--packed", text(&out)])[0], &foreign[0]);
        let names: Vec<String> = contents(&out).into_iter().map(|file| file.0).collect();
        let first = match kind {
            "catalogues" => "g10_v1_objs_8_1.their-method.dat",
            _ => "manifest.json",
        };
        assert_eq!(names[0], first);
    }
    let one = packed.at("catalogues/g10_v1_objs_8_1.their-method.dat");
    let (theirs, ours) = (
        fs::read_to_string(one).unwrap(),
        fs::read_to_string(packed.file(1)).unwrap(),
    );
    assert_eq!(theirs.lines().count() + 1, ours.lines().count());
    assert_eq!(theirs.lines().next(), ours.lines().next());
    let (mut found, code) = packed.check(&packed.at("catalogues"));
    found.dedup();
    assert_eq!((found, code), (vec!["missing".to_owned()], 0));
    let refused = |catalogues: &str, more: &[&str], expected: &str| {
        fs::write(&description, text_of(catalogues)).unwrap();
        let never = packed.at("never");
        let pack = [
            "pack",
            "--foreign",
            text(&description),
            "--out",
            text(&never),
        ];
        let message = fail(&[&pack[..], more].concat());
        assert!(message.contains(expected) && !never.exists(), "{message}");
    };
    let pattern = "other-{set}-{image}.csv";
    refused(
        pattern,
        &["--kind", "spectra"],
        "cannot determine the grid of the spectra. Try: --data DIR",
    );
    refused(
        "absent-{set}-{image}.csv",
        &[],
        "found no catalogue to pack",
    );
    refused("other-8-{image}.csv", &[], "contains no {set}");
    // A spectrum does not determine the sign of e2, but the truth does.
    let wrong = text_of(pattern).replace("e2_sign = -1", "e2_sign = 1");
    fs::write(&description, wrong).unwrap();
    let pack = [
        "pack",
        "--foreign",
        text(&description),
        "--data",
        text(&data),
    ];
    let never = packed.at("never");
    let spectra = ["--kind", "spectra", "--out", text(&never)];
    let message = fail(&[&pack[..], &spectra].concat());
    assert!(
        message.contains("convention 6 (e2 flipped)") && !never.exists(),
        "{message}"
    );
    fs::write(packed.at("other-8-2.csv"), "xpos,ypos,e1\n1,2,3\n").unwrap();
    refused(
        pattern,
        &[],
        "no column `g1`; columns found: xpos, ypos, e1; the description",
    );
}

#[test]
fn a_packed_folder_is_compared_with_its_manifest() {
    let packed = Packed::new();
    let found = || packed.check(&packed.at("sent"));
    let file = packed.file(2);
    let sound = fs::read_to_string(&file).unwrap();
    // The last digit of the last ellipticity.
    let digit = if sound.ends_with("1\n") { "2\n" } else { "1\n" };
    fs::write(&file, [&sound[..sound.len() - 2], digit].concat()).unwrap();
    assert_eq!(found(), (vec!["manifest".to_owned()], 1));
    fs::write(&file, &sound).unwrap();
    assert_eq!(found(), (vec![], 0));
    fs::remove_file(&file).unwrap();
    assert_eq!(
        found(),
        (vec!["manifest".to_owned(), "images".to_owned()], 1)
    );
    fs::write(&file, &sound).unwrap();
    fs::write(packed.at("sent/manifest.json"), "{").unwrap();
    assert_eq!(found(), (vec!["manifest".to_owned()], 1));
}

#[test]
fn changed_archives_are_refused_and_leave_nothing() {
    let packed = Packed::new();
    let sent = contents(&packed.at("sent"));
    let files: Vec<(&str, &[u8])> = sent
        .iter()
        .map(|(name, content)| (name.as_str(), content.as_slice()))
        .collect();
    let place = packed.at("place");
    fs::create_dir(&place).unwrap();
    let path: PathBuf = packed.at("bad.tar.gz");
    let refused = |expected: &str| {
        for more in [&["--out", text(&place.join("never"))][..], &["--verify"]] {
            let message = fail(&[&["unpack", text(&path)], more].concat());
            assert!(
                message.contains("bad.tar.gz") && message.contains(expected),
                "{message}"
            );
        }
        assert_eq!(contents(packed.at("place").as_path()), [], "{expected}");
        assert_eq!(fs::read_dir(&place).unwrap().count(), 0, "{expected}");
        assert_eq!(packed.check(&path).1, 1, "{expected}");
    };
    archive(&path, &files);
    succeed(&["unpack", text(&path), "--verify"]);
    let with = |name: &str, content: &[u8]| {
        let mut files = files.clone();
        match files.iter_mut().find(|file| file.0 == name) {
            Some(file) => file.1 = content,
            None => files.push((name, content)),
        }
        archive(&path, &files);
    };
    let (first, bytes) = files[0];
    let mut changed = bytes.to_vec();
    changed[20] ^= 1;
    with(first, &changed);
    refused("the file was changed (found SHA-256");
    with(first, &bytes[..bytes.len() - 1]);
    refused("the file was changed");
    with("more.dat", b"1");
    refused("manifest.json does not list this file");
    archive(&path, &files[1..]);
    refused("the file is missing");
    archive(&path, &[&files[..], &files[..1]].concat());
    refused("twice");
    for outside in [
        "../outside.dat",
        "/tmp/outside.dat",
        "a/b.dat",
        "..",
        ".hidden",
        "a\\b",
        "c:d",
    ] {
        with(outside, b"1");
        refused("expected plain files without folders");
    }
    with("manifest.json", b"{}");
    refused("manifest.json is not the manifest of a submission");
    archive(&path, &files);
    let whole = fs::read(&path).unwrap();
    for cut in [0, 5, whole.len() / 2, whole.len() - 4] {
        fs::write(&path, &whole[..cut]).unwrap();
        refused("cannot");
    }
    let mut flipped = whole.clone();
    let last = flipped.len() - 6;
    flipped[last] ^= 1;
    fs::write(&path, flipped).unwrap();
    refused("cannot");
    fs::write(&path, [&whole[..], b"more"].concat()).unwrap();
    refused("found data after the end");
    fs::write(&path, "This is no archive.").unwrap();
    refused("cannot read the archive");
    // A link, which would be followed when the next file is written.
    let mut builder = tar::Builder::new(GzEncoder::new(
        fs::File::create(&path).unwrap(),
        Compression::fast(),
    ));
    let mut header = tar::Header::new_gnu();
    header.set_entry_type(tar::EntryType::Symlink);
    header.set_size(0);
    builder
        .append_link(&mut header, "link.dat", "/tmp")
        .unwrap();
    builder.into_inner().unwrap().finish().unwrap();
    refused("expected plain files without folders");
    // An extension of tar, whose content a reader would have to keep in memory.
    let long = "long/".repeat(50);
    let mut builder = tar::Builder::new(GzEncoder::new(
        fs::File::create(&path).unwrap(),
        Compression::fast(),
    ));
    let mut header = tar::Header::new_gnu();
    header.set_size(0);
    builder.append_data(&mut header, &long, &b""[..]).unwrap();
    builder.into_inner().unwrap().finish().unwrap();
    refused("`././@LongLink`, expected plain files");
    // Without a manifest there is nothing to verify by.
    let bare: Vec<(&str, &[u8])> = files
        .into_iter()
        .filter(|f| f.0 != "manifest.json")
        .collect();
    archive(&path, &bare);
    assert!(fail(&["unpack", text(&path), "--verify"]).contains("no manifest.json"));
    succeed(&["unpack", text(&path), "--out", text(&packed.at("bare"))]);
}

#[test]
fn an_archive_of_too_many_files_is_not_unpacked() {
    let root = tempfile::tempdir().unwrap();
    let (path, out) = (root.path().join("many.tar.gz"), root.path().join("out"));
    let names: Vec<String> = (0..300_000).map(|k| format!("{k}")).collect();
    let files: Vec<(&str, &[u8])> = names.iter().map(|name| (name.as_str(), &b""[..])).collect();
    archive(&path, &files);
    let start = std::time::Instant::now();
    let message = fail(&["unpack", text(&path), "--out", text(&out)]);
    assert!(message.contains("many.tar.gz: too many files"), "{message}");
    // Making so many files takes longer.
    assert!(start.elapsed().as_secs() < 20, "{:?}", start.elapsed());
    assert_eq!(contents(root.path()).len(), 1);
}
