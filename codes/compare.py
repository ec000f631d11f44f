#!/usr/bin/env python3
"""Measures m, c and noise of a code's catalogues of the data of docs/compare-your-code.md, and prints the rows of all codes.

    python3 codes/compare.py record NAME CATALOGUES [option of `shearq bias` ...]
    python3 codes/compare.py table

CATALOGUES has the folders sn10, sn20 and sn40, each with a catalogue (or a folder of `shearq measure`) for each of the four
versions of the galaxies. `record` writes codes/NAME/sn10.toml and so on; add README.md, whose first line is the code's label.
"""

import math
import os
import subprocess
import sys
import tomllib
from pathlib import Path

FOLDER = Path(__file__).parent
SNRS = (10, 20, 40)
# Two shears, and each galaxy also rotated by 90 degrees, all with the same noise.
VERSIONS = 4
GALAXIES = 10_000
# Cramér–Rao bound on ε per component at S/N 1, of these galaxies if round: bound_at_snr_1 of tests/other-codes/results.json, whose
# galaxies have the same profile and PSF.
BOUND = 2.15105


def record(name, catalogues, options):
    for snr in SNRS:
        versions = sorted(str(path) for path in (Path(catalogues) / f"sn{snr}").glob("*"))
        if len(versions) != VERSIONS:
            sys.exit(f"error: {catalogues}/sn{snr}: found {len(versions)} catalogues, expected {VERSIONS}")
        target = FOLDER / name
        for old in target.glob(f"sn{snr}.*"):
            old.unlink()
        # Galaxies that fail in one version would leave their shape in m, c and the noise.
        bias = ["bias", "--paired", *options, *versions]
        shearq = os.environ.get("SHEARQ", "shearq")
        subprocess.run([shearq, "baseline", "record", f"sn{snr}", "--folder", target, "--", *bias], check=True)


def row(path):
    """The cells of a baseline file."""
    with path.open("rb") as file:
        baseline = tomllib.load(file)
    metrics, rows, galaxies = baseline["metrics"], baseline["rows"], baseline["galaxies"]
    command = baseline["command"]
    if command[0] != "bias" or "--paired" not in command or rows != VERSIONS * GALAXIES:
        sys.exit(f"error: {path}: not of `bias --paired` on the {VERSIONS * GALAXIES} rows of the data (found {rows} rows)")
    numbers = [number for own in metrics.values() for number in own]
    if not all(map(math.isfinite, numbers)) or not all(error > 0 for _, error in metrics.values()):
        sys.exit(f"error: {path}: a metric is no number, or has no error")
    (m1, of_m1), (m2, of_m2) = metrics["m1"], metrics["m2"]
    (c1, of_c1), (c2, of_c2) = metrics["c1"], metrics["c2"]
    # In the mean over the four versions of a galaxy its shape cancels to first order and its noise stays, because it is the same:
    # the error of c is that of the mean of the noise, divided by the code's own response. 1 + m makes it the true response.
    noise = math.sqrt(galaxies / VERSIONS * (of_c1**2 + of_c2**2) / 2) / (1 + (m1 + m2) / 2)
    snr = int(path.stem.removeprefix("sn"))
    return [
        str(snr),
        f"{1e3 * m1:+.1f}, {1e3 * m2:+.1f} ± {1e3 * max(of_m1, of_m2):.1f}",
        f"{1e4 * c1:+.0f}, {1e4 * c2:+.0f} ± {1e4 * max(of_c1, of_c2):.0f}",
        f"{noise:.3f}",
        f"{noise * snr / BOUND:.2f}",
        f"{100 * (1 - galaxies / rows):.1f} %",
    ]


def table():
    lines = ["| code | S/N | m1, m2 (10⁻³) | c1, c2 (10⁻⁴) | noise | noise / bound | failed |", "|---|---|---|---|---|---|---|"]
    for readme in sorted(FOLDER.glob("*/README.md"), key=lambda path: path.parent.name.lower()):
        label = readme.read_text().splitlines()[0].removeprefix("# ")
        for snr in SNRS:
            lines.append(" | ".join([f"| {label}", *row(readme.with_name(f"sn{snr}.toml"))]).replace("-", "−") + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["record", name, catalogues, *options]:
            record(name, catalogues, options)
            print(*(" | ".join(row(FOLDER / name / f"sn{snr}.toml")) for snr in SNRS), sep="\n")
        case ["table"]:
            print(table())
        case _:
            sys.exit(__doc__)
