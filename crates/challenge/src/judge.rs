//! Checks entries, scores them against the true shear, and keeps them in a results store.

use std::collections::btree_map::Entry as Slot;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use shearq_challenges::MIN_ENTRY_SLOPE_SIGNIFICANCE;
use shearq_dataset::fingerprint;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::run::{Source, kind_of};
use shearq_dataset::threads::{Pool, Progress};
use shearq_files::{FileError, atomic, names_of};
use shearq_render::escape::line;
use shearq_results::record::{RunRecord, SetRecord};
use shearq_results::store;
use shearq_results::submit::check::{CheckedSet, Severity, check_sent};
use shearq_results::submit::{
    Contents, Entry as Team, Manifest, Packed, Sent, Submission, read_bandpowers,
};
use shearq_scoring::{
    Choice, Convention, Fault, Line, Noise, Options, SCORED, SetScorer, TrueShear,
};
use shearq_submissions::check_name;

use crate::entry::{Entry, EntryInfo, Refused, check_team, team_key};
use crate::error::{ChallengeError, unscored};
use crate::inbox::{Content, Sending, content, identify, modified};
use crate::kind::{ConstantShears, response};
use crate::scenes::{self, SceneScore};
use crate::seal::{Key, Receipt, close, verify};
use crate::terms::{CHALLENGE_FILE, Challenge, Deadline, SceneData, now};

// A store keeps entries and runs in one format. Only the settings of an entry start with this.
const ENTRY_SETTINGS_PREFIX: &str = "[entry]\n";

#[derive(Serialize, Deserialize)]
struct Stored {
    entry: EntryInfo,
}

/// When entries without a receipt arrived.
#[derive(Debug, Clone, Copy)]
pub enum Arrivals {
    /// At the first `rank` that scores them.
    Now,
    At(Timestamp),
    /// When their files were changed last.
    OfFiles,
}

#[derive(Debug, Default)]
pub struct Round {
    pub scored: usize,
    /// Entries that were compared with the true shear and have no score.
    pub unscored: usize,
    pub known: usize,
    pub refused: Vec<Refused>,
    pub remarks: Vec<(PathBuf, String)>,
}

struct Truth {
    shear: TrueShear,
    scorer: SetScorer,
    print: String,
    simulated: bool,
}

pub struct Judge {
    pub challenge: Challenge,
    pub key: Key,
    id: String,
    truths: BTreeMap<u32, Truth>,
    /// The true shears, if the shear is constant over each set.
    pub constant: Option<ConstantShears>,
}

// Written by hand: the derived one would print the true shears in logs and panics.
impl std::fmt::Debug for Judge {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Judge").finish_non_exhaustive()
    }
}

struct Arrival {
    sha256: String,
    received: Timestamp,
    receipt: Option<Receipt>,
}

struct Candidate {
    sending: Sending,
    reference: bool,
    team: String,
    arrival: Arrival,
    content: Content,
}

impl Candidate {
    fn refused(&self, reason: String) -> Refused {
        Refused {
            path: self.sending.path.clone(),
            team: self.team.clone(),
            reason,
        }
    }
}

// What the comparison of an entry with the true shear gives.
#[derive(Default)]
struct Verdict {
    sets: Vec<SetRecord>,
    scored: bool,
    findings: Vec<String>,
}

