"""The command line that comes with the package, and that its numbers are those of the functions."""

import json

import numpy as np
import pytest
from conftest import same_bits

import shearq

COLUMNS = ("e1", "e2", "flags", "iterations", "stop", "updated", "first_energy", "energy", "noise", "flux", "radius", "size", "R11", "R22")
GRID, SEED, IMAGES = 12, 5, 2
# One PSF for all; one each; Kolmogorov profiles with one each.
SETS = [8, 1, 19]
SUBMISSIONS = ["48/linear/star", "48/linear/func", "23/den/star", "23/raw/func"]


@pytest.fixture(scope="module")
def data(command, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cli") / "data"
    sets = ",".join(map(str, SETS))
    command("simulate", "--sets", sets, "--images", IMAGES, "--grid", GRID, "--seed", SEED, "--fixed-psf", "one", "--out", folder)
    return folder


@pytest.fixture(scope="module")
def simulations():
    return {set: shearq.simulate(set=set, images=IMAGES, grid=GRID, seed=SEED) for set in SETS}


def test_version_and_exit_codes_are_those_of_the_binary(command):
    assert command("--version").split()[:2] == ["shearq", shearq.__version__]
    command("measure", status=2)
    command("submissions", "show", "nothing", status=1)


def test_simulated_stamps_stars_and_shear_are_those_written(data, simulations):
    fits = pytest.importorskip("astropy.io.fits", reason="reading FITS files needs astropy")
    for set, simulation in simulations.items():
        folder = data / f"set{set:02}"
        truth = np.loadtxt(folder / "truth.csv", delimiter=",", skiprows=1)
        assert same_bits(truth[:, 0], simulation.x) and same_bits(truth[:, 1], simulation.y)
        assert same_bits(truth[:, 2], simulation.g1.ravel()) and same_bits(truth[:, 3], simulation.g2.ravel())
        for image in simulation:
            written = fits.getdata(folder / f"galaxies-{image.number:03}.fits")
            stamps = written.reshape(GRID, 48, GRID, 48).swapaxes(1, 2).reshape(-1, 48, 48)
            assert same_bits(stamps.astype("f4"), image.stamps)
            stars = fits.getdata(folder / f"psf-{image.number:03}.fits").astype("f4")
            if image.psf.ndim == 3:
                stars = stars.reshape(GRID, 48, GRID, 48).swapaxes(1, 2).reshape(-1, 48, 48)
            assert same_bits(stars, image.psf)


def _told(submission, tmp_path):
    """The submission with the noise that it is told, as arrays have it: the linear ones measure that of images."""
    if "linear" not in submission:
        return submission
    path = tmp_path / "told.toml"
    path.write_text(f'extends = "{submission}"\n[noise]\nsource = "header"\n')
    return path


@pytest.mark.parametrize("submission", SUBMISSIONS)
def test_catalogues_are_the_same_bit_for_bit(command, data, simulations, tmp_path, submission):
    table = pytest.importorskip("astropy.io.fits", reason="reading FITS files needs astropy")
    told = _told(submission, tmp_path)
    command("measure", "--submission", told, "--data", data, "--out", tmp_path, "--catalogue-format", "fits")
    for set, simulation in simulations.items():
        for image in simulation:
            written = table.getdata(tmp_path / f"set{set:02}" / f"catalogue-{image.number:03}.fits", 1)
            psf = image.functional_psf if submission.endswith("func") else image.psf
            measured = shearq.measure(image.stamps, psf, noise=image.noise, submission=submission)
            for name in COLUMNS:
                native = written[name].astype(measured[name].dtype)
                assert same_bits(native, measured[name]), (set, image.number, name)


def test_catalogues_with_noise_measured_on_the_stamps_are_the_same(command, data, simulations, tmp_path):
    table = pytest.importorskip("astropy.io.fits", reason="reading FITS files needs astropy")
    command("measure", "--submission", "48/linear/star", "--data", data, "--out", tmp_path, "--catalogue-format", "fits")
    for set, simulation in simulations.items():
        for image in simulation:
            written = table.getdata(tmp_path / f"set{set:02}" / f"catalogue-{image.number:03}.fits", 1)
            measured = shearq.measure(image.stamps, image.psf)
            for name in COLUMNS:
                assert same_bits(written[name].astype(measured[name].dtype), measured[name]), (set, image.number, name)


def test_memory_maps_of_fits_files_are_measured_as_they_are(data, simulations):
    fits = pytest.importorskip("astropy.io.fits", reason="reading FITS files needs astropy")
    image = simulations[8][0]
    with fits.open(data / "set08" / "galaxies-001.fits", memmap=True) as file:
        pixels = file[0].data
        # Not contiguous, big-endian, and in no one's memory yet.
        stamps = [pixels[y : y + 48, x : x + 48] for y in range(0, 48 * GRID, 48) for x in range(0, 48 * GRID, 48)]
        of_rows = shearq.measure(pixels.reshape(GRID, 48, GRID, 48)[0].swapaxes(0, 1), image.psf, noise=1.0)
        mapped = shearq.measure(stamps, image.psf, noise=1.0)
    assert same_bits(mapped, shearq.measure(image.stamps, image.psf, noise=1.0))
    assert same_bits(of_rows, shearq.measure(image.stamps[:GRID], image.psf, noise=1.0))


def test_scores_are_those_of_the_command_line(command, data, simulations, tmp_path):
    told = _told("48/linear/star", tmp_path)
    command("measure", "--submission", told, "--data", data, "--out", tmp_path)
    printed = command("score", "--data", data, "--measured", tmp_path, "--format", "json")
    rows = {int(row["set"]): row for row in _sets(json.loads(printed))}
    for set, simulation in simulations.items():
        catalogues = [shearq.measure(i.stamps, i.psf, noise=i.noise) for i in simulation]
        joined = shearq.concatenate(catalogues)
        e1, e2 = (np.stack([c[f"e{k}"] for c in catalogues]) / joined[f"R{k}{k}"][joined.good].mean() for k in (1, 2))
        scored = shearq.score(e1, e2, simulation.g1, simulation.g2)
        for name, value in scored.metrics.items():
            found = rows[set][name]
            # JSON has no NaN.
            found = np.nan if found is None else found
            assert found == pytest.approx(value, rel=1e-12, nan_ok=True), name


def _sets(found):
    """Rows of the sets in what `score --format json` prints."""
    rows = found if isinstance(found, list) else found["rows"]
    return [row for row in rows if str(row["set"]).isdigit()]
