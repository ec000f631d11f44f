"""Sets that GalSim rendered and that are stored in the repository. Needs no GalSim."""

import csv
from pathlib import Path

import numpy as np
import pytest

import shearq

SETS = Path(__file__).parents[2] / "tests" / "data" / "galsim" / "sets"
STAMP = 48


def pixels(path):
    """The image of a FITS file with a header of one block."""
    data = path.read_bytes()
    cards = {data[k : k + 8].strip(): data[k + 10 : k + 30].strip() for k in range(0, 2880, 80)}
    kind = {b"16": ">i2", b"-32": ">f4"}[cards[b"BITPIX"]]
    side = int(cards[b"NAXIS1"])
    values = np.frombuffer(data, kind, side * side, 2880).astype(np.float32)
    return values.reshape(side, side) * np.float32(cards.get(b"BSCALE", 1))


def stamps(path):
    image = pixels(path)
    grid = len(image) // STAMP
    return image.reshape(grid, STAMP, grid, STAMP).swapaxes(1, 2).reshape(-1, STAMP, STAMP)


def columns(path, *names):
    with path.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    return np.array([[float(row[name]) for row in rows] for name in names])


@pytest.mark.filterwarnings("error")
def test_ellipticities_follow_the_truth_and_hsm():
    truth, hsm, measured = [], [], []
    for folder in sorted(SETS.iterdir()):
        for image in ("001", "002"):
            psf = stamps(folder / f"psf-{image}.fits")
            catalogue = shearq.measure(stamps(folder / f"galaxies-{image}.fits"), psf if len(psf) > 1 else psf[0])
            assert catalogue.good.all()
            measured.append(catalogue)
            truth.append(columns(folder / f"intrinsic-{image}.csv", "observed_e1", "observed_e2"))
            hsm.append(columns(folder / f"hsm-ksb-{image}.csv", "e1", "e2"))
    measured = shearq.concatenate(measured).shear()
    truth, hsm = (np.concatenate(values, axis=1) for values in (truth, hsm))
    assert truth.shape == (2, 288)
    for k in (0, 1):
        slope = (truth[k] * measured[k]).sum() / (truth[k] ** 2).sum()
        # 288 galaxies of σ_ε = 0.14 that scatter by 0.11: an error of 0.047.
        assert slope == pytest.approx(1, abs=4 * 0.047)
        # KSB measures the same noise with another weight: the correlations are 0.77 and more.
        assert np.corrcoef(hsm[k], measured[k])[0, 1] > 0.7
        # A correlation of zero scatters by 0.059.
        assert abs(np.corrcoef(truth[1 - k], measured[k])[0, 1]) < 4 * 0.059
