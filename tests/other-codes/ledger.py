#!/usr/bin/env python3
"""Writes the tables `readme` and `other-codes` of docs/ledger.csv from results.json.

    python3 ledger.py && SHEARQ_ACCEPT=1 cargo test --release --test it ledger
"""

import csv
import json
from pathlib import Path

HERE = Path(__file__).parent
LEDGER = HERE / "../../docs/ledger.csv"
RUN = "other-codes"
#: Variants in the tables, best first: method, variant, name in the tables, and whether README has it.
SHOWN = [
    ("48/linear/star", "dithered", "48/linear/star", True),
    ("FPFS", "centred, not renoised, kernel 4.5 px", "FPFS, centred galaxies, not renoised", True),
    ("FPFS", "centred, renoised, kernel 4.5 px", "FPFS, centred galaxies, renoised", True),
    ("FPFS", "dithered, own detection, renoised", "FPFS, own detection, renoised", False),
    ("REGAUSS", "dithered, responsivity", "REGAUSS, responsivity of intrinsic shapes", True),
    ("KSB", "dithered, uncalibrated", "KSB, not calibrated", True),
    ("metacal", "dithered, weighted moments", "metacal, matched weight", True),
]


def signed(value, digits):
    return f"{value:+.{digits}f}".replace("-", "−")


def bias(row):
    """Both components in 10⁻³ with one error, to the error's first digits."""
    error = 1e3 * max(row["m1_error"], row["m2_error"])
    digits = 3 if error < 0.0095 else 2 if error < 0.095 else 1 if error < 2 else 0
    return ", ".join(signed(1e3 * row[k], digits) for k in ("m1", "m2")), f"{error:.{digits}f}"


def spread(row, name):
    digits = 4 if row[name + "_error"] < 0.0015 else 3 if row[name + "_error"] < 0.015 else 2
    return f"{row[name]:.{digits}f}", f"{row[name + '_error']:.{digits}f}"


def main():
    results = json.loads((HERE / "results.json").read_text())
    bound = results["run"]["bound_at_snr_1"]
    rows = {(r["method"], r["variant"], r["snr"]): r for r in results["rows"]}
    lines = []
    short = [name for *name, readme in SHOWN if readme]
    for number, (method, variant, name) in enumerate(short, 1):
        row = rows[method, variant, 20]
        cells = [
            ("method (S/N 20, the same galaxies)", name, ""),
            ("m1, m2 (10⁻³)", *bias(row)),
            ("noise", *spread(row, "noise")),
        ]
        lines += [["readme", number, *cell, RUN] for cell in cells]
    number = 0
    for method, variant, name, _ in SHOWN:
        for snr in (7, 10, 20, 40, 100):
            row, number = rows[method, variant, snr], number + 1
            cells = [
                ("method", name, ""),
                ("S/N", f"{snr}", ""),
                ("m1, m2 (10⁻³)", *bias(row)),
                ("noise", *spread(row, "noise")),
                ("noise / bound", f"{row['noise'] * snr / bound:.2f}", ""),
                ("with shape noise", *spread(row, "noise_with_shapes")),
                ("failed", f"{100 * row['failed']:.1f} %", ""),
            ]
            lines += [["other-codes", number, *cell, RUN] for cell in cells]
    with open(LEDGER, newline="") as file:
        kept = [line for line in csv.reader(file) if line[0] not in ("readme", "other-codes")]
    with open(LEDGER, "w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(kept + lines)


if __name__ == "__main__":
    main()
