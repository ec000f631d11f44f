//! Archives that were changed or made to do harm are refused, and leave nothing. Sound ones are in
//! `tests/cases/submissions.md`.

use std::fs;
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;

use crate::support::{Folder, contents, shell};

/// An archive in memory.
type Builder = tar::Builder<GzEncoder<fs::File>>;

fn builder(path: &Path) -> Builder {
    let file = fs::File::create(path).unwrap();
    tar::Builder::new(GzEncoder::new(file, Compression::fast()))
}

/// Packs an archive of `files`, as anyone could.
fn archive(path: &Path, files: &[(&str, &[u8])]) {
    let mut builder = builder(path);
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
fn changed_archives_are_refused_and_leave_nothing() {
    let folder = Folder::new();
    folder.run("simulate --fixed-psf one --sets 8 --images 3 --grid 16 --out data");
    folder.run("measure --submission 23/raw/star --data data --out out");
    folder.run("pack --measured out --method NN --out sent");
    let (place, path) = (folder.at("place"), folder.at("bad.tar.gz"));
    fs::create_dir(&place).unwrap();
    let sent = contents(&folder.at("sent"));
    let files = sent
        .iter()
        .map(|(name, content)| (name.as_str(), content.as_slice()));
    let files: Vec<(&str, &[u8])> = files.collect();
    let check = |expected: &str| {
        for more in ["--out place/never", "--verify"] {
            let words = format!("bad.tar.gz[..]{expected}");
            folder.refuses(&format!("unpack bad.tar.gz {more}"), &words);
        }
        assert_eq!(fs::read_dir(&place).unwrap().count(), 0, "{expected}");
        let check = "shearq check bad.tar.gz --data data --images 3";
        let check = shell(folder.root(), check);
        assert_eq!(check.status.code(), Some(1), "{expected}");
    };
    archive(&path, &files);
    folder.run("unpack bad.tar.gz --verify");
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
    let plain = "expected plain files, all in one folder or in none";
    for (name, content, expected) in [
        (first, &changed[..], "the file was changed (found SHA-256"),
        (first, &bytes[..bytes.len() - 1], "the file was changed"),
        ("more.dat", b"1", "manifest.json does not list this file"),
        ("../outside.dat", b"1", plain),
        ("/tmp/outside.dat", b"1", plain),
        ("a/b.dat", b"1", plain),
        ("..", b"1", plain),
        (".hidden", b"1", plain),
        ("a\\b", b"1", plain),
        ("c:d", b"1", plain),
        (
            "manifest.json",
            b"{}",
            "is not the manifest of a submission",
        ),
    ] {
        with(name, content);
        check(expected);
    }
    archive(&path, &files[1..]);
    check("the file is missing");
    archive(&path, &[&files[..], &files[..1]].concat());
    check("twice");
    archive(&path, &files);
    let whole = fs::read(&path).unwrap();
    let mut flipped = whole.clone();
    flipped[whole.len() - 6] ^= 1;
    let more = [&whole[..], b"more"].concat();
    for (bytes, expected) in [
        (&whole[..0], "cannot"),
        (&whole[..5], "cannot"),
        (&whole[..whole.len() / 2], "cannot"),
        (&whole[..whole.len() - 4], "cannot"),
        (&flipped, "cannot"),
        (&more, "found data after the end"),
        (b"This is no archive.", "cannot read the archive"),
    ] {
        fs::write(&path, bytes).unwrap();
        check(expected);
    }
    // A link, which would be followed when the next file is written.
    let mut links = builder(&path);
    let mut header = tar::Header::new_gnu();
    header.set_entry_type(tar::EntryType::Symlink);
    header.set_size(0);
    links.append_link(&mut header, "link.dat", "/tmp").unwrap();
    links.into_inner().unwrap().finish().unwrap();
    check(plain);
    // An extension of tar, whose content a reader would have to keep in memory.
    let mut long = builder(&path);
    let mut header = tar::Header::new_gnu();
    header.set_size(0);
    long.append_data(&mut header, "long/".repeat(50), &b""[..])
        .unwrap();
    long.into_inner().unwrap().finish().unwrap();
    check("`././@LongLink`, expected plain files");
}
