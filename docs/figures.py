#!/usr/bin/env python3
"""Draws conventions.svg: the ellipses of the four signs, on pixels and on the sky (pip install matplotlib numpy)."""

from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Ellipse

HERE = Path(__file__).parent
BLUE, DARK = "#0b62b0", "#333333"
# Fixed identifiers, and no date: the same numbers give the same file.
plt.rcParams.update({"svg.hashsalt": "shearq", "svg.fonttype": "none", "font.size": 13, "font.family": "sans-serif"})


# Names of the directions of an axis, and whether the frame is that of the sky, whose u is to the west.
FRAMES = [("pixels", "+x", "+y", None, None), ("sky, +u west and +v north", "W", "N", "E", "S")]


def conventions():
    """The four ellipses in both frames, and their position angles from the first axis towards the second."""
    figure, rows = plt.subplots(2, 4, figsize=(12, 7), facecolor="white")
    signs = [("e1 > 0", 1, 0), ("e1 < 0", -1, 0), ("e2 > 0", 0, 1), ("e2 < 0", 0, -1)]
    for axes, (frame, right, up, left, down) in zip(rows, FRAMES):
        for axis, (label, e1, e2) in zip(axes, signs):
            angle = np.degrees(np.arctan2(e2, e1)) / 2
            axis.add_patch(Ellipse((0, 0), 1.6, 0.7, angle=angle, facecolor="#d6e6f5", edgecolor=BLUE, linewidth=2))
            for x, y, name in [(1, 0, right), (0, 1, up), (-1, 0, left), (0, -1, down)]:
                if name is not None:
                    axis.annotate("", (1.05 * x, 1.05 * y), (0, 0), arrowprops=dict(arrowstyle="->" if right[0] == "+" or x + y > 0 else "-", color=DARK))
                    axis.text(1.22 * x, 1.18 * y, name, color=DARK, va="center", ha="center")
                else:
                    axis.plot([0, 1.05 * x], [0, 1.05 * y], color=DARK, linewidth=1)
            axis.set(xlim=(-1.4, 1.4), ylim=(-1.35, 1.35), aspect="equal", title=f"{label} ({frame.split(',')[0]})")
            axis.text(0, -1.5, f"φ = {angle:.0f}°".replace("-", "−"), ha="center", color=DARK)
            axis.axis("off")
    figure.tight_layout()
    figure.savefig(HERE / "conventions.svg", metadata={"Date": None, "Creator": None})


conventions()
