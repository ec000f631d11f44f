//! Shear bias as tables, plots and verdicts.

use shearq_bias::{
    BiasError, Catalogue, Design, Estimate, Measured, QUANTITIES, Quantity, REQUIREMENTS, Repeated,
    Verdict, student_t, verdict,
};
use shearq_dataset::truth::Sign;
use shearq_render::figure::{Band, FigureError, LinePlot, PanelGrid, Series, Style};
use shearq_render::html::{Block, Picture, Section};
use shearq_render::table::{Cell, Heading, Table};

use crate::bias::{BiasResult, BinResult, share_images};
use shearq_catalogue::failures::shown;

// Units above which Student's t differs from a normal distribution by less than 5 %.
const MANY_UNITS: usize = 30;

// Units below which a standard error is itself uncertain by more than 16 %.
const FEW_UNITS: usize = 20;

const MAIN: [&str; 4] = ["m1", "m2", "c1", "c2"];

// A column of the table: its key, heading, whether only the wide table has it, and its cell of a bin.
type BinColumn = (
    &'static str,
    &'static str,
    bool,
    fn(&BiasResult, &BinResult) -> Cell,
);

// The quantities of the estimate follow.
const COLUMNS: [BinColumn; 12] = [
    ("bin", "Bin", false, |_, bin| Cell::text(&bin.label)),
    ("n", "Galaxies", false, |_, bin| {
        count(bin, |found| found.galaxies as f64)
    }),
    ("low", "From", true, |_, bin| edge(bin, 0, 0)),
    ("high", "To", true, |_, bin| edge(bin, 0, 1)),
    ("low_2", "From (2)", true, |_, bin| edge(bin, 1, 0)),
    ("high_2", "To (2)", true, |_, bin| edge(bin, 1, 1)),
    ("low_3", "From (3)", true, |_, bin| edge(bin, 2, 0)),
    ("high_3", "To (3)", true, |_, bin| edge(bin, 2, 1)),
    ("n_effective", "Effective", true, |_, bin| {
        count(bin, |found| found.effective)
    }),
    ("units", "Units", true, |_, bin| {
        count(bin, |found| found.units as f64)
    }),
    ("m_covariance", "cov(m1, m2)", true, |_, bin| {
        let found = bin.estimate.as_ref().ok();
        let covariance = found.and_then(Estimate::covariance);
        Cell::number(covariance.unwrap_or(f64::NAN), 12)
    }),
    ("frame", "Frame", true, |result, _| {
        let frame = result.about.frame.as_ref();
        frame.map_or(Cell::Empty, Cell::text)
    }),
];

fn edge(bin: &BinResult, axis: usize, side: usize) -> Cell {
    let range = bin.ranges.get(axis);
    Cell::number(range.map_or(f64::NAN, |range| range[side]), 4)
}

fn count(bin: &BinResult, of: fn(&Estimate) -> f64) -> Cell {
    Cell::number(bin.estimate.as_ref().map_or(0.0, of), 0)
}

/// Estimates of all galaxies and of each bin, one row each, with the verdict as notes.
pub fn bias_table(result: &BiasResult) -> Table {
    let estimates = || {
        result
            .bins
            .iter()
            .filter_map(|bin| bin.estimate.as_ref().ok())
    };
    let known = |key: &str| estimates().any(|found| found.value(key).is_some());
    let main = MAIN
        .iter()
        .filter_map(|key| QUANTITIES.iter().find(|own| own.key == *key));
    let details = QUANTITIES
        .iter()
        .filter(|own| !MAIN.contains(&own.key) && known(own.key));
    let quantities: Vec<&Quantity> = main.chain(details).collect();
    let heading = |key, label, detail: bool| match Heading::new(key, label) {
        heading if detail => heading.detail(),
        heading => heading,
    };
    // Programs other than shearq do not state a frame.
    let is_used = |key: &str| match key {
        "frame" => result.about.frame.is_some(),
        "low_2" | "high_2" => result.about.cells.axes.len() > 1,
        "low_3" | "high_3" => result.about.cells.axes.len() > 2,
        _ => true,
    };
    let columns = || COLUMNS.iter().filter(|own| is_used(own.0));
    let headings = columns().map(|(key, label, detail, _)| heading(key, *label, *detail));
    let of_quantities = quantities.iter().map(|own| {
        let detail = !MAIN.contains(&own.key) && own.key != "alpha";
        heading(own.key, own.label, detail)
    });
    let mut notes = notes(result);
    let rows = result.bins.iter().map(|bin| {
        if let Err(error) = &bin.estimate {
            notes.push(format!("No estimate of {}: {error}.", bin.label));
        }
        let cells = columns().map(|(.., cell)| cell(result, bin));
        let quantity = |own: &&Quantity| match &bin.estimate {
            Ok(found) => quantity_cell(found, own.key),
            Err(_) => Cell::with_error(f64::NAN, Some(f64::NAN), 6),
        };
        cells.chain(quantities.iter().map(quantity)).collect()
    });
    Table {
        title: "Shear bias".into(),
        headings: headings.chain(of_quantities).collect(),
        rows: rows.collect(),
        notes,
    }
}

