#!/usr/bin/env python3
"""Detects the galaxies of simulated scenes by sep and measures them by shearq (pip install sep astropy numpy):
python scenes.py SCENES SHAPES [THRESHOLD]. Put your own detection in place of `detect`; docs/scenes.md goes on from here."""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import sep
from astropy.io import fits

SCENES, SHAPES = Path(sys.argv[1]), Path(sys.argv[2])
THRESHOLD = float(sys.argv[3]) if len(sys.argv) > 3 else 1.0  # in σ of a pixel


def detect(path):
    """FITS positions of the objects of an exposure, whose noise is one."""
    objects = sep.extract(fits.getdata(path).astype(float), THRESHOLD, err=1.0)
    return objects["x"] + 1, objects["y"] + 1


def shearq(*arguments):
    done = subprocess.run(["shearq", *map(str, arguments)], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)


for path in sorted(SCENES.glob("**/scene-*.fits"), key=lambda path: (path.name, path)):
    # plus/scene-001, as in shears.csv.
    out = SHAPES / path.relative_to(SCENES).with_suffix("")
    if (out / "set01").exists():
        continue
    x, y = detect(path)
    with tempfile.TemporaryDirectory() as folder:
        positions, stamps = Path(folder, "positions.csv"), Path(folder, "stamps")
        rows = np.column_stack([np.arange(len(x)), x, y])
        np.savetxt(positions, rows, delimiter=",", header="id,x,y", comments="", fmt=["%d", "%.5f", "%.5f"])
        shearq("gather", "--exposure", path, "--psf", path.with_name("psf.fits"), "--positions", positions, "--noise", 1, "--out", stamps)
        shearq("measure", "--submission", "48/linear/star", "--data", stamps, "--out", out)
    print(f"{out}: {len(x)} detections")