impl Judge {
    pub fn open(public: &Path, private: &Path, threads: usize) -> Result<Self, ChallengeError> {
        let challenge = Challenge::read(public)?;
        let (key, id) = verify(public, private, &challenge, threads)?;
        let wrong = |message| FileError::new(private, message);
        if challenge.data.scene.is_some() {
            let shears = ConstantShears::new(scenes::true_shears(private)?).map_err(wrong)?;
            return Ok(Judge {
                challenge,
                key,
                id,
                truths: BTreeMap::new(),
                constant: Some(shears),
            });
        }
        let data = DataFolder::open(private)?;
        let source = Source::folder(&data, private)?;
        let grid = challenge.data.grid().map_err(unscored)?;
        let options = Options {
            definition: challenge.rules.metric.definition(),
            choice: Choice::Insist(Convention::STANDARD),
            ..Options::default()
        };
        let mut truths = BTreeMap::new();
        for &set in &challenge.data.sets {
            let shear = data.read_truth(set, &grid)?;
            let truth = Truth {
                scorer: SetScorer::new(grid, shear.clone(), options).map_err(unscored)?,
                shear,
                print: fingerprint::of_set(&source, &data, set, &[])?,
                simulated: kind_of(&data, set)?.is_some(),
            };
            truths.insert(set, truth);
        }
        let shears = truths.iter().map(|(set, truth)| (*set, &truth.shear));
        let constant = ConstantShears::of(shears).map_err(wrong)?;
        Ok(Judge {
            challenge,
            key,
            id,
            truths,
            constant,
        })
    }

    /// Mean Q over sets of an entry of zeros. `None` for constant shears, which have no Q.
    pub fn zero_shear(&self) -> Option<f64> {
        if self.constant.is_some() {
            return None;
        }
        let q = |truth: &Truth| {
            let zero = [0.0; SCORED.end - SCORED.start];
            let score = truth.scorer.score_spectrum(&zero, None);
            score.map_or(f64::NAN, |score| score.zero_q)
        };
        let sum: f64 = self.truths.values().map(q).sum();
        Some(sum / self.truths.len() as f64)
    }

    /// The entries of this challenge in a store, in order of their arrival.
    pub fn entries(&self, store: &Path) -> Result<Vec<Entry>, FileError> {
        let mut entries: BTreeMap<(String, String), Entry> = BTreeMap::new();
        for (path, run) in store::files(store)? {
            if !run.settings.starts_with(ENTRY_SETTINGS_PREFIX) {
                continue;
            }
            let Stored { entry: info } = toml::from_str(&run.settings).map_err(|e| {
                FileError::new(&path, e.to_string().trim_end())
                    .hint("move it out of the folder of the store")
            })?;
            if info.challenge != self.challenge.name {
                continue;
            }
            if run.source != self.id {
                let message = format!(
                    "the entry was scored with another truth or other data of `{}` (found SHA-256 {}, expected {})",
                    info.challenge, run.source, self.id
                );
                return Err(FileError::new(path, message).hint("another --store"));
            }
            let entry = Entry {
                info,
                sets: run.sets,
                withdrawn: None,
            };
            // Two processes may score one entry at the same time, and a receipt may be found later. Teams that sent the same
            // archive have an entry each.
            match entries.entry((entry.info.sha256.clone(), team_key(&entry.info.team))) {
                Slot::Occupied(mut slot) => {
                    if entry.info.received < slot.get().info.received {
                        slot.insert(entry);
                    }
                }
                Slot::Vacant(slot) => _ = slot.insert(entry),
            }
        }
        let mut entries: Vec<Entry> = entries.into_values().collect();
        entries.sort_by_cached_key(|entry| (entry.info.received, entry.info.file.clone()));
        // All entries of a team have its first spelling.
        let mut names: BTreeMap<String, String> = BTreeMap::new();
        for Entry { info, .. } in &mut entries {
            let first = names.entry(team_key(&info.team));
            info.team = first.or_insert_with(|| info.team.clone()).clone();
        }
        Ok(entries)
    }

