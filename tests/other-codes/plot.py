#!/usr/bin/env python3
"""Draws docs/at-a-glance.svg from results.json: noise over the Cramér–Rao bound against S/N, and |m| at S/N 20.

    python3 plot.py [--results results.json] [--out ../../docs/at-a-glance.svg]
"""

import argparse
import json
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import numpy as np

HERE = Path(__file__).parent
#: Variants that are drawn: label, colour, marker. All colours have a contrast of at least 4.5 on white (WCAG 2.1, 1.4.3).
DRAWN = {
    ("48/linear/star", "dithered"): ("shearq 48/linear/star", "#0b62b0", "o"),
    ("FPFS", "centred, not renoised, kernel 4.5 px"): ("FPFS, not renoised", "#1c7a42", "v"),
    ("FPFS", "centred, renoised, kernel 4.5 px"): ("FPFS, renoised", "#1c7a42", "^"),
    ("FPFS", "dithered, own detection, renoised"): ("FPFS, own detection", "#6b6b00", "<"),
    ("metacal", "dithered, weighted moments"): ("metacal, matched weight", "#8e3fb0", "s"),
    ("REGAUSS", "dithered, responsivity"): ("REGAUSS", "#a8560a", "D"),
    ("KSB", "dithered, uncalibrated"): ("KSB, not calibrated", "#c02f3f", "X"),
}
DARK = "#333333"
REQUIRED = 2e-3  # of m: LSST and Euclid


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--results", type=Path, default=HERE / "results.json")
    parser.add_argument("--out", type=Path, default=HERE / "../../docs/at-a-glance.svg")
    options = parser.parse_args()
    results = json.loads(options.results.read_text())
    least = results["run"]["bound_at_snr_1"]
    # Fixed identifiers, and no date: the same results give the same file.
    plt.rcParams.update({"svg.hashsalt": "shearq", "svg.fonttype": "none", "font.size": 13, "font.family": "sans-serif"})
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 5), facecolor="white")
    points = []
    for (method, variant), (label, colour, marker) in DRAWN.items():
        rows = [r for r in results["rows"] if (r["method"], r["variant"]) == (method, variant)]
        snr = np.array([r["snr"] for r in rows])
        ours = method == "48/linear/star"
        look = dict(color=colour, marker=marker, markersize=7, linewidth=2.6 if ours else 1.4, zorder=5 if ours else 3)
        look["markerfacecolor"] = colour if ours or "not renoised" in label else "white"
        noise, error = (np.array([r[name] for r in rows]) * snr / least for name in ("noise", "noise_error"))
        left.errorbar(snr, noise, error, label=label, capsize=2, **look)
        row = next(r for r in rows if r["snr"] == 20)
        m = np.hypot(row["m1"], row["m2"]) / np.sqrt(2)
        points.append((label, colour, m, np.hypot(row["m1_error"], row["m2_error"]) / np.sqrt(2)))
    left.set(xscale="log", yscale="log", ylim=(0.93, 7), xlabel="S/N", title="Noise of ε over the Cramér–Rao bound")
    left.set_xticks([7, 10, 20, 40, 100], ["7", "10", "20", "40", "100"])
    left.set_yticks([1, 1.2, 1.5, 2, 3, 4, 6], ["1", "1.2", "1.5", "2", "3", "4", "6"])
    left.minorticks_off()
    left.grid(color="#cccccc", linewidth=0.6)
    left.axhline(1.0, color=DARK, linestyle="--", linewidth=1.2)
    left.legend(fontsize=10.5, loc="upper right", framealpha=1)
    # A value below twice its error is an upper limit of two errors.
    for k, (label, colour, m, error) in enumerate(points[::-1]):
        limit = m < 2 * error
        place = 2 * error if limit else m
        if limit:
            right.errorbar(place, k, xerr=0.45 * place, xuplims=True, color=colour, marker="|", markersize=12, capsize=4)
        else:
            right.errorbar(m, k, xerr=error, color=colour, marker="o", markersize=7, capsize=3)
        value = f"< {place:.1g}" if limit else f"{m:.2g}"
        right.text(place * 1.35, k, value, color=DARK, va="center", fontsize=11, bbox=dict(facecolor="white", edgecolor="none", pad=1))
    right.set(xscale="log", xlim=(3e-5, 1), ylim=(-0.9, 6.6), xlabel="r.m.s. of m1 and m2", title="|m| at S/N 20")
    right.set_yticks(range(len(points)), [point[0] for point in points[::-1]])
    right.axvline(REQUIRED, color=DARK, linestyle="--", linewidth=1.2)
    right.text(REQUIRED * 1.1, -0.62, "required by Euclid and LSST", color=DARK, va="center", fontsize=11)
    right.minorticks_off()
    right.set_axisbelow(True)
    right.grid(axis="x", color="#cccccc", linewidth=0.6)
    figure.tight_layout()
    figure.savefig(options.out, metadata={"Date": None, "Creator": None})


if __name__ == "__main__":
    main()