/// The tables of two programs and of their difference as one table, whose first column names the program.
pub fn compared_table(first: &BiasResult, second: &BiasResult, difference: &BiasResult) -> Table {
    let parts = [
        ("catalogues", first),
        ("against", second),
        ("difference", difference),
    ];
    let tables = parts.map(|(name, result)| (name, bias_table(result)));
    // The first table may lack columns that another has: responses of one program.
    let mut headings: Vec<Heading> = vec![Heading::new("of", "Of")];
    for heading in tables.iter().flat_map(|(_, table)| &table.headings) {
        if !headings.iter().any(|own| own.key == heading.key) {
            headings.push(heading.clone());
        }
    }
    let mut rows = Vec::new();
    for (name, table) in &tables {
        let places: Vec<Option<usize>> = headings[1..]
            .iter()
            .map(|heading| table.place(heading.key))
            .collect();
        for row in &table.rows {
            let cells = places.iter().map(|place| match place {
                Some(place) => row[*place].clone(),
                None => Cell::Empty,
            });
            rows.push([Cell::text(*name)].into_iter().chain(cells).collect());
        }
    }
    let [(_, mut table), _, _] = tables;
    let own = |line: &&String| !table.notes.contains(*line);
    let theirs = notes(second);
    let theirs: Vec<String> = (theirs.iter().filter(own))
        .map(|line| format!("--against: {line}"))
        .collect();
    table.notes.extend(theirs);
    table
        .notes
        .extend(of_pairing(first, second).map(|line| sentence(&line)));
    table.notes.push(format!(
        "Difference: {}, with errors from leaving out the same units of both.",
        difference.about.program
    ));
    Table {
        headings,
        rows,
        ..table
    }
}

/// A warning if galaxies were selected or binned by what was measured on them.
pub fn chosen_by_measurement(result: &BiasResult) -> Option<String> {
    // Without a true shear there is no m.
    if result.design == Design::Null {
        return None;
    }
    let measured = &result.about.measured;
    let column = measured.first()?;
    let all = measured.join("`, `");
    let remedy = match result.about.by_shearq {
        true => {
            "--where 'step(snr, THRESHOLD)' for cuts by snr, flux or size, or catalogues with shape.sheared_step".into()
        }
        false => format!(
            "catalogues with {column}_1p, {column}_1m, {column}_2p and {column}_2m, or --unsheared {column} if shear does not change it, as for redshifts"
        ),
    };
    // docs/limitations.md, selection after measuring.
    Some(format!(
        "m contains the effect of shear on a selection by `{all}`, whose response is unknown here. Known sizes: −0.02 (S/N 20) to −0.1 (S/N 7) if the lowest 30 % in size are removed, −0.11 for the lowest 50 % in flux. Try: {remedy}"
    ))
}

/// A warning if the units of both sides of a comparison do not contain the same galaxies.
pub fn of_pairing(first: &BiasResult, second: &BiasResult) -> Option<String> {
    let overlap = first.grouping.units.overlap(&second.grouping.units);
    let found = match overlap.correlation {
        _ if !overlap.is_shared() => format!(
            "{:.1} % of the galaxies are in units that both sides have",
            100.0 * overlap.shared
        ),
        // The shapes of rotated pairs cancel within a unit.
        Some(correlation) if !overlap.is_of_same_galaxies() && first.design != Design::Rotated => {
            format!(
                "the ellipticities of the same units correlate by {correlation:.2}, as those of different galaxies"
            )
        }
        _ => return None,
    };
    let unit = first.grouping.unit;
    Some(format!(
        "the galaxies of both sides do not pair by {unit} ({found}). If they are the same, the error of the difference is too large by the ratio of total scatter to measurement noise. Try: --columns id=NAME with identifiers that both sides have, or the same order of rows and id=none"
    ))
}

/// A warning if both sides of a comparison state their images and have none in common.
pub fn of_other_images(first: &BiasResult, second: &BiasResult) -> Option<String> {
    let [first, second] = [first, second].map(|result| result.about.catalogues.as_slice());
    let stated = |all: &[Catalogue]| all.iter().any(|own| own.image.is_some());
    (stated(first) && stated(second) && !share_images(first, second)).then(|| {
        "these catalogues were measured on other images, so that the noise does not cancel in the difference, and shapes only if the galaxies are the same".into()
    })
}

// |m| above which catalogue and truth hardly belong together.
const IMPLAUSIBLE: f64 = 0.3;
// Chosen by hand: shape noise alone exceeds it in 6 of 10⁷ cases.
const IMPLAUSIBLE_SIGNIFICANCE: f64 = 5.0;

// The first m whose modulus is above a limit by more than its error explains.
fn clearly_above(all: &Estimate, limit: f64) -> Option<(&'static str, Measured)> {
    let large = |m: &Measured| m.value.abs() > limit + IMPLAUSIBLE_SIGNIFICANCE * m.error;
    let mut names = ["m1", "m2"].into_iter();
    names.find_map(|name| Some((name, all.value(name).filter(large)?)))
}

fn implausible(result: &BiasResult, all: &Estimate) -> Option<String> {
    // Another unit explains any m.
    if other_unit(result, all).is_some() {
        return None;
    }
    let (name, m) = clearly_above(all, IMPLAUSIBLE)?;
    // First, because two catalogues under one shear leave m near −1, whatever their response.
    let shears = match (result.design, result.about.catalogues.len()) {
        (Design::Single, 2..) => {
            " Do the catalogues have different shears? Try: --truth shears.csv, with the columns catalogue,g1,g2."
        }
        _ => "",
    };
    let divided = match result.about.response_column {
        true => {
            " Ellipticities that are divided by their response already have a response of one. Try: --columns R11=none,R22=none"
        }
        false => "",
    };
    let other = match result.about.response {
        true => ", and another m a wrong response or step",
        false => {
            ", and another m a response that is missing, or weights, flags or cuts that are not used"
        }
    };
    Some(format!(
        "{name} is {:+.2} (expected |m| below {IMPLAUSIBLE}). m = −2 is a wrong sign, m = −1 a wrong truth{other}.{shears}{divided}",
        m.value
    ))
}

// |m| of ellipticities without a response from which they are probably not calibrated. Methods that correct the PSF alone have less
// (HSM's, docs/validation.md).
const UNCALIBRATED: f64 = 0.1;

// Ellipticities that nothing divides by their response.
fn uncalibrated(result: &BiasResult, all: &Estimate) -> Option<String> {
    let (name, m) = clearly_above(all, UNCALIBRATED)?;
    if result.about.response {
        return None;
    }
    Some(format!(
        "{name} is {:+.2}, and no response is used. Ellipticities before a calibration usually have such an m: the responses of metacalibration in DES and UNIONS are 0.6 to 0.8, which is an m of −0.4 to −0.2 without them. Try: --columns R11=NAME,R22=NAME with their responses",
        m.value
    ))
}

