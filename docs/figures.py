#!/usr/bin/env python3
"""Draws conventions.svg: the ellipses of the four signs (pip install matplotlib numpy)."""

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


def conventions():
    """The four ellipses, and their position angles from +x towards +y."""
    figure, axes = plt.subplots(1, 4, figsize=(12, 3.6), facecolor="white")
    for axis, (label, e1, e2) in zip(axes, [("e1 > 0", 1, 0), ("e1 < 0", -1, 0), ("e2 > 0", 0, 1), ("e2 < 0", 0, -1)]):
        angle = np.degrees(np.arctan2(e2, e1)) / 2
        axis.add_patch(Ellipse((0, 0), 1.6, 0.7, angle=angle, facecolor="#d6e6f5", edgecolor=BLUE, linewidth=2))
        for x, y, name in [(1, 0, "+x"), (0, 1, "+y")]:
            axis.annotate("", (1.05 * x, 1.05 * y), (-1.05 * x, -1.05 * y), arrowprops=dict(arrowstyle="->", color=DARK))
            axis.text(1.12 * x + 0.06 * y, 1.12 * y + 0.06 * x, name, color=DARK, va="center")
        axis.set(xlim=(-1.15, 1.4), ylim=(-1.15, 1.3), aspect="equal", title=label)
        axis.text(0, -1.35, f"φ = {angle:.0f}°", ha="center", color=DARK)
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(HERE / "conventions.svg", metadata={"Date": None, "Creator": None})


conventions()
