#!/usr/bin/env python3
"""Draws docs/at-a-glance.svg from results.json: noise over the Cramér–Rao bound and |m| against S/N, and time.

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
#: Variants that are drawn: label, colour, marker, shift along the axis of S/N so that error bars do not overlap.
#: Colours are readable on white and on black.
DRAWN = {
    ("48/linear/star", "dithered"): ("shearq 48/linear/star", "#1f7fd6", "o", 1.0),
    ("FPFS", "centred, not renoised, kernel 4.5 px"): ("FPFS, not renoised", "#2a9d57", "v", 1.025),
    ("FPFS", "centred, renoised, kernel 4.5 px"): ("FPFS, renoised", "#2a9d57", "^", 1.05),
    ("FPFS", "dithered, own detection, renoised"): ("FPFS, own detection", "#9a9a1f", "<", 0.95),
    ("metacal", "dithered, weighted moments"): ("metacal, moments", "#b565d0", "s", 0.975),
    ("REGAUSS", "dithered, responsivity"): ("REGAUSS", "#e07b1a", "D", 1.075),
    ("KSB", "dithered, uncalibrated"): ("KSB (uncalibrated)", "#d64550", "X", 0.925),
}
GREY = "#808080"


def style(axes):
    axes.set_xscale("log")
    axes.set_xticks([7, 10, 20, 40, 100], ["7", "10", "20", "40", "100"])
    axes.minorticks_off()
    axes.set_xlabel("S/N", color=GREY)
    axes.tick_params(colors=GREY)
    axes.grid(color=GREY, alpha=0.25, linewidth=0.5)
    axes.set_facecolor("none")
    for spine in axes.spines.values():
        spine.set_color(GREY)


def cost(axes, costs):
    """Bars of CPU time on a log axis, each with its method and value."""
    costs = costs[::-1]
    axes.barh(range(len(costs)), [c[2] for c in costs], color=[c[1] for c in costs], height=0.28)
    axes.set_xscale("log")
    axes.set_xlim(10, 1e5)
    axes.set_yticks([])
    for k, (label, colour, value) in enumerate(costs):
        axes.text(11, k + 0.2, label, color=GREY, va="bottom", fontsize=10)
        axes.text(value * 1.15, k, f"{value:,.0f} µs", color=colour, va="center", fontsize=10)
    axes.set_ylim(-0.5, len(costs) - 0.2)
    axes.tick_params(colors=GREY)
    axes.set_facecolor("none")
    for spine in axes.spines.values():
        spine.set_color(GREY)
    axes.set_xlabel("µs", color=GREY)
    axes.set_title("CPU time per galaxy", color=GREY)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--results", type=Path, default=HERE / "results.json")
    parser.add_argument("--out", type=Path, default=HERE / "../../docs/at-a-glance.svg")
    options = parser.parse_args()
    results = json.loads(options.results.read_text())
    least = results["run"]["bound_at_snr_1"]
    # Fixed identifiers, and no date: the same results give the same file.
    plt.rcParams.update({"svg.hashsalt": "shearq", "svg.fonttype": "none", "font.size": 12, "font.family": "sans-serif"})
    figure, (left, right, times) = plt.subplots(1, 3, figsize=(13.5, 5.4), width_ratios=[1.15, 1.15, 0.8])
    costs = []
    for (method, variant), (label, colour, marker, shift) in DRAWN.items():
        rows = [r for r in results["rows"] if (r["method"], r["variant"]) == (method, variant)]
        if not rows:
            continue
        snr = np.array([r["snr"] for r in rows])
        ours = method == "48/linear/star"
        look = dict(color=colour, marker=marker, markersize=7, linewidth=2.4 if ours else 1.3, zorder=5 if ours else 3)
        look["markerfacecolor"] = colour if ours or "not renoised" in label else "none"
        noise, error = (np.array([r[name] for r in rows]) * snr / least for name in ("noise", "noise_error"))
        left.errorbar(snr, noise, error, label=label, capsize=2, **look)
        # Both components count alike.
        m = np.array([np.hypot(r["m1"], r["m2"]) / np.sqrt(2) for r in rows])
        error = np.array([np.hypot(r["m1_error"], r["m2_error"]) / np.sqrt(2) for r in rows])
        costs.append((label, colour, next(r["cpu_us"] for r in rows if r["snr"] == 20)))
        seen = m > 2 * error
        line = dict(look, linestyle="none")
        right.errorbar(snr[seen] * shift, m[seen], error[seen], capsize=2, **line)
        # Not significant: an upper limit of two errors.
        right.errorbar(
            snr[~seen] * shift, 2 * error[~seen], 0.35 * 2 * error[~seen], uplims=True, **dict(line, markersize=5)
        )
    style(left)
    left.axhline(1.0, color=GREY, linestyle="--", linewidth=1.2)
    left.text(6.3, 0.98, "Cramér–Rao bound", color=GREY, va="top", fontsize=10)
    left.set_yscale("log")
    left.set_ylim(0.9, 7)
    left.set_yticks([1, 1.2, 1.5, 2, 3, 4, 6], ["1", "1.2", "1.5", "2", "3", "4", "6"])
    left.minorticks_off()
    left.set_title("Noise of ε over the bound", color=GREY)
    style(right)
    right.set_yscale("log")
    right.set_ylim(1e-4, 1)
    right.axhspan(1e-4, 2e-3, color=GREY, alpha=0.12, linewidth=0)
    right.text(6.3, 1.2e-4, "below 0.002: required by coming surveys", color=GREY, va="bottom", fontsize=10)
    cost(times, costs)
    right.set_title("|m|; arrows: upper limits of two errors", color=GREY)
    legend = figure.legend(*left.get_legend_handles_labels(), loc="lower center", ncols=4, frameon=False, labelcolor=GREY)
    legend.set_in_layout(True)
    figure.tight_layout(rect=(0, 0.13, 1, 1))
    figure.savefig(options.out, transparent=True, metadata={"Date": None, "Creator": None})


if __name__ == "__main__":
    main()