// Mean response below which ellipticities above 2 are in another unit. Chosen by hand: with noise, e/R is above 1 in few rows.
const MAX_RESPONSE_OF_SHAPES: f64 = 2.0;

// Ellipticities beside responses that are in another unit: percent beside R11 gave m = 100 and the advice to leave R11 out.
fn other_unit(result: &BiasResult, all: &Estimate) -> Option<String> {
    let response = all.value("r1")?.value.abs();
    let beyond = result.about.total().beyond[1];
    (2 * beyond > all.galaxies as u64 && response < MAX_RESPONSE_OF_SHAPES).then(|| {
        format!(
            "{beyond} of {} rows have |e| above 2 beside a mean response of {response:.2}, so that e1 and e2 are in another unit than their response (expected |e| below 1). Percent? Try: --columns 'e1=e1/100,e2=e2/100'",
            all.galaxies
        )
    })
}

// Share of the rows below which the effective number shows that few weights dominate.
const FEW_EFFECTIVE: f64 = 0.05;

// α below which galaxies were corrected for other PSFs. With star stamps in reversed order, α is −0.6 to −0.9 in simulated
// sets 1, 7 and 19; with their own it is zero within 0.2.
const OTHER_PSF: f64 = -0.3;

/// Warnings about weights, PSFs and about catalogues that do not pair.
pub fn of_design(result: &BiasResult) -> Vec<String> {
    let Ok(all) = result.all() else {
        return Vec::new();
    };
    let about = [&result.about.undivided, &result.about.unreduced];
    let mut lines: Vec<String> = about.into_iter().flatten().cloned().collect();
    if all.effective < FEW_EFFECTIVE * all.galaxies as f64 {
        lines.push(format!(
            "few weights dominate: {} galaxies have the information of {:.1} with equal weights (expected {:.0} or more). Errors are then not reliable. Try: another column of weights, or --columns w=none",
            all.galaxies,
            all.effective,
            FEW_EFFECTIVE * all.galaxies as f64
        ));
    }
    let total = result.about.total();
    if 2 * total.flagged > total.rows {
        let column = result.about.flag.as_deref().unwrap_or("NAME");
        lines.push(format!(
            "`{column}` excludes {:.1} % of the rows, which are those where it is not 0. If good rows have 1, m is that of the bad ones. Try: --columns flag=none --where {column}",
            100.0 * total.flagged as f64 / total.rows as f64
        ));
    }
    let catalogues = result.about.catalogues.iter();
    let mut dominant = catalogues.filter_map(|own| Some((own, own.dominant.as_ref()?)));
    if let Some((catalogue, own)) = dominant.next() {
        let more = match dominant.count() {
            0 => String::new(),
            more => format!(" (and {more} more catalogues likewise)"),
        };
        let k = own.component + 1;
        lines.push(format!(
            "row {} of {} has {:.1} % of the sum of the response R{k}{k} (found {}, expected about {:.3}), and changes m{k} by about as much{more}. Try: look at it, and flag it only if its measurement failed",
            own.row,
            catalogue.name,
            100.0 * own.share,
            own.response,
            own.mean,
        ));
    }
    for text in &total.unmatched {
        lines.push(format!(
            "no row has the text of `{text}` in --where or --columns. Try: another text, with `*` for any characters"
        ));
    }
    lines.extend(repeated(&result.about.catalogues, true));
    if let Some(alpha) = all.value("alpha")
        && alpha.value < OTHER_PSF.min(-IMPLAUSIBLE_SIGNIFICANCE * alpha.error)
    {
        lines.push(format!(
            "the ellipticities follow minus the ellipticity of the PSF (found α = {:.2} ± {:.2}, expected about 0): galaxies were probably corrected for the PSF of other galaxies. Try: check the order of the PSFs",
            alpha.value, alpha.error
        ));
    }
    let units = match &result.about.unit_column {
        Some(column) => format!("--units {column}"),
        None => "--columns id=NAME with identifiers, --units COLUMN, or --units catalogues for detections".into(),
    };
    // Without shape noise, only pixel noise cancels: errors of m were 54 times too large.
    let wrong = "the error of m is too large by the ratio of total scatter to measurement noise, and that of c too small by up to √2";
    let shown = |[g1, g2]: [f64; 2]| format!("({g1}, {g2})");
    if !result.grouping.missing.is_empty() {
        let missing = result
            .grouping
            .missing
            .iter()
            .take(MAX_MISSING)
            .map(|missing| format!("g = {} beside {}", shown(missing.shear), missing.beside));
        let missing: Vec<String> = missing.collect();
        let more = match result.grouping.missing.len().saturating_sub(MAX_MISSING) {
            0 => String::new(),
            more => format!(", and {more} more"),
        };
        lines.push(format!(
            "catalogues are missing: {}{more}. The others are paired by their names, and the shapes of a catalogue without partner do not cancel in m. Try: leave out the partner, too",
            missing.join(", ")
        ));
    }
    if let Some((shear, [own, opposite])) = result.grouping.unpaired {
        lines.push(format!(
            "the catalogues of opposite shears do not pair (found {own} with g = {} and {opposite} with minus g, and no names that state which belong together), so that each is a unit. If they contain the same galaxies, {wrong}. Try: {units}, or leave out the catalogues without partner",
            shown(shear)
        ));
    }
    match result.grouping.uncorrelated {
        Some(correlation) => lines.push(format!(
            "rows of catalogues with opposite shears are different galaxies (their ellipticities correlate by {correlation:.2}). If both catalogues contain the same galaxies in another order, {wrong}. Try: {units}"
        )),
        None if result.grouping.misaligned => lines.push(format!(
            "the catalogues of different shears have different numbers of rows. If their rows do not correspond, {wrong}. Try: {units}"
        )),
        None => {}
    }
    if result.grouping.assumed_different && result.grouping.unpaired.is_none() {
        lines.push(format!(
            "names do not state which catalogues of a shear contain the same galaxies as others, such as rotations, noise realisations or bands: the k-th catalogues of each shear are a unit. If catalogues of one shear contain the same galaxies, errors are wrong. Try: {units}, or names that have the same number under each shear"
        ));
    }
    lines.extend(without_partner(result));
    lines
}