    /// Checks and scores entries and keeps them in `store`, one file per entry. `sendings` have a mark for references.
    /// Entries of the store are not scored again. An entry that cannot be scored does not stop the others.
    pub fn round(
        &self,
        sendings: &[(Sending, bool)],
        arrivals: Arrivals,
        store: &Path,
        threads: usize,
        progress: &mut dyn Progress,
    ) -> Result<Round, ChallengeError> {
        let _prepared = store::prepare(store)?;
        // Two processes that count the entries of a team at the same time would both compare its last one.
        let _held = atomic::hold(store)?;
        let known = self.entries(store)?;
        let mut round = Round::default();
        let pool = Pool::new(threads.min(sendings.len()).max(1))?;
        let mut waiting = self.readable(sendings, arrivals, &known, &pool, &mut round);
        // Scores of single sets reveal the truth.
        close(store)?;
        loop {
            let (candidates, postponed) = self.admitted(waiting, &self.entries(store)?);
            let mut is_place_left = false;
            // Stored one by one, so that an interrupted command keeps the entries that it scored.
            for result in pool.in_order(candidates, |candidate| self.judge(candidate)) {
                progress.advance(self.challenge.data.galaxies());
                match result {
                    Ok((run, scored)) => {
                        close(&store::write(store, &run)?)?;
                        round.scored += usize::from(scored);
                        round.unscored += usize::from(!scored);
                    }
                    Err(refused) => {
                        round.refused.push(refused);
                        is_place_left = true;
                    }
                }
            }
            if !is_place_left {
                let refused = postponed.into_iter();
                let refused = refused.map(|(candidate, reason)| candidate.refused(reason));
                round.refused.extend(refused);
                return Ok(round);
            }
            // Faults of the form do not count: later entries of the team take the place of what was refused.
            waiting = postponed.into_iter().map(|own| own.0).collect();
        }
    }

    // When an entry arrived, and a remark on a receipt that is not of this entry.
    fn arrival(
        &self,
        sending: &Sending,
        arrivals: Arrivals,
        now: Timestamp,
    ) -> Result<(Arrival, Option<String>), FileError> {
        let path = &sending.path;
        let sha256 = identify(path, &self.challenge.data)?;
        let receipt = Receipt::read(&self.key, path, &sha256).and_then(|receipt| {
            match (&receipt, &sending.team) {
                (Some(receipt), Some(team)) if team_key(&receipt.team) != team_key(team) => {
                    let message = format!(
                        "the receipt is of another team (found `{}`, expected the folder's `{team}`)",
                        receipt.team
                    );
                    Err(FileError::new(Receipt::path(path), message).hint(format!(
                        "move both into the folder `{}`, or sign again by shearq challenge check --truth DIR --team \"{team}\"",
                        receipt.team
                    )))
                }
                _ => Ok(receipt),
            }
        });
        let (receipt, remark) = match receipt {
            Ok(receipt) => (receipt, None),
            Err(error) => (
                None,
                Some(format!("counts as without a receipt: {}", error.text())),
            ),
        };
        let received = match (&receipt, arrivals) {
            (Some(receipt), _) => receipt.received,
            (None, Arrivals::Now) => now,
            (None, Arrivals::At(time)) => time,
            (None, Arrivals::OfFiles) => Timestamp::try_from(modified(path, &self.challenge.data)?)
                .ok()
                .and_then(|time| Timestamp::from_second(time.as_second()).ok())
                .unwrap_or(now),
        };
        let arrival = Arrival {
            sha256,
            received,
            receipt,
        };
        Ok((arrival, remark))
    }

    /// Signs the arrival of an entry, now, for `team` or the team in the manifest, and returns the file of the receipt. A
    /// receipt that the same content has already is kept, unless it is of a time before entries are accepted.
    pub fn sign(&self, entry: &Path, team: Option<&str>) -> Result<PathBuf, FileError> {
        let data = &self.challenge.data;
        let sha256 = identify(entry, data)?;
        let sending = Sending {
            path: entry.to_owned(),
            team: team.map(str::to_owned),
        };
        let team = team_of(&sending, Some(&content(&sending, data)?), None);
        check_team(&team).map_err(|error| FileError::new(entry, error))?;
        let counts = |received| !self.challenge.rules.is_early(received);
        match Receipt::earlier(&self.key, entry, &sha256)? {
            Some(earlier)
                if team_key(&earlier.team) == team_key(&team) && counts(earlier.received) =>
            {
                Ok(Receipt::path(entry))
            }
            _ => Receipt::sign(&self.key, &team, now(), &sha256).write(entry),
        }
    }

