"""Arrays and files are measured alike, on data that take each way through a session."""

import warnings

import numpy as np
import pytest

import shearq
from conftest import same_bits

fits = pytest.importorskip("astropy.io.fits")
GRID = 33  # more stamps than are surveyed
STAMP = 48


def mosaic(stamps, columns):
    """Stamps side by side."""
    n = len(stamps) // columns
    side = stamps.shape[-1]
    return stamps.reshape(n, columns, side, side).swapaxes(1, 2).reshape(n * side, columns * side)


def sky(stamps, star):
    y, x = np.indices((STAMP, STAMP))
    return stamps + (0.5 + 0.01 * x - 0.02 * y).astype("f4"), star


def noisy_stars(stamps, star):
    noise = np.random.default_rng(3).standard_normal((len(stamps), STAMP, STAMP))
    return stamps, (star + np.sqrt((star**2).sum()) / 80 * noise).astype("f4")


def missing(stamps, star):
    stamps = stamps.copy()
    stamps[::3, 4:7, :4] = np.nan
    stamps[5] = np.nan
    return stamps, star


def blind(stamps, star):
    return np.full_like(stamps, np.nan), star


def without_borders(stamps, star):
    stamps = stamps.copy()
    stamps[:, :12] = stamps[:, 36:] = stamps[:, :, :12] = stamps[:, :, 36:] = 0
    return stamps, star


def moved(stamps, star):
    return stamps, np.roll(star, 3, 1)


CASES = {
    "as simulated": (lambda stamps, star: (stamps, star), "48/linear/star"),
    "a network": (lambda stamps, star: (stamps, star), "23/raw/star"),
    "sky": (sky, "48/linear/star"),
    "noisy stars": (noisy_stars, "48/linear/star"),
    "noisy stars and sky": (lambda stamps, star: noisy_stars(*sky(stamps, star)), "48/linear/star"),
    "missing pixels": (missing, "48/linear/star"),
    "a star off the centre": (moved, "48/linear/star"),
    "no stamp to survey": (blind, "48/linear/star"),
    "borders without noise": (without_borders, "48/linear/star"),
}


@pytest.mark.parametrize("name", CASES)
def test_arrays_are_measured_like_their_files(name, command, tmp_path):
    spoil, configuration = CASES[name]
    image = shearq.simulate(set=2, seed=3, grid=GRID)[0]
    stamps, star = spoil(image.stamps, np.asarray(image.psf, "f4"))
    folder = tmp_path / "data" / "set02"
    folder.mkdir(parents=True)
    header = fits.Header({"STAMP": STAMP})
    fits.writeto(folder / "galaxies-001.fits", mosaic(stamps, GRID), header)
    fits.writeto(folder / "psf-001.fits", star if star.ndim == 2 else mosaic(star, GRID), header)
    out = tmp_path / "out"
    arguments = ("measure", "--data", folder.parent, "--submission", configuration, "--out", out)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            found = shearq.measure(stamps, star, submission=configuration)
        except ValueError as error:
            refused = str(error).split(": ", 1)[1]
    messages = [str(warning.message) for warning in heard]
    if name in ("no stamp to survey", "borders without noise"):
        said = command(*arguments, status=1, stream="stderr")
        assert refused.removeprefix("no galaxy could be measured: ") in said
        assert all(message in said for message in messages)
        return
    said = command(*arguments, stream="stderr")
    assert all(message in said for message in messages) and said.count("warning: set") == len(messages), said
    of_files = shearq.read(next(out.glob("set02/*")))
    names = ("e1", "e2", "noise", "flags", "R11", "R12", "snr", "size")
    for column in (name for name in names if name in found.dtype.names):
        assert same_bits(found[column], of_files[column]), column