// Part of a variance from which galaxies without partner matter: σ(m) is √2 times as large as without them.
const MANY_WITHOUT_PARTNER: f64 = 0.5;
// Above it, the estimate of this part does not determine how much larger σ(m) is.
const MOST_OF_VARIANCE: f64 = 0.999;

fn without_partner(result: &BiasResult) -> Option<String> {
    let own = result.grouping.without_partner?;
    let share = own.share.into_iter().fold(0.0, f64::max);
    let cost = match share {
        share if share < MANY_WITHOUT_PARTNER => return None,
        share if share > MOST_OF_VARIANCE => "most of the variance of m is theirs".to_owned(),
        share => format!(
            "σ(m) is about {:.1} times as large",
            (1.0 - share).sqrt().recip()
        ),
    };
    Some(format!(
        "about {:.0} of {:.0} galaxies count under one of two opposite shears only. Their shapes do not cancel: {cost}. Try: --paired for the galaxies that count under both, whose m contains no selection",
        own.galaxies.max(1.0),
        own.of,
    ))
}

const MAX_MISSING: usize = 5;

fn notes(result: &BiasResult) -> Vec<String> {
    let Ok(all) = result.all() else {
        return Vec::new();
    };
    let mut notes = vec![
        format!(
            "Design: {} ({}). Columns: {}.",
            result.design.name(),
            result.design.meaning(),
            result.about.program
        ),
        units(result, all),
    ];
    match (&result.about.unit_column, &result.about.named_unit) {
        (Some(column), None) => notes.push(format!(
            "`{column}` looks like independent units, and is not used. Errors miss the scatter between them. Try: --units {column}"
        )),
        (Some(column), Some(unit)) => notes.push(format!(
            "`{column}` looks like independent units, too. If they are larger than those of `{unit}`, errors miss the scatter between them. Try: --units {column}"
        )),
        (None, _) => {}
    }
    if result.about.paired {
        notes.push(format!(
            "Only galaxies that count under all test shears are used: {} rows have no partner. m does not contain how shear changes which galaxies are selected.",
            result.about.total().without_partner
        ));
    }
    if result.outside > 0 {
        notes.push(format!(
            "{} galaxies are outside of the bins, and count in the row of all.",
            result.outside
        ));
    }
    notes.extend(populations(result));
    notes.extend(result.about.columns.iter().cloned());
    notes.extend(result.about.without_catalogue.iter().cloned());
    notes.extend(result.about.sign.and_then(Sign::line));
    match result.grouping.stars.len() {
        0 => {}
        1 => notes.push("They include the noise of a star that several units share.".into()),
        count => notes.push(format!(
            "They include the noise of {count} stars that several units share."
        )),
    }
    if let Some(selection) = &result.about.selection {
        notes.push(format!("Selection: {selection}."));
    }
    if all.units < MANY_UNITS {
        // The two-sided probability of one standard deviation of a normal distribution.
        let one_sigma = student_t(0.841_345, all.units - 1);
        let first = match all.units < FEW_UNITS {
            true => {
                format!("the errors are {one_sigma:.2} times as large at 68 % confidence, and ")
            }
            false => String::new(),
        };
        notes.push(format!(
            "With {} units, {first}95 % confidence is {:.2} standard errors (Student's t).",
            all.units,
            student_t(0.975, all.units - 1)
        ));
    }
    notes.extend(implausible(result, all).or_else(|| uncalibrated(result, all)));
    notes.extend(of_design(result).iter().map(|line| sentence(line)));
    notes.extend(left_out(result));
    let total = result.about.total();
    let failed = total.missing + total.failed;
    if failed > 0 {
        notes.push(format!(
            "Leaving out the {failed} rows that failed is a selection, because shear changes which measurements fail: m contains its effect. Try: a flag and responses of a method that measures all galaxies, or --paired for pairs."
        ));
    }
    let few = repeated(&result.about.catalogues, false);
    notes.extend(few.iter().map(|line| sentence(line)));
    notes.extend(chosen_by_measurement(result));
    for (k, assumes) in (1..).zip(all.assumes_no_c) {
        if assumes {
            notes.push(format!(
                "All true g{k} are equal, so m{k} assumes that c{k} is zero."
            ));
        }
    }
    notes.extend(no_ellipticities(result, all));
    match result.design {
        Design::Null => notes.push(
            "Without a true shear, c is the mean shear, which is a bias only if the galaxies have no mean shear. Try: --g1 and --g2, --truth FILE or --columns g1=NAME,g2=NAME for m".into(),
        ),
        _ => {
            notes.extend(verdicts(all));
            notes.extend(verdicts_in_bins(result));
        }
    }
    notes
}

// What the errors are estimated from.
fn units(result: &BiasResult, all: &Estimate) -> String {
    let unit = match &result.about.named_unit {
        Some(column) => format!("galaxies with the same `{column}`"),
        None => result.grouping.unit.to_owned(),
    };
    format!("Errors are from {} units: {unit}.", all.units)
}

// Rows that do not count, a sentence for each reason.
fn left_out(result: &BiasResult) -> Vec<String> {
    let total = result.about.total();
    let reasons = [
        (total.flagged, "with a flag"),
        (total.unweighted, "with a weight of zero or less"),
        (total.unselected, "that --where excludes"),
        (total.missing, "with missing numbers"),
        (
            total.failed,
            "with numbers that stand for failed measurements",
        ),
        (
            total.above_one,
            "with a distortion above 1, which noise makes and to which no shear belongs",
        ),
    ];
    let found = reasons.iter().filter(|(count, _)| *count > 0);
    let lines = found.map(|(count, what)| format!("Left out: {count} rows {what}."));
    lines.collect()
}

