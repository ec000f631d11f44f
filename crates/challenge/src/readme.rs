//! The page for participants in the public folder.

use shearq_results::submit::challenge::Kind as FileKind;

use crate::terms::Challenge;

/// Rules of a challenge, one paragraph each.
pub(crate) fn rules(challenge: &Challenge) -> Vec<String> {
    let Challenge {
        kind,
        contact,
        address,
        rules,
        ..
    } = challenge;
    let mut all: Vec<String> = kind.rules.iter().map(|&rule| rule.to_owned()).collect();
    if rules.partial {
        all.push("An entry may cover some sets only. It is listed without a rank.".into());
    }
    all.push(format!(
        "Entries are ranked by {}, over all sets. {}",
        rules.metric.label(),
        rules.metric.meaning()
    ));
    all.push("The shapes of every image must agree with the image, with one scale in all images of a set, and their response to the shear must be at least 3σ from zero.".into());
    all.push("Entries whose difference is below its error share a rank.".into());
    all.push("Symbolic links are not accepted. Entries that share files or shapes with an earlier entry are listed.".into());
    if let Some(most) = rules.entries_per_team {
        all.push(format!(
            "Each team may send at most {most} entries, because published values reveal the true shear entry by entry."
        ));
    }
    if let Some(opens) = &rules.opens {
        all.push(format!("Entries are accepted from {opens}."));
    }
    if let Some(closes) = &rules.closes {
        all.push(format!(
            "Entries are accepted until {closes}. Later entries have their own board."
        ));
    }
    for (what, place) in [("Data and rules", address), ("Contact", contact)] {
        if !place.is_empty() {
            all.push(format!("{what}: {place}"));
        }
    }
    all
}

/// The page, as Markdown.
pub(crate) fn text(challenge: &Challenge) -> String {
    let Challenge {
        name,
        version,
        kind,
        data,
        conventions,
        rules,
        ..
    } = challenge;
    let sets: Vec<String> = data.sets.iter().map(u32::to_string).collect();
    let first = data.sets.first().copied().unwrap_or(1);
    let method = || "METHOD".to_owned();
    let catalogue = FileKind::Catalogue {
        set: first,
        image: 1,
        method: method(),
    };
    let spectrum = FileKind::Spectrum {
        set: first,
        method: method(),
    };
    let half = 0.5 * (data.stamp as f64 + 1.0);
    let mut text = format!(
        "# {name}\n\nVersion {version}. Kind: {} (`{}`).\n\nMeasure the shapes of the galaxies. The true shear is secret. `challenge.toml` has the numbers below in machine-readable form.\n\n## Data\n\n",
        kind.title, kind.name
    );
    text.push_str(&format!(
        "* Sets: {}.\n* Images per set: {}, numbered from 1.\n* Galaxies per image: {2} × {2}, in stamps of {3} × {3} pixels.\n* Side of the field: {4} degrees.\n* `layout.toml` has the names of images and PSFs.\n* Verify the download with `sha256sum -c SHA256SUMS`.\n\n",
        sets.join(", "),
        data.images,
        data.grid,
        data.stamp,
        data.field_degrees
    ));
    text.push_str("## Conventions\n\n");
    for (name, meaning) in conventions {
        text.push_str(&format!("* {name}: {meaning}.\n"));
    }
    text.push_str(&format!(
        "\n## Entries\n\nAn ellipticity catalogue is an ASCII file `{}` per image with one line per galaxy: `x y e1 e2`. For example, the first galaxy:\n\n```text\n{half} {half} 0.0312 -0.0147\n```\n\n",
        catalogue.file_name()
    ));
    if rules.contents.iter().any(|contents| contents.is_spectra()) {
        text.push_str(&format!(
            "A power spectrum is an ASCII file `{}` per set with the bins 2 to 9: `index l power`.\n\n",
            spectrum.file_name()
        ));
    }
    text.push_str(&format!(
        "Put the files of an entry into one `.tar.gz` without folders. [shearq](https://github.com/shearq/shearq) does it for its own catalogues, and for yours if you describe them (`--foreign`):\n\n```sh\nshearq measure --data . --submission 48/linear/star --out ../catalogues\nshearq pack --measured ../catalogues --challenge \"{}\" --team TEAM --out ../entry.tar.gz\nshearq challenge check ../entry.tar.gz --challenge .\n```\n\nThe last command checks any entry, and needs no true shear. It finds missing and duplicate galaxies, swapped or flipped components, shapes that do not agree with their images, and distortions that are given as shear.\n\n## Rules\n\n",
        name.replace(['"', '\\', '$', '`'], "")
    ));
    for rule in self::rules(challenge) {
        text.push_str(&format!("* {rule}\n"));
    }
    text
}
