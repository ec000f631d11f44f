"""The blocks of the page "From your pipeline", on small data of each program."""

import shlex
import sys

import numpy as np
import pytest
from shearq._shearq import run_command
from test_survey import DOCS, blocks

import shearq

galsim = pytest.importorskip("galsim", reason="the data are drawn by GalSim")
PAGE = (DOCS / "from-your-pipeline.md").read_text()
SECTIONS = dict(part.split("\n", 1) for part in PAGE.split("\n## ")[1:])
SCALE = 0.2


# Pixels that are rotated by 25 degrees, on a plane and on the sky.
ROTATED = galsim.AffineTransform(*(SCALE * np.array([[np.cos(0.44), -np.sin(0.44)], [np.sin(0.44), np.cos(0.44)]])).ravel())
SKY = galsim.TanWCS(ROTATED, galsim.CelestialCoord(1 * galsim.radians, 0.3 * galsim.radians))


def stamps(profile, count=60, shear=0.02, seed=3, wcs=galsim.PixelScale(SCALE)):
    """Round galaxies and their places; S/N is about 60."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(50, 950, (2, count))
    drawn = []
    for one, other in zip(x, y):
        galaxy = galsim.Exponential(half_light_radius=0.6, flux=4000).shear(g1=shear, g2=0.0)
        image = galsim.Convolve(galaxy, profile(one, other)).drawImage(nx=48, ny=48, wcs=wcs.local(galsim.PositionD(one, other)))
        drawn.append(image.array + rng.normal(0, 1, (48, 48)))
    return {"stamps": np.array(drawn), "x": x, "y": y}


def moffat(x, y):
    return galsim.Moffat(beta=3.0, fwhm=0.7 + 1e-5 * x)


def run(title, names=None):
    """Runs the block of a section and returns its names."""
    found = dict(names or {})
    (block,) = blocks(SECTIONS[title], "python")
    exec(compile(block, title, "exec"), found)
    return found


def has_shear(catalogue, abs=0.006):
    """Whether round galaxies have the shear 0.02 within three errors of their noise."""
    shear = catalogue.mean_shear()
    assert shear.g1 == pytest.approx(0.02, abs=abs) and shear.g2 == pytest.approx(0.0, abs=abs)


def gathered(title, profile):
    """The catalogue of a field that the commands of a section cut into stamps."""
    fits = pytest.importorskip("astropy.io.fits")
    rng = np.random.default_rng(2)
    field = galsim.Image(rng.normal(0, 1, (500, 500)))
    places = np.array([(60 + 60 * k, 60 + 60 * j) for k in range(7) for j in range(7)]) + rng.uniform(-1, 1, (49, 2))
    for x, y in places:
        galaxy = galsim.Exponential(half_light_radius=0.6, flux=4000).shear(g1=0.02, g2=0.0)
        image = galsim.Convolve(galaxy, profile(x, y)).drawImage(nx=48, ny=48, scale=SCALE, center=galsim.PositionD(x, y))
        field[image.bounds] += galsim.Image(image.array, xmin=image.bounds.xmin, ymin=image.bounds.ymin)
    fits.writeto("field.fits", field.array.astype("f4"), overwrite=True)
    np.savetxt("galaxies.csv", places, delimiter=",", header="x,y", comments="")
    for block in blocks(SECTIONS[title], "sh"):
        assert run_command(shlex.split(block)) == 0
    assert run_command("shearq measure --submission 48/linear/star --data data --out out".split()) == 0
    return shearq.read("out/set01/catalogue-001.parquet")


def test_piff(tmp_path, monkeypatch):
    piff = pytest.importorskip("piff", reason="Piff is not installed")
    monkeypatch.chdir(tmp_path)
    for wcs in (ROTATED, galsim.PixelScale(SCALE)):
        # A model as Piff stores it, fitted to one star.
        psf = piff.SimplePSF(piff.Moffat(3.0), piff.Mean())
        drawn = galsim.Moffat(beta=3.0, fwhm=0.7).drawImage(nx=41, ny=41, wcs=wcs)
        drawn.setCenter(500, 500)
        stars = [piff.Star(piff.StarData(drawn, galsim.PositionD(500, 500)), None)]
        psf.fit(stars, {0: wcs}, None)
        psf.write("model.piff")
        with pytest.raises(ValueError, match=r"psf: model.piff: .* Try: psf=piff.PSF.read\('model.piff'\), with x= and y="):
            shearq.measure(np.zeros((9, 48, 48)), "model.piff")
        has_shear(run("Piff", stamps(lambda x, y: galsim.Moffat(beta=3.0, fwhm=0.7), wcs=wcs))["catalogue"])
    monkeypatch.setenv("SHEARQ_PYTHON", sys.executable)
    has_shear(gathered("Piff", lambda x, y: galsim.Moffat(beta=3.0, fwhm=0.7)), abs=0.01)


def test_psfex(tmp_path, monkeypatch):
    from test_psf_models import write_psfex

    monkeypatch.chdir(tmp_path)
    write_psfex("model.psf")
    with pytest.raises(ValueError, match=r"psf: model.psf: .* Try: psf=galsim.des.DES_PSFEx\('model.psf'\), with x= and y="):
        shearq.measure(np.zeros((9, 48, 48)), "model.psf")
    galsim.Image(500, 500, wcs=SKY).write("field.fits")
    has_shear(run("PSFEx", stamps(lambda x, y: galsim.Gaussian(sigma=1.99 * SCALE), wcs=SKY))["catalogue"], abs=0.01)
    has_shear(gathered("PSFEx", lambda x, y: galsim.Gaussian(sigma=(1.8 + 4e-4 * x) * SCALE)), abs=0.01)


def test_galsim():
    has_shear(run("GalSim", stamps(moffat))["catalogue"])


def test_meds(tmp_path, monkeypatch):
    from test_epochs import epoch, galaxies
    from test_meds import write

    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(7)
    shapes = galaxies(rng, 40)
    write("tile.fits", [epoch(rng, shapes, angle) for angle in (0.0, 0.7)])
    assert sum(map(len, run("MEDS")["catalogues"])) == 40


def test_rubin():
    from test_exposure import exposure

    found, (x, y) = exposure(40)
    shear = run("Rubin", {"exposure": found, "x": x, "y": y})["catalogue"].mean_shear()
    assert shear.g1 == pytest.approx(0.03, abs=0.004)


def test_ngmix():
    from test_adapters import observation

    image = shearq.simulate(set=8, seed=3, grid=8)[0]
    observations = [observation(stamp, image.psf, image.noise) for stamp in image.stamps]
    assert len(run("ngmix", {"observations": observations})["catalogue"]) == 64


def test_metadetect(tmp_path, monkeypatch, capsys):
    pytest.importorskip("h5py", reason="HDF5 files are read by h5py")
    from test_hdf5 import write

    monkeypatch.chdir(tmp_path)
    write("plus.h5", (0.02, 0.0))
    write("minus.h5", (-0.02, 0.0))
    run("metadetect")
    assert "0.0000" in capsys.readouterr().out


def test_hsm(capsys):
    psf = moffat(0, 0)
    image = psf.drawImage(nx=48, ny=48, scale=SCALE).array
    data = {name: stamps(lambda x, y: psf, shear=shear)["stamps"] for name, shear in (("plus", 0.02), ("minus", -0.02))}
    run("HSM", {**data, "psf_image": image})
    assert "m1" in capsys.readouterr().out


def test_sep():
    pytest.importorskip("sep", reason="sep is not installed")
    psf = moffat(0, 0)
    field = stamps(lambda x, y: psf, count=49)["stamps"]
    image = np.ascontiguousarray(field.reshape(7, 7, 48, 48).transpose(0, 2, 1, 3).reshape(336, 336))
    psf_image = psf.drawImage(nx=48, ny=48, scale=SCALE).array
    assert len(run("SExtractor and sep", {"image": image, "psf_image": psf_image})["catalogue"]) >= 25