/// The mean shear of catalogues without a true shear: c is then ⟨e⟩/R of all galaxies.
pub fn mean_shear_table(result: &BiasResult) -> Result<Table, BiasError> {
    let all = [result.all()?];
    let mut table = Table::titled("Mean shear");
    table.column("galaxies", "Galaxies", &all, |all| {
        Cell::number(all.galaxies as f64, 0)
    });
    for (key, c) in [("g1", "c1"), ("g2", "c2")] {
        table.column(key, key, &all, |all| quantity_cell(all, c));
    }
    for (key, label) in [("r1", "⟨R11⟩"), ("r2", "⟨R22⟩")] {
        if all[0].value(key).is_some() {
            table.column(key, label, &all, |all| quantity_cell(all, key));
        }
    }
    table.notes = vec![
        format!("Columns: {}.", result.about.program),
        units(result, all[0]),
    ];
    table.notes.extend(result.about.columns.iter().cloned());
    let selection = result.about.selection.iter();
    table
        .notes
        .extend(selection.map(|own| format!("Selection: {own}.")));
    table.notes.extend(left_out(result));
    table.notes.extend(chosen_by_measurement(result));
    Ok(table)
}

fn quantity_cell(estimate: &Estimate, key: &str) -> Cell {
    let found = estimate.value(key);
    let (value, error) = found.map_or((f64::NAN, f64::NAN), |own| (own.value, own.error));
    Cell::with_error(value, Some(error), 6)
}

// What the survey of `--like` has that the simulated galaxies do not have.
fn populations(result: &BiasResult) -> Vec<String> {
    let Some(survey) = result.populations.first() else {
        return Vec::new();
    };
    let mut lines = vec![format!(
        "Rows `like` are of the simulated galaxies with weights by which their share in each of the {} bins of {} is that of the survey ({} galaxies, {}). Errors are those of the simulated galaxies.",
        result.about.cells.count(),
        result.about.cells.names(),
        survey.galaxies,
        survey.columns
    )];
    if !survey.unused.is_empty() {
        lines.push(format!(
            "Not used of the survey: {}. Try: a table of the galaxies that count, with their weights in a column w",
            survey.unused.join(", ")
        ));
    }
    for own in &result.populations {
        let total: f64 = own.uncovered.iter().map(|(_, share)| share).sum();
        if total == 0.0 {
            continue;
        }
        let first = own.uncovered.iter().take(MAX_MISSING);
        let first: Vec<String> = first
            .map(|(label, share)| format!("{label} ({:.2} %)", 100.0 * share))
            .collect();
        let more = match own.uncovered.len().saturating_sub(MAX_MISSING) {
            0 => String::new(),
            more => format!(", and {more} more"),
        };
        lines.push(format!(
            "{}: {:.2} % of the weights of the survey have no simulated galaxies, and m of them is unknown: {}{more}.",
            own.label,
            100.0 * total,
            first.join(", ")
        ));
    }
    lines
}

// Share of rows with |e| above 1 from which e1 and e2 are hardly shear-type ellipticities: noise of 0.3 per component makes
// 0.4 % of them.
const MANY_BEYOND: f64 = 0.005;
// Mean of an ellipticity without a true shear that no PSF residual explains. Chosen by hand.
const LARGE_MEAN: f64 = 0.1;
// Rows from which components of one sign are no coincidence: 2⁻⁵⁰.
const MANY_OF_ONE_SIGN: u64 = 50;

// Lines about numbers that are no ellipticities: moduli and angles, percent, degrees, magnitudes. A response allows any scale.
fn no_ellipticities(result: &BiasResult, all: &Estimate) -> Vec<String> {
    if result.about.response {
        return other_unit(result, all).into_iter().collect();
    }
    let total = result.about.total();
    let used = all.galaxies as f64;
    let mut lines = Vec::new();
    for (rows, limit) in total.beyond.iter().zip([1, 2]).rev() {
        let share = *rows as f64 / used;
        if share > MANY_BEYOND && lines.is_empty() {
            lines.push(format!(
                "{:.1} % of the rows have |e| above {limit}, which no ellipticity of shear type has. Percent, degrees, or noise? Try: --columns with other columns, or --where to leave failed rows out",
                100.0 * share
            ));
        }
    }
    for k in 0..2 {
        let low = result.about.catalogues.iter().filter(|own| own.rows > 0);
        let low = low
            .map(|own| own.ellipticity[k].low)
            .fold(f64::MAX, f64::min);
        if low >= 0.0 && all.galaxies as u64 >= MANY_OF_ONE_SIGN {
            lines.push(format!(
                "e{0} is never negative. Is it the modulus |e|, with an angle in another column? Try: --columns with the columns of e1 and e2",
                k + 1
            ));
        }
        let c = all.value(["c1", "c2"][k]);
        if let Some(c) =
            c.filter(|c| c.value.abs() > LARGE_MEAN + IMPLAUSIBLE_SIGNIFICANCE * c.error)
        {
            lines.push(format!(
                "c{} is {:+.2}, which no method of measuring shapes leaves (expected a modulus below {LARGE_MEAN}). Is the column an ellipticity?",
                k + 1,
                c.value
            ));
        }
    }
    lines
}

fn sentence(line: &str) -> String {
    let mut letters = line.chars();
    let first = letters.next().into_iter().flat_map(char::to_uppercase);
    let line: String = first.chain(letters).collect();
    line + "."
}

// Share of repeated rows from which m or c is wrong by the requirement on m or more, which is a warning: ellipticities that are zero
// in 1 % of the rows change m by −0.01.
const MANY_REPEATED: f64 = 0.01;

