#!/usr/bin/env python3
"""Which reading of what the paper leaves open fits its statements best. See README.md beside this file."""

import argparse
import copy
import csv
import hashlib
import itertools
import json
import os
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np

import score

HERE = Path(__file__).resolve().parent
# Rows of Table 1 that a simulation tells apart, and the submission that each rests on.
ROWS = {
    "23/raw": "as-printed/23/raw/star",
    "23/den": "as-printed/23/den/star",
    "29/den": "as-printed/29/den/func",
}
# Rows measured while tuning: 29 px cost as much as both others.
FIRST_ROWS = ["23/raw", "23/den"]


def merged(base, over):
    """Nested tables, `over` over `base`."""
    result = copy.deepcopy(base)
    for key, value in over.items():
        if isinstance(value, dict):
            result[key] = merged(result.get(key, {}), value)
        else:
            result[key] = value
    return result


def readings(path):
    """All readings of a file, those spanned by `vary` too: name to (note, settings, denoise, choices)."""
    found = {}

    def add(entry, more, settings, denoise):
        # What is read otherwise than by the printed submissions.
        choices = sum(len(section) for section in settings.values()) + len(denoise)
        found[entry["name"] + more] = {
            "note": entry.get("note", ""),
            "settings": settings,
            "denoise": denoise,
            "calibration": merged(settings, entry.get("calibration", {})),
            "choices": choices,
        }

    for entry in tomllib.loads(path.read_text())["reading"]:
        settings, denoise = entry.get("settings", {}), entry.get("denoise", {})
        add(entry, "", settings, denoise)
        vary = entry.get("vary", {})
        one = [[(key, value)] for key, values in vary.items() for value in values]
        every = [list(zip(vary, values)) for values in itertools.product(*vary.values())]
        for changes in every if entry.get("product") else one:
            own, own_denoise, words = settings, denoise, []
            for key, value in changes:
                section, key = key.split(".")
                words.append(f"{key} {value}")
                if section == "denoise":
                    own_denoise = merged(own_denoise, {key: value})
                else:
                    own = merged(own, {section: {key: value}})
            add(entry, f", {', '.join(words)}", own, own_denoise)
    return found


def settings_file(reading, row):
    """TOML of a row of Table 1 under a reading. Its name is the same for all readings: settings tell them apart."""
    sections = copy.deepcopy(reading["settings"])
    if "den" in row and reading["denoise"]:
        sections["denoise"] = reading["denoise"]
    return toml(ROWS[row], sections)


def calibration_file(reading):
    """TOML of Sect. 4 under a reading."""
    return toml("as-printed/paper", reading["calibration"])


def toml(base, sections):
    """Settings over those of a named submission."""
    lines = [f'extends = "{base}"']
    for section in sorted(sections):
        lines.append(f"[{section}]")
        lines += [f"{key} = {json.dumps(value)}" for key, value in sorted(sections[section].items())]
    return "\n".join(lines) + "\n"