    // The entries that are new, can be read and arrived while the challenge was open, in order of arrival.
    fn readable(
        &self,
        sendings: &[(Sending, bool)],
        arrivals: Arrivals,
        known: &[Entry],
        pool: &Pool,
        round: &mut Round,
    ) -> Vec<Candidate> {
        let now = now();
        let is_scored = |team: &str, arrival: &Arrival| {
            known.iter().any(|Entry { info, .. }| {
                info.sha256 == arrival.sha256
                    && team_key(&info.team) == team_key(team)
                    && info.received <= arrival.received
            })
        };
        let data = &self.challenge.data;
        let identified = pool.in_order(sendings, |(sending, reference)| {
            let found = self.arrival(sending, arrivals, now).and_then(|arrival| {
                // Without a folder or a receipt, the manifest states the team.
                let of_receipt = arrival.0.receipt.as_ref().map(|receipt| &receipt.team);
                let team = sending.team.as_ref().or(of_receipt);
                let content = match team.is_some_and(|team| is_scored(team, &arrival.0)) {
                    true => None,
                    false => Some(content(sending, data)?),
                };
                Ok((arrival, content))
            });
            (sending, *reference, found)
        });
        let mut readable = Vec::new();
        for (sending, reference, found) in identified {
            match found {
                Ok(((arrival, remark), content)) => {
                    let remark = remark.map(|remark| (sending.path.clone(), remark));
                    round.remarks.extend(remark);
                    readable.push((sending, reference, arrival, content));
                }
                Err(error) => round.refused.push(Refused {
                    team: team_of(sending, None, None),
                    reason: reason_of(&error.path, &error.text(), sending),
                    path: sending.path.clone(),
                }),
            }
        }
        readable.sort_by(|a, b| (a.2.received, &a.0).cmp(&(b.2.received, &b.0)));
        let rules = &self.challenge.rules;
        let mut candidates = Vec::new();
        for (sending, reference, arrival, content) in readable {
            let team = team_of(sending, content.as_ref(), arrival.receipt.as_ref());
            let Some(content) = content.filter(|_| !is_scored(&team, &arrival)) else {
                round.known += 1;
                continue;
            };
            let stated = content.manifest.as_ref().and_then(|own| own.entry.as_ref());
            if let Some(stated) = stated
                && team_key(&stated.team) != team_key(&team)
            {
                let remark = format!(
                    "counts for {}, the folder of the inbox or the receipt; its manifest states {}",
                    line(&team),
                    stated.team
                );
                round.remarks.push((sending.path.clone(), remark));
            }
            let fault = match check_team(&team) {
                // The organiser's own may have any name.
                _ if reference => None,
                Err(fault) => Some(fault),
                Ok(()) if rules.is_early(arrival.received) => Some(format!(
                    "received before the challenge opened, {}",
                    rules
                        .opens
                        .as_ref()
                        .map_or_else(String::new, Deadline::to_string)
                )),
                Ok(()) => None,
            };
            let candidate = Candidate {
                sending: sending.clone(),
                reference,
                team,
                arrival,
                content,
            };
            match fault {
                Some(reason) => round.refused.push(candidate.refused(reason)),
                None => candidates.push(candidate),
            }
        }
        candidates
    }

    // The entries to compare with the true shear, and those that the limit of their team or an equal entry before them excludes,
    // with the reason.
    fn admitted(
        &self,
        waiting: Vec<Candidate>,
        known: &[Entry],
    ) -> (Vec<Candidate>, Vec<(Candidate, String)>) {
        // Of each team, arrival and content of the entries that were or will be compared.
        let mut compared: BTreeMap<String, Vec<(Timestamp, String)>> = BTreeMap::new();
        for Entry { info, .. } in known.iter().filter(|entry| !entry.info.reference) {
            let own = compared.entry(team_key(&info.team)).or_default();
            own.push((info.received, info.content.clone()));
        }
        let limit = self.challenge.rules.entries_per_team;
        let limit = limit.map_or(usize::MAX, |n| n as usize);
        let (mut admitted, mut postponed) = (Vec::new(), Vec::new());
        for candidate in waiting {
            if candidate.reference {
                admitted.push(candidate);
                continue;
            }
            let (received, content) = (candidate.arrival.received, &candidate.content.sha256);
            let own = compared.entry(team_key(&candidate.team)).or_default();
            let is_earlier = own
                .iter()
                .any(|(time, other)| *time <= received && other == content);
            // Whatever their times: with times of files, a team could date each new question before all others.
            let asked: BTreeSet<&String> = own.iter().map(|(_, content)| content).collect();
            if is_earlier {
                let reason = "identical content as an earlier entry of the team";
                postponed.push((candidate, reason.into()));
            } else if asked.len() >= limit && !asked.contains(content) {
                let reason = format!("the team has {limit} entries already");
                postponed.push((candidate, reason));
            } else {
                own.push((received, content.clone()));
                admitted.push(candidate);
            }
        }
        (admitted, postponed)
    }