// Lines about numbers that several rows share exactly, such as zeros for failed measurements: those of many rows or of few.
fn repeated(catalogues: &[Catalogue], of_many: bool) -> Vec<String> {
    let mut all: Vec<Repeated> = Vec::new();
    for own in catalogues.iter().flat_map(|own| &own.repeated) {
        let known = all.iter().position(|other| other.columns == own.columns);
        match known.map(|place| &mut all[place]) {
            Some(other) if other.values == own.values => other.rows += own.rows,
            Some(_) => {}
            None => all.push(own.clone()),
        }
    }
    let rows: u64 = catalogues.iter().map(|own| own.rows).sum();
    let is_wanted = |count: u64| (count as f64 >= MANY_REPEATED * rows as f64) == of_many;
    all.retain(|own| is_wanted(own.rows));
    let line = |own: &Repeated| {
        let ([a, b], [first, second]) = (&own.columns, own.values.map(shown));
        if a == b {
            return format!(
                "repeated values: `{a}` is exactly {first} in {} of {rows} rows, which count; measured values do not repeat. If this stands for a failure, try: --where '{a} != {first}'",
                own.rows
            );
        }
        format!(
            "repeated values: `{a}` and `{b}` are exactly {first} and {second} in {} of {rows} rows, which count; measured values do not repeat. If this stands for a failure, try: --where '{a} != {first}'",
            own.rows
        )
    };
    let mut lines: Vec<String> = all.iter().map(line).collect();
    let sum = |of: fn(&Catalogue) -> u64| catalogues.iter().map(of).sum::<u64>();
    let copies = sum(|own| own.copies);
    if copies > 0 && is_wanted(copies) {
        lines.push(format!(
            "repeated rows: {copies} of {rows} rows have the numbers of an earlier row of their catalogue, so that galaxies count several times and the errors are too small. Try: a catalogue with each galaxy once"
        ));
    }
    let shared = sum(|own| own.shared_identifiers);
    if shared > 0 && is_wanted(shared) {
        lines.push(format!(
            "repeated identifiers: {shared} of {rows} rows have the identifier of an earlier row of their catalogue, and galaxies that share one form one unit of the errors. Try: --columns id=NAME, or id=none if they do not name galaxies"
        ));
    }
    lines
}

// A quantity compared with the requirements that have one limit.
struct Compared {
    names: Vec<&'static str>,
    sources: Vec<String>,
    of: char,
    limit: f64,
    key: String,
    measured: Measured,
    verdict: Verdict,
}

// Estimates against published requirements, at 95 % confidence.
fn compared(all: &Estimate) -> Vec<Compared> {
    let mut found: Vec<Compared> = Vec::new();
    for requirement in REQUIREMENTS {
        for component in [1, 2] {
            let key = format!("{}{component}", requirement.of);
            let Some(measured) = all.value(&key).filter(|found| found.error.is_finite()) else {
                continue;
            };
            let source = format!("{}: {}", requirement.name, requirement.source);
            let like = |own: &&mut Compared| own.key == key && own.limit == requirement.limit;
            match found.iter_mut().find(like) {
                Some(own) => {
                    own.names.push(requirement.name);
                    own.sources.push(source);
                }
                None => found.push(Compared {
                    names: vec![requirement.name],
                    sources: vec![source],
                    of: requirement.of,
                    limit: requirement.limit,
                    verdict: verdict(measured, requirement.limit, all.galaxies, all.units),
                    key,
                    measured,
                }),
            }
        }
    }
    found
}

// The comparison with requirements in words, a line per limit.
fn verdicts(all: &Estimate) -> Vec<String> {
    let found = compared(all);
    let limits = found.chunk_by(|a, b| (a.of, a.limit) == (b.of, b.limit));
    let lines = limits.filter_map(|of_limit| {
        let parts = of_limit.iter().map(|own| match own.verdict {
            Verdict::Met => format!("{} met", own.key),
            Verdict::NotMet => format!("{} not met", own.key),
            Verdict::Undecided { galaxies } => {
                format!(
                    "{} undecided (about {galaxies:.1e} galaxies would decide if the value stays)",
                    own.key
                )
            }
        });
        let first = of_limit.first()?;
        Some(format!(
            "{}: |{}| below {:e}: {}.",
            first.names.join(", "),
            first.of,
            first.limit,
            parts.collect::<Vec<_>>().join(", ")
        ))
    });
    lines.collect()
}

// The comparison with requirements in each bin, a line per limit: which bins do not meet it, are undecided or meet it.
fn verdicts_in_bins(result: &BiasResult) -> Vec<String> {
    type Bins = Vec<(String, Vec<String>)>;
    type OfLimit = (String, [Bins; 3]);
    let mut lines: Vec<OfLimit> = Vec::new();
    for bin in &result.bins[1..] {
        let Ok(found) = &bin.estimate else { continue };
        for own in compared(found) {
            let title = format!(
                "{}: |{}| below {:e}",
                own.names.join(", "),
                own.of,
                own.limit
            );
            let at = lines.iter().position(|(known, _)| *known == title);
            let at = at.unwrap_or_else(|| {
                lines.push((title, Default::default()));
                lines.len() - 1
            });
            let kind = match own.verdict {
                Verdict::NotMet => 0,
                Verdict::Undecided { .. } => 1,
                Verdict::Met => 2,
            };
            let bins = &mut lines[at].1[kind];
            match bins.last_mut().filter(|(label, _)| *label == bin.label) {
                Some((_, keys)) => keys.push(own.key),
                None => bins.push((bin.label.clone(), vec![own.key])),
            }
        }
    }
    let line = |(title, bins): OfLimit| {
        let kinds = ["not met in", "undecided in", "met in"]
            .into_iter()
            .zip(bins);
        let mut parts = kinds.filter(|(_, bins)| !bins.is_empty());
        // One verdict on all bins needs no list.
        let everywhere = || {
            let (kind, bins) = parts.clone().next()?;
            let (_, keys) = bins.first()?;
            let is_only = parts.clone().count() == 1 && bins.len() > 1;
            let is_equal = bins.iter().all(|(_, own)| own == keys);
            (is_only && is_equal)
                .then(|| format!("{kind} all {} ({})", bins.len(), keys.join(", ")))
        };
        let everywhere = everywhere();
        let parts = parts.by_ref().map(|(kind, bins)| {
            let more = match bins.len().saturating_sub(MAX_NAMED_BINS) {
                0 => String::new(),
                more => format!(" and {more} more"),
            };
            let first = bins.into_iter().take(MAX_NAMED_BINS);
            let first: Vec<String> = first
                .map(|(label, keys)| format!("{label} ({})", keys.join(", ")))
                .collect();
            format!("{kind} {}{more}", first.join(", "))
        });
        let parts: Vec<String> = match everywhere {
            Some(text) => vec![text],
            None => parts.collect(),
        };
        format!("In bins, {title}: {}.", parts.join("; "))
    };
    lines.into_iter().map(line).collect()
}