class Cells:
    """What the binary measured, kept in a folder: one file a cell, named by all that it depends on."""

    def __init__(self, binary, folder, threads):
        self.binary, self.folder, self.threads = binary, folder, threads
        self.folder.mkdir(parents=True, exist_ok=True)
        # Another binary may measure otherwise.
        self.version = hashlib.sha256(Path(binary).read_bytes()).hexdigest()
        self.seconds = 0.0

    def path(self, *what):
        key = hashlib.sha256(json.dumps([self.version, *what]).encode()).hexdigest()[:24]
        return self.folder / f"{what[0]}-{key}.json"

    def run(self, *arguments):
        start = time.monotonic()
        command = [self.binary, *map(str, arguments), "--threads", str(self.threads)]
        done = subprocess.run(command, capture_output=True, text=True)
        self.seconds += time.monotonic() - start
        if done.returncode != 0:
            raise SystemExit(f"{' '.join(command)}\n{done.stderr}")

    def write(self, path, value):
        """Whole or not at all."""
        part = path.with_suffix(".part")
        part.write_text(json.dumps(value))
        os.replace(part, path)

    def study(self, texts, galaxies, seed):
        """Response, variance and the like of submissions (settings by row) on a set of each kind.

        A fifth of the galaxies are measured once, for their scatter; a tenth are drawn in eight versions each,
        with the shear, the intrinsic ellipticity and the noise of either sign, for their response.
        """
        grid = max(8, round((galaxies / 10) ** 0.5))
        place = {
            (row, kind): self.path("cell", text, score.KINDS[kind][0], grid, seed)
            for row, text in texts.items()
            for kind in score.KINDS
        }
        todo = [row for row in texts if any(not place[row, kind].exists() for kind in score.KINDS)]
        if todo:
            # The same work is gone on with if it was stopped.
            work = self.path("work", sorted(texts[row] for row in todo), grid, seed).with_suffix("")
            work.mkdir(exist_ok=True)
            arguments = []
            for row in todo:
                file = work / f"{row.replace('/', '-')}.toml"
                file.write_text(f'name = "{row}"\n' + texts[row])
                arguments += ["--submission", file]
            sets = ",".join(str(s) for s, _, _, _ in score.KINDS.values())
            arguments += ["--sets", sets, "--images", 2, "--pairs", 1, "--grid", grid, "--seed", seed]
            self.run("study", *arguments, "--out", work / "study", "--format", "json")
            for kind, (number, _, _, _) in score.KINDS.items():
                plain = json.loads((work / f"study/sets/set{number:02}.json").read_text())
                pairs = json.loads((work / f"study/bias/set{number:02}-1.json").read_text())
                for row, result, bias in zip(todo, plain["results"], pairs["biases"]):
                    self.write(place[row, kind], cell(result["response"], bias))
            shutil.rmtree(work)
        return {
            row: {kind: json.loads(place[row, kind].read_text()) for kind in score.KINDS} for row in texts
        }

    def calibrate(self, text, galaxies, seed):
        """Curves of Sect. 4."""
        path = self.path("curves", text, galaxies, seed)
        if not path.exists():
            work = path.with_suffix("")
            work.mkdir(exist_ok=True)
            file = work / "calibrated.toml"
            file.write_text('name = "calibrated"\n' + text)
            self.run("calibrate", "--submission", file, "--galaxies", galaxies, "--seed", seed, "--out", work)
            with open(work / "data/curves.csv", newline="") as table:
                rows = list(csv.DictReader(table))
            curves = {}
            for row in rows:
                curve = curves.setdefault(row["update"], {}).setdefault(row["snr_db"].split(".")[0], {})
                for key in ("ctr", "dsnr_db", "inverse_rmsd"):
                    # Nothing where there is no number: no neuron has changed.
                    curve.setdefault(key, []).append(float(row[key] or "nan"))
            lam = sorted({float(row["log10_lambda"]) for row in rows})
            self.write(path, curves | {"log_lambda": lam})
            shutil.rmtree(work)
        return json.loads(path.read_text())


def cell(response, bias):
    """Of a submission's records of a set: response to shear and variance about it, of a catalogue in which flagged
    galaxies are missing, which counts as zero."""
    number = lambda value: float("nan") if value is None else value
    measured = response["galaxies"] / max(response["galaxies"] + response["flagged"], 1)
    # The scatter is that after dividing by the slope.
    spread = [(number(s) * number(k)) ** 2 for s, k in zip(response["scatter"], response["slope"])]
    return {
        "response": [(1 + number(m)) * measured for m in bias["m"]],
        "response_error": [number(e) for e in bias["m_error"]],
        "variance": [v * measured for v in spread],
        "slope": [number(k) for k in response["slope"]],
        "leakage": number(bias["leakage"]),
        "measured": measured,
    }


def evaluate(cells, reading, rows, galaxies, calibration, seed, statements):
    texts = {row: settings_file(reading, row) for row in rows}
    measured = cells.study(texts, galaxies, seed)
    curves = cells.calibrate(calibration_file(reading), calibration, seed) if calibration else None
    return score.judge(statements, measured, curves) | {"cells": measured}