    // The record of an entry, and whether it has a score.
    fn judge(&self, candidate: Candidate) -> Result<(RunRecord, bool), Refused> {
        let refuse = |reason: String| candidate.refused(reason);
        let Candidate {
            sending,
            reference,
            team,
            arrival,
            content,
        } = &candidate;
        let manifest = content.manifest.as_ref();
        let stated = manifest.and_then(|manifest| manifest.entry.as_ref());
        let run = manifest.and_then(|manifest| manifest.run.as_ref());
        let mut info = EntryInfo {
            challenge: self.challenge.name.clone(),
            team: team.clone(),
            method: String::new(),
            title: stated.map_or_else(String::new, |entry| entry.title.clone()),
            contact: stated.map_or_else(String::new, |entry| entry.contact.clone()),
            received: arrival.received,
            receipt: arrival.receipt.is_some(),
            file: file_name(&sending.path),
            sha256: arrival.sha256.clone(),
            content: content.sha256.clone(),
            contents: Contents::Catalogues,
            configuration: run.map(|run| run.configuration.name.clone()),
            reference: *reference,
            scored: false,
            findings: Vec::new(),
            scenes: None,
        };
        let Verdict {
            mut sets,
            scored,
            findings,
        } = self.score(sending, stated, &mut info).map_err(refuse)?;
        check_name(&info.method).map_err(|error| refuse(error.to_string()))?;
        (info.scored, info.findings) = (scored, findings);
        if sets.is_empty() {
            let data = &self.challenge.data;
            // Scores of scenes are in `info`.
            let all = match data.scene {
                Some(_) => &[0][..],
                None => &data.sets,
            };
            sets = all.iter().map(|set| SetRecord::unknown(*set)).collect();
        }
        let configuration = truncated(&format!("{}: {}", info.team, info.method));
        let settings =
            toml::to_string(&Stored { entry: info }).map_err(|error| refuse(error.to_string()))?;
        let run = RunRecord {
            configuration,
            version: shearq_dataset::VERSION.into(),
            settings,
            source: self.id.clone(),
            definition: self.challenge.rules.metric.definition(),
            choice: Choice::Insist(Convention::STANDARD),
            noise: Noise::Measured,
            sets,
        };
        Ok((run, scored))
    }

    // An error is a fault of the form, which does not depend on the truth.
    fn score(
        &self,
        sending: &Sending,
        entry: Option<&Team>,
        info: &mut EntryInfo,
    ) -> Result<Verdict, String> {
        let rules = &self.challenge.rules;
        if let Some(entry) = entry
            && entry.challenge != self.challenge.name
        {
            return Err(format!(
                "the entry belongs to another challenge (found `{}`, expected `{}`)",
                entry.challenge, self.challenge.name
            ));
        }
        let plain = |error| reason_of_error(&error, sending);
        let sent = self.challenge.open(&sending.path).map_err(plain)?;
        if let Some(scene) = &self.challenge.data.scene {
            info.method = stem(&sending.path);
            return self.scenes(&sent, scene, info);
        }
        let submission = Submission::read(&sent).map_err(plain)?;
        info.contents = rules.accept(&submission)?;
        info.method = submission.method;
        let mut verdict = match &submission.packed {
            Packed::Catalogues(_) => self.catalogues(&sent, sending)?,
            Packed::Spectra(files) => {
                self.check(&sent, sending, &mut |_| {})?;
                self.spectra(files, submission.manifest.as_ref())
                    .map_err(|error| plain(sent.named(error)))?
            }
        };
        let Verdict {
            sets,
            scored,
            findings,
        } = &mut verdict;
        sets.sort_by_key(|set| set.set);
        if *scored && info.contents == Contents::Catalogues {
            let constant = self.constant.as_ref();
            let (value, error) = response(sets, constant);
            if let Some(finding) = no_response(value, error) {
                findings.push(finding);
                *scored = false;
            } else if !rules.metric.of(sets, constant).0.is_finite() {
                findings.push(format!(
                    "{} cannot be computed, because the response of a set is consistent with zero or the images do not determine the noise",
                    rules.metric.label()
                ));
                *scored = false;
            }
        }
        Ok(verdict)
    }