const MAX_NAMED_BINS: usize = 12;

// The comparison with requirements, a row per quantity and limit.
fn requirement_table(all: &Estimate) -> Table {
    let rows = compared(all).into_iter().map(|own| {
        let Measured { value, error } = own.measured;
        let (verdict, galaxies) = match own.verdict {
            Verdict::Met => ("met", f64::NAN),
            Verdict::NotMet => ("not met", f64::NAN),
            Verdict::Undecided { galaxies } => ("undecided", galaxies),
        };
        vec![
            Cell::text(&own.key),
            Cell::with_error(value, Some(error), 6),
            Cell::text(format!("{:e}", own.limit)),
            Cell::text(verdict),
            Cell::number(galaxies, 0),
            Cell::text(own.sources.join("; ")),
        ]
    });
    Table {
        title: "Verdict: published requirements at 95 % confidence".into(),
        rows: rows.collect(),
        headings: vec![
            Heading::new("quantity", "Quantity"),
            Heading::new("value", "Value"),
            Heading::new("limit", "Largest modulus"),
            Heading::new("verdict", "Verdict"),
            Heading::new("deciding", "Galaxies to decide"),
            Heading::new("source", "Required by"),
        ],
        notes: Vec::new(),
    }
}

/// A limit of `--fail-above`.
#[derive(Debug, Clone, PartialEq)]
pub struct Limit {
    /// `m` or `c` for both components, or one quantity.
    pub of: String,
    /// Largest modulus.
    pub limit: f64,
    /// The modulus must exceed the limit by so many standard errors.
    pub sigma: f64,
}

impl std::str::FromStr for Limit {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let expected =
            || format!("found `{text}`, expected QUANTITY=LIMIT or QUANTITY=LIMIT@Ksigma");
        let (of, rest) = text.split_once('=').ok_or_else(expected)?;
        let (limit, sigma) = rest.split_once('@').unwrap_or((rest, "0"));
        let sigma = sigma.strip_suffix("sigma").unwrap_or(sigma);
        let number = |text: &str| {
            text.parse()
                .ok()
                .filter(|n: &f64| n.is_finite() && *n >= 0.0)
        };
        let (limit, sigma) = number(limit).zip(number(sigma)).ok_or_else(expected)?;
        let known = ["m", "c"].contains(&of) || QUANTITIES.iter().any(|own| own.key == of);
        if !known {
            return Err(format!(
                "unknown quantity (found `{of}`, expected m, c, m1, c1, …)"
            ));
        }
        Ok(Limit {
            of: of.to_owned(),
            limit,
            sigma,
        })
    }
}

/// A quantity checked against a limit.
#[derive(Debug, Clone, PartialEq)]
pub struct Checked {
    /// The bin.
    pub bin: String,
    /// The quantity.
    pub key: String,
    /// What was found and expected, in words.
    pub text: String,
    /// Whether the limit is exceeded, or the quantity is unknown.
    pub failed: bool,
}

/// Checks the estimates of all galaxies and of each bin. A limit of `m` or `c` applies to the components that are known.
pub fn check(result: &BiasResult, limits: &[Limit]) -> Vec<Checked> {
    let mut checks = Vec::new();
    for bin in &result.bins {
        for limit in limits {
            match &bin.estimate {
                Ok(found) => check_bin(&mut checks, &bin.label, found, limit),
                Err(error) => checks.push(Checked {
                    bin: bin.label.clone(),
                    key: limit.of.clone(),
                    text: format!("{} cannot be compared with its limit: {error}", limit.of),
                    failed: true,
                }),
            }
        }
    }
    // All galaxies need no name if there are no bins.
    if result.bins.len() > 1 {
        for check in &mut checks {
            check.text = format!("{}: {}", check.bin, check.text);
        }
    }
    checks
}

fn check_bin(checks: &mut Vec<Checked>, bin: &str, found: &Estimate, limit: &Limit) {
    let keys: Vec<String> = match limit.of.as_str() {
        of @ ("m" | "c") => [1, 2]
            .map(|k| format!("{of}{k}"))
            .into_iter()
            .filter(|key| found.value(key).is_some())
            .collect(),
        of => vec![of.to_owned()],
    };
    let unknown = |key: &str| Checked {
        bin: bin.to_owned(),
        key: key.to_owned(),
        text: format!("{key} is unknown (expected a true shear that determines it)"),
        failed: true,
    };
    if keys.is_empty() {
        checks.push(unknown(&limit.of));
    }
    for key in keys {
        let Some(Measured { value, error }) = found.value(&key) else {
            checks.push(unknown(&key));
            continue;
        };
        // An unknown error fails, too: without it, a value cannot be distinguished from the limit.
        let passed = value.abs() - limit.sigma * error <= limit.limit;
        let text = match error.is_nan() {
            true => format!(
                "|{key}| cannot be compared with its limit, because its standard error is unknown (found {value:.2e}, expected at most {:e}). Try: more catalogues or galaxies",
                limit.limit
            ),
            false => {
                let within = match limit.sigma {
                    0.0 => String::new(),
                    sigma => format!(" within {sigma} standard errors"),
                };
                format!(
                    "|{key}| exceeds its limit (found {value:.2e} ± {error:.1e}, expected at most {:e}{within})",
                    limit.limit
                )
            }
        };
        checks.push(Checked {
            bin: bin.to_owned(),
            text,
            key,
            failed: !passed,
        });
    }
}