def table(results, found, heading):
    """Readings in order of their χ², as lines of Markdown; plain: with the simulator's own spectrum, S/N and sizes."""
    lines = [
        f"### {heading}",
        "",
        "| reading | choices | χ² | best χ² | A, S/N, size | Q raw, den, 29 | M/2 raw, den, 29 | √A raw | den/raw | plain: Q raw, den, 29 | plain: M/2 raw, den, 29 | leakage raw, den |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    show = lambda figures, key, digits: f"{figures[key]:.{digits}f}" if key in figures else "–"
    for name, result in sorted(results.items(), key=lambda item: item[1]["marginal"]):
        f, p, n = result["metrics"], result["plain"], result["nuisances"]
        three = lambda what, digits, of=f: ", ".join(show(of, f"{what} {row}", digits) for row in ROWS)
        leakage = lambda row: f"{result['cells'][row]['fiducial']['leakage']:.2f}" if row in result["cells"] else "–"
        lines.append(
            f"| {name} | {found[name]['choices']} | {result['marginal']:.1f} | {result['best']:.1f} "
            f"| {n['amplitude']:g}, {n['snr']:g}, {n['size']:g} | {three('q', 1)} | {three('m_half', 3)} "
            f"| {show(f, 'sqrt_a 23/raw', 3)} | {show(f, 'q 23/den over q 23/raw', 3)} "
            f"| {three('q', 1, p)} | {three('m_half', 3, p)} | {leakage('23/raw')}, {leakage('23/den')} |"
        )
    return "\n".join(lines) + "\n"


def statement_table(results, statements, names):
    """Statements by readings: the figure, and by how many tolerances it misses."""
    lines = ["| statement | paper | " + " | ".join(names) + " |", "|---" * (2 + len(names)) + "|"]
    for s in statements:
        bound = next(f"{sign}{s[key]:g}" for key, sign in [("value", ""), ("above", "> "), ("below", "< ")] if key in s)
        tell = lambda r: "{:.3g} ({:.1f})".format(*r["statements"][s["id"]]) if s["id"] in r["statements"] else "–"
        lines.append(f"| {s['id']} | {bound} ± {s['tolerance']:g} | " + " | ".join(tell(results[n]) for n in names) + " |")
    return "\n".join(lines) + "\n"


def main():
    parse = argparse.ArgumentParser(description=__doc__)
    parse.add_argument("--binary", default="target/release/shearq", help="shearq")
    parse.add_argument("--galaxies", type=int, default=50_000, help="stamps of a cell (a kind of set, a row)")
    parse.add_argument("--seen", type=int, help="stamps of a cell in the first look at all readings (default: a tenth of --galaxies)")
    parse.add_argument("--calibration", type=int, default=200, help="galaxies of Sect. 4's curves; 0 leaves them out")
    parse.add_argument("--readings", type=Path, default=HERE / "readings.toml")
    parse.add_argument("--statements", type=Path, default=HERE / "statements.toml")
    parse.add_argument("--only", help="readings to look at, by the beginnings of their names, separated by semicolons")
    parse.add_argument("--keep", type=int, default=6, help="readings that are judged on the second seed; twice as many are tuned, and 0 ends with the first look")
    parse.add_argument("--seeds", type=int, nargs=2, default=[1501, 1502], help="for tuning and for judging")
    parse.add_argument("--cache", type=Path, default=Path("inference-cells"))
    parse.add_argument("--out", type=Path, default=Path("inference"))
    parse.add_argument("--threads", type=int, default=os.cpu_count())
    given = parse.parse_args()
    score.BOARD.check()
    statements = tomllib.loads(given.statements.read_text())["statement"]
    found = readings(given.readings)
    if given.only:
        starts = tuple(start.strip() for start in given.only.split(";"))
        found = {name: reading for name, reading in found.items() if name.startswith(starts)}
    cells = Cells(given.binary, given.cache, given.threads)
    tune, last = given.seeds

    def look(stage, names, rows, galaxies, seed):
        results = {}
        for name in names:
            work = (galaxies, given.calibration, seed, statements)
            results[name] = evaluate(cells, found[name], rows, *work)
            print(f"{stage} {name}: {results[name]['marginal']:.1f}", file=sys.stderr, flush=True)
        return results

    def best(results, most):
        """The best, and the printed submissions; none of none."""
        if most == 0:
            return []
        order = sorted(results, key=lambda name: results[name]["marginal"])
        return order[:most] + [name for name in ("R0",) if name in order[most:]]

    first = given.seen or max(given.galaxies // 10, 1)
    seen = look("seen", found, FIRST_ROWS, first, tune)
    tuned = look("tuned", best(seen, 2 * given.keep), FIRST_ROWS, given.galaxies, tune)
    judged = look("judged", best(tuned, given.keep), list(ROWS), given.galaxies, last)
    final = sorted(judged, key=lambda name: judged[name]["marginal"])
    free = len(score.NUISANCES)
    parts = [table(seen, found, f"Seen on seed {tune} with {first} stamps a cell: {len(found)} readings")]
    if judged:
        parts += [
            table(tuned, found, f"Tuned on seed {tune} with {given.galaxies} stamps a cell"),
            table(judged, found, f"Judged on seed {last} with {given.galaxies} stamps a cell"),
            statement_table(judged, statements, final),
            f"Best: **{final[0]}**, with {found[final[0]]['choices']} settings read otherwise than by the printed "
            f"submissions and {free} nuisances, on {len(judged[final[0]]['statements'])} statements.\n",
        ]
    else:
        parts.append(statement_table(seen, statements, sorted(seen, key=lambda name: seen[name]["marginal"])[:6]))
    text = "\n".join(parts)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "table.md").write_text(text)
    plain = lambda value: value.item() if isinstance(value, np.generic) else str(value)
    record = {"seen": seen, "tuned": tuned, "judged": judged, "readings": found}
    (given.out / "table.json").write_text(json.dumps(record, indent=1, default=plain))
    print(text)
    print(f"{cells.seconds:.0f} s in {given.binary}", file=sys.stderr)


if __name__ == "__main__":
    main()
