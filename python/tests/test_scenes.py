"""Scenes that the command line simulates, drawn again by GalSim."""

import os

import numpy as np
import pytest

if os.environ.get("CI"):
    import galsim
else:
    galsim = pytest.importorskip("galsim", reason="drawing galaxies needs GalSim, which could not be imported")

astropy = pytest.importorskip("astropy.io.fits", reason="reading scenes needs astropy")

SIDE, PIXEL, SEEING, PSF_SHAPE = 300, 0.2, 0.7, (0.05, -0.03)
#: Wider than a stamp, so that GalSim's images have the light that scenes may cut off.
STAMP = 160
ACCURACY = galsim.GSParams(folding_threshold=1e-4, maximum_fft_size=16384)


def read(folder):
    return astropy.getdata(folder / "scene-001.fits").astype(float)


def test_scenes_are_those_of_galsim(command, tmp_path):
    options = f"--scenes 1 --side {SIDE} --seed 7 --pixel {PIXEL} --seeing {SEEING} --stars 2 --snr 40,80".split()
    shape = f"--psf-shape={PSF_SHAPE[0]},{PSF_SHAPE[1]}"
    shear = "--constant-shear=0.04,-0.03"
    for name, density in (("full", 60), ("empty", 0)):
        command("simulate", *options, shape, shear, "--density", density, "--out", tmp_path / name)
    # Both have the same noise and the same stars.
    light = read(tmp_path / "full") - read(tmp_path / "empty")
    truth = np.genfromtxt(tmp_path / "full" / "truth-001.csv", delimiter=",", names=True)
    truth = truth[truth["star"] == 0]
    psf = galsim.Moffat(beta=3, fwhm=SEEING / PIXEL).shear(g1=PSF_SHAPE[0], g2=PSF_SHAPE[1])
    drawn = galsim.ImageD(SIDE, SIDE)
    peaks = []
    for row in truth:
        disc = galsim.Exponential(half_light_radius=row["half_light_radius"])
        bulge = galsim.DeVaucouleurs(half_light_radius=row["bulge_half_light_radius"])
        galaxy = (1 - row["bulge_share"]) * disc + row["bulge_share"] * bulge
        galaxy = row["flux"] * galaxy.shear(g1=row["e1"], g2=row["e2"]).shear(g1=row["g1"], g2=row["g2"])
        # FITS counts from 1, as GalSim does.
        stamp = galsim.Convolve(galaxy, psf, gsparams=ACCURACY).drawImage(
            nx=STAMP, ny=STAMP, scale=1.0, center=galsim.PositionD(row["x"], row["y"]), dtype=float
        )
        both = stamp.bounds & drawn.bounds
        drawn[both] += stamp[both]
        peaks.append(stamp.array.max())
    # Galaxies beyond the edges are in no table, and add light near them.
    inner = slice(60, -60)
    off = np.abs(light - drawn.array)[inner, inner].max()
    # The promised 1e-4 of the peak of each galaxy, of which up to two overlap here; single precision of the noise: 5e-7.
    assert len(truth) > 40
    assert off < 2e-4 * np.median(peaks), off / np.median(peaks)
    assert np.abs(light).max() > 0.9 * max(peaks)