    // Scores the catalogues of scenes.
    fn scenes(
        &self,
        sent: &Sent,
        scene: &SceneData,
        info: &mut EntryInfo,
    ) -> Result<Verdict, String> {
        let shears = self.constant.as_ref();
        let shear = |scene| shears.map_or([f64::NAN; 2], |all| all.of_set(scene));
        let sets = &self.challenge.data.sets;
        let in_words = |error: scenes::SceneError| scenes::shortened(&error.to_string(), sent);
        let summed = scenes::summed(sent, sets, shear).map_err(in_words)?;
        let mut verdict = Verdict::default();
        match SceneScore::new(&summed, scene.arcmin2) {
            Err(error) => {
                // What is wrong without the truth, too, is told in full, and does not count.
                scenes::check(sent, sets).map_err(in_words)?;
                let text = scenes::shortened(&error.to_string(), sent);
                verdict.findings.push(text);
            }
            Ok(score) => {
                let (m, error) = score.m;
                verdict.findings.extend(no_response(1.0 + m, error));
                if !score.value(self.challenge.rules.metric).0.is_finite() {
                    let message = "the shear error cannot be computed (expected a finite scatter)";
                    verdict.findings.push(message.into());
                }
                verdict.scored = verdict.findings.is_empty();
                info.scenes = Some(score);
            }
        }
        Ok(verdict)
    }

    // Checks the files of an entry. `done` gets each set of catalogues.
    fn check(
        &self,
        sent: &Sent,
        sending: &Sending,
        done: &mut dyn FnMut(CheckedSet<'_>),
    ) -> Result<(), String> {
        let plain = |error| reason_of_error(&error, sending);
        let mut expected = self.challenge.expected().map_err(plain)?;
        let truths = self.truths.iter();
        expected.secret_truth = truths.map(|(set, own)| (*set, own.shear.clone())).collect();
        let mut findings = check_sent(sent, &expected, done);
        findings.retain(|finding| finding.severity == Severity::Error);
        let Some(first) = findings.first() else {
            return Ok(());
        };
        let reason = reason_of(&first.path, &first.message, sending);
        Err(match findings.len() - 1 {
            0 => reason,
            more => format!("{reason} (and {more} more)"),
        })
    }

    // Checks and scores the catalogues of an entry; also names images that do not follow the shear as the others do.
    fn catalogues(&self, sent: &Sent, sending: &Sending) -> Result<Verdict, String> {
        let mut verdict = Verdict {
            scored: true,
            ..Verdict::default()
        };
        let mut odd = Vec::new();
        self.check(sent, sending, &mut |checked: CheckedSet<'_>| {
            let set = checked.set;
            match self.score_set(&checked, &mut odd) {
                Ok(record) => verdict.sets.extend(record),
                Err(finding) => {
                    verdict.findings.push(format!("set {set}: {finding}"));
                    verdict.scored = false;
                }
            }
        })?;
        if !odd.is_empty() {
            verdict.findings.push(format!(
                "image {} does not follow the shear as the others of the set do",
                names_of(&odd)
            ));
        }
        Ok(verdict)
    }