/// Adds a column of the quantities that exceed their limits to the table of a result, whose first column is named `of`.
pub fn with_failures(table: &mut Table, of: &'static str, checks: &[Checked]) {
    let Some(place) = table.place(of) else { return };
    table
        .headings
        .push(Heading::new("exceeds", "Exceeds its limit"));
    // Of a comparison, the difference has the limits.
    let side = table.place("of");
    for row in &mut table.rows {
        let has_limits = side.is_none_or(|side| row[side] == Cell::text("difference"));
        let (Cell::Text(bin), true) = (&row[place], has_limits) else {
            row.push(Cell::Empty);
            continue;
        };
        let failed = checks.iter().filter(|own| own.failed && own.bin == *bin);
        let keys: Vec<&str> = failed.map(|own| own.key.as_str()).collect();
        row.push(Cell::text(match keys.is_empty() {
            true => "none".to_owned(),
            false => keys.join(" "),
        }));
    }
}

/// Plots of m and c in bins, or of all galaxies, with the tightest published requirement as a band.
pub fn bias_plot(result: &BiasResult) -> PanelGrid {
    let binned = result.bins.len() > 1;
    // All galaxies are shown if there are no bins.
    let shown = || {
        let bins = result.bins.iter();
        bins.filter(|bin| !binned || bin.label != "all").enumerate()
    };
    // Bins of several quantities, of texts and of surveys stand at their numbers.
    let cells = &result.about.cells;
    let by_number = cells.axes.len() > 1 || !cells.are_stated() || !result.populations.is_empty();
    let middle = |(number, bin): (usize, &BinResult)| match by_number {
        true => number as f64,
        false => middle(&bin.ranges),
    };
    let (first, last) = shown().fold((f64::MAX, f64::MIN), |(first, last), bin| {
        let at = middle(bin);
        (first.min(at), last.max(at))
    });
    // Points of both components stand side by side.
    let apart = 0.012 * if last > first { last - first } else { 1.0 };
    let limit = |of: char| {
        let limits = REQUIREMENTS.iter().filter(|own| own.of == of);
        limits.map(|own| own.limit).fold(f64::MAX, f64::min)
    };
    let plots = ['m', 'c'].into_iter().filter_map(|of| {
        let (mut series, mut names) = (Vec::new(), Vec::new());
        for (component, colour) in [(1, 0), (2, 1)] {
            let key = format!("{of}{component}");
            let (mut x, mut y, mut errors) = (Vec::new(), Vec::new(), Vec::new());
            if !binned {
                names.push(key.clone());
            }
            for (number, bin) in shown() {
                let found = bin.estimate.as_ref().ok();
                if let Some(Measured { value, error }) = found.and_then(|found| found.value(&key)) {
                    x.push(match binned {
                        true => middle((number, bin)) + (f64::from(component) - 1.5) * apart,
                        false => f64::from(component) - 1.0,
                    });
                    y.push(value);
                    errors.push(error);
                }
            }
            if !x.is_empty() {
                // One entry of the legend for both panels.
                let label = match binned {
                    true => format!("m{component}, c{component}"),
                    false => String::new(),
                };
                series.push(Series::new(&label, x, y, Style::Points, colour).with_errors(errors));
            }
        }
        (!series.is_empty()).then(|| LinePlot {
            title: match of {
                'm' => "Multiplicative bias".into(),
                _ => "Additive bias".into(),
            },
            x_label: match by_number && binned {
                true => format!("bins of {}, in the order of the table", cells.names()),
                false => cells.names(),
            },
            x_names: names,
            y_label: of.into(),
            bands: vec![Band {
                label: format!(
                    "tightest requirement: |m| < {}, |c| < {}",
                    limit('m'),
                    limit('c')
                ),
                low: -limit(of),
                high: limit(of),
            }],
            series,
            ..LinePlot::default()
        })
    });
    PanelGrid {
        title: "Shear bias".into(),
        columns: 2,
        plots: plots.collect(),
    }
}

fn middle(ranges: &[[f64; 2]]) -> f64 {
    match ranges {
        [] => 0.0,
        [[f64::MIN, high], ..] => *high,
        [[low, f64::MAX], ..] => *low,
        [[low, high], ..] => 0.5 * (low + high),
    }
}

/// The section of a report.
pub fn section(result: &BiasResult, mut table: Table) -> Result<Section, FigureError> {
    let caption = "m and c with standard errors. Grey: the tightest published requirement.";
    let picture = Picture::draw(&bias_plot(result), "bias", caption)?;
    let mut required = None;
    if let Ok(all) = result.all() {
        let verdicts = verdicts(all);
        table.notes.retain(|note| !verdicts.contains(note));
        required = Some(requirement_table(all))
            .filter(|table| !table.rows.is_empty() && result.design != Design::Null);
    }
    let mut blocks = vec![Block::Table(table), Block::Figure(picture)];
    blocks.extend(required.map(Block::Table));
    Ok(Section::new("bias", "Shear bias", blocks))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_are_parsed_or_refused() {
        let parse = |text: &str| text.parse::<Limit>();
        let limit = parse("m=2e-3@3sigma").unwrap();
        assert_eq!(
            (limit.of.as_str(), limit.limit, limit.sigma),
            ("m", 2e-3, 3.0)
        );
        assert_eq!(parse("c1=1e-4").unwrap().sigma, 0.0);
        for wrong in ["m", "m=", "m=x", "m=1@", "q9=1", "m=-1", "m=1@nan"] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
    }
}
