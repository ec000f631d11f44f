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
fn archives_are_reproducible_and_unpack_to_the_folder_that_is_packed() {
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
    let again = ["pack", "--measured", text(&measured), "--out", text(&sent)];
    assert!(fail(&again).contains("exists already"));
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
fn archives_that_are_not_what_was_packed_are_refused_and_leave_nothing() {
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
    refused("the file was changed: its SHA-256");
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
    refused("its manifest.json is not one of a submission");
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
    refused("data after its end");
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
    refused("`././@LongLink`; expected plain files");
    // Without a manifest there is nothing to verify by.
    let bare: Vec<(&str, &[u8])> = files
        .into_iter()
        .filter(|f| f.0 != "manifest.json")
        .collect();
    archive(&path, &bare);
    assert!(fail(&["unpack", text(&path), "--verify"]).contains("no manifest.json"));
    succeed(&["unpack", text(&path), "--out", text(&packed.at("bare"))]);
}