    fn spectra(
        &self,
        files: &BTreeMap<u32, PathBuf>,
        manifest: Option<&Manifest>,
    ) -> Result<Verdict, FileError> {
        let grid = self.challenge.data.grid();
        let grid = grid.map_err(|error| FileError::new(CHALLENGE_FILE, error))?;
        let mut verdict = Verdict::default();
        let mut powers = Vec::new();
        for (&set, path) in files {
            let Some(truth) = self.truths.get(&set) else {
                continue;
            };
            let sent = read_bandpowers(path, &grid)?;
            let covariance =
                manifest.and_then(|manifest| manifest.covariances.get(path.file_name()?.to_str()?));
            let score = truth
                .scorer
                .score_spectrum(&sent, covariance)
                .map_err(|error| FileError::new(path, error))?;
            let true_powers = truth.scorer.true_bandpowers();
            powers.push((true_powers[SCORED].to_vec(), sent));
            let images = (1..=self.challenge.data.images).collect();
            verdict.sets.push(SetRecord {
                data: truth.print.clone(),
                ..SetRecord::of_spectrum(set, truth.simulated, images, &score)
            });
        }
        let (slope, error) = slope_over_sets(&powers);
        verdict.scored = is_measurable(slope, error);
        if !verdict.scored {
            verdict.findings.push(format!(
                "the spectra do not follow the differences of the true spectra between sets (found a slope of {slope:.2} ± {error:.2}, expected at least {MIN_ENTRY_SLOPE_SIGNIFICANCE}σ)"
            ));
        }
        Ok(verdict)
    }

    // The record of a set of catalogues, and in `odd` its images that do not follow the shear as the others do. `None` if the
    // set does not belong to the challenge.
    fn score_set(
        &self,
        checked: &CheckedSet<'_>,
        odd: &mut Vec<String>,
    ) -> Result<Option<SetRecord>, String> {
        let (set, numbers) = (checked.set, checked.numbers);
        let Some(truth) = self.truths.get(&set) else {
            return Ok(None);
        };
        let scored = checked.images.finish();
        let scored = scored.map_err(|error| error.to_string())?;
        let responses = scored.odd.responses.iter();
        odd.extend(responses.map(|own| format!("{} of set {set}", numbers[own.place])));
        for fault in scored.findings {
            return Err(match fault {
                Fault::Convention { better, .. } => format!(
                    "signs or axes are wrong (found convention {}, {}; expected 5, standard)",
                    better.number(),
                    better.describe()
                ),
                Fault::Swapped { .. } => "e1 and e2 are swapped".into(),
                Fault::Shifted { .. } => "the galaxies are in neighbouring cells".into(),
                _ => continue,
            });
        }
        let (score, rows) = (&scored.score, &scored.rows);
        let record = SetRecord::new(set, truth.simulated, numbers.to_vec(), score, rows, true);
        let data = truth.print.clone();
        Ok(Some(SetRecord { data, ..record }))
    }
}

// An error that cannot be determined (NaN) does not refuse an entry.
fn is_measurable(slope: f64, error: f64) -> bool {
    slope > 0.0 && (error.is_nan() || slope > MIN_ENTRY_SLOPE_SIGNIFICANCE * error)
}

// What is wrong with a response that is not measurable.
fn no_response(value: f64, error: f64) -> Option<String> {
    (!is_measurable(value, error)).then(|| format!(
        "the response to the shear is consistent with zero (found {value:.3} ± {error:.3}, expected at least {MIN_ENTRY_SLOPE_SIGNIFICANCE}σ)"
    ))
}

type Powers = (Vec<f64>, Vec<f64>);

// Slope of the sent bandpowers on the true ones over sets, and its standard error from the residuals. Each bandpower is divided
// by its true mean over the sets and only deviations from it count: a team could find the mean spectrum with simulations,
// without measuring an image.
fn slope_over_sets(sets: &[Powers]) -> (f64, f64) {
    let bins = sets.first().map_or(0, |(truth, _)| truth.len());
    let count = sets.len() as f64;
    let mean = |b: usize| sets.iter().map(|(truth, _)| truth[b]).sum::<f64>() / count;
    let means: Vec<f64> = (0..bins).map(mean).collect();
    let rows = sets.iter().flat_map(|(truth, sent)| {
        let each = truth.iter().zip(sent).zip(&means);
        each.map(|((truth, sent), mean)| (truth / mean - 1.0, sent / mean))
    });
    let line = Line::through(&rows.collect::<Vec<_>>());
    (line.slope, line.slope_error())
}

fn reason_of_error(error: &FileError, sending: &Sending) -> String {
    reason_of(&error.path, &error.text(), sending)
}

// Lists of refused entries state the path of the entry before the reason, so it is removed here.
fn reason_of(path: &Path, message: &str, sending: &Sending) -> String {
    match path.strip_prefix(&sending.path) {
        Ok(name) if !name.as_os_str().is_empty() => {
            format!("{}: {message}", line(&name.to_string_lossy()))
        }
        _ => message.to_owned(),
    }
}

// Team of an entry: its folder in the inbox, or as its receipt or its manifest states, or the name of the file.
fn team_of(sending: &Sending, content: Option<&Content>, receipt: Option<&Receipt>) -> String {
    let stated = content.and_then(|content| content.manifest.as_ref()?.entry.as_ref());
    let folder = sending.team.clone();
    folder
        .or_else(|| receipt.map(|receipt| receipt.team.clone()))
        .or_else(|| stated.map(|entry| entry.team.clone()))
        .unwrap_or_else(|| stem(&sending.path))
}

// The name of an entry, without the ending of an archive.
fn stem(path: &Path) -> String {
    let name = file_name(path);
    let endings = [".tar.gz", ".tgz", ".zip"];
    let stem = endings.iter().find_map(|ending| name.strip_suffix(ending));
    stem.unwrap_or(&name).to_owned()
}

fn file_name(path: &Path) -> String {
    line(&path.file_name().unwrap_or_default().to_string_lossy())
}

// Stores limit names, and team and method together can be longer.
fn truncated(name: &str) -> String {
    let mut ends = (0..=shearq_submissions::MAX_NAME).rev();
    let end = ends.find(|end| name.is_char_boundary(*end));
    name[..end.unwrap_or(0)].to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spectra_of_own_simulations_have_no_response() {
        // Two sets with different factors on one spectrum.
        let smooth = [1.0, 2.0, 3.0, 5.0, 8.0, 9.0, 9.5, 10.0];
        let factors = [
            [0.3, 2.0, 1.0, 3.0, 0.5, 0.4, 1.5, 2.5],
            [1.2, 0.6, 3.5, 0.3, 2.2, 1.9, 0.4, 0.9],
        ];
        let truth = factors.map(|of| {
            of.iter()
                .zip(smooth)
                .map(|(f, p)| f * p)
                .collect::<Vec<_>>()
        });
        let slope = |edit: &dyn Fn(usize, usize, f64) -> f64| {
            let sent = |set: usize| (0..8).map(|b| edit(set, b, truth[set][b])).collect();
            let sets: Vec<Powers> = (0..2).map(|set| (truth[set].clone(), sent(set))).collect();
            let (slope, error) = slope_over_sets(&sets);
            (slope, is_measurable(slope, error))
        };
        let (found, clear) = slope(&|_, _, p| 0.9 * p);
        assert!((found - 0.9).abs() < 1e-12 && clear);
        // Noise of a tenth, and a bias that depends on the scale.
        let noisy =
            |set: usize, b: usize, p: f64| p * (1.0 + 0.1 * ((set * 8 + b) as f64 * 2.3).sin());
        assert!(slope(&noisy).1);
        // Zeros, a template, and a template of random amplitude.
        assert!(!slope(&|_, _, _| 0.0).1 && !slope(&|_, b, _| smooth[b]).1);
        // One of the two has a positive slope.
        for sign in [1.0, -1.0] {
            let amplitude = |k: usize| 1.0 + sign * (k as f64 * 1.7).cos();
            assert!(!slope(&|set, b, _| smooth[b] * amplitude(set * 8 + b)).1);
        }
        let (only, error) = slope_over_sets(&[(truth[0].clone(), truth[0].clone())]);
        assert!(!is_measurable(only, error));
    }
}
