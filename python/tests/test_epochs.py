"""Several stamps of each galaxy."""

from types import SimpleNamespace

import numpy as np
import pytest
from conftest import same_bits

import shearq
from shearq import adapters

SIDE = 48


def gaussian(side, moments, jacobian, offset, flux):
    """A Gaussian of moments (xx, xy, yy) in arcsec² on the pixels of a Jacobian."""
    xx, xy, yy = moments
    area, pixel = xx * yy - xy * xy, abs(np.linalg.det(jacobian))
    rows, columns = np.indices((side, side)) - (side - 1) / 2
    u, v = np.einsum("ij,jyx->iyx", jacobian, np.array([columns - offset[0], rows - offset[1]]))
    return flux * pixel * np.exp(-0.5 * (yy * u * u - 2 * xy * u * v + xx * v * v) / area) / (2 * np.pi * np.sqrt(area))


def epoch(rng, galaxies, angle=0.0, star=(0.09, 0.004, 0.08), noise=0.3, flux=1.0):
    """Galaxies of moments in arcsec² on pixels of 0.2″ that are rotated and dithered."""
    matrix = 0.2 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    offsets = rng.uniform(-0.5, 0.5, (len(galaxies), 2))
    star = np.array(star)
    stamps = np.array([gaussian(SIDE, one + star, matrix, at, 1000 * flux) for one, at in zip(galaxies, offsets)])
    stamps += rng.normal(0, noise, stamps.shape)
    psf = gaussian(32, star, matrix, (0, 0), 1.0)
    return {"stamps": stamps, "psf": psf, "noise": noise, "wcs": matrix, "offsets": offsets}


def galaxies(rng, n):
    e = rng.uniform(-0.2, 0.2, (n, 2))
    return np.stack([0.3 * (1 + e[:, 0]), 0.3 * e[:, 1], 0.3 * (1 - e[:, 0])], axis=-1)


def test_one_epoch_without_offsets_has_the_bits_of_its_stamps(image):
    alone = shearq.measure(image.stamps, image.psf, noise=image.noise)
    found = shearq.measure(epochs=[{"stamps": image.stamps, "psf": image.psf, "noise": image.noise}])
    assert same_bits(found, alone)


@pytest.mark.filterwarnings("ignore::shearq.DataWarning")
def test_one_epoch_is_measured_as_one_of_several():
    rng = np.random.default_rng(13)
    shapes = galaxies(rng, 40)
    one = epoch(rng, shapes, noise=0.01)
    one["offsets"] += (2.0, -1.0)
    star = np.array((0.09, 0.004, 0.08))
    one["stamps"] = np.array([gaussian(SIDE, of + star, one["wcs"], at, 1000.0) for of, at in zip(shapes, one["offsets"])])
    psfs = np.array([gaussian(32, star, one["wcs"], (0.4, -0.3), 1.0)] * 40)
    for given in (one, {**one, "psf": psfs, "psf_offsets": (0.4, -0.3)}):
        alone = shearq.measure(epochs=[given])
        # A second epoch of no weight.
        several = shearq.measure(epochs=[given, {**given, "noise": 1e5}])
        for name in ("e1", "e2", "R11", "R22", "flux"):
            assert np.allclose(alone[name], several[name], rtol=1e-5, atol=1e-6), name
    # Off the centre by 2 px, the window loses light.
    centred = shearq.measure(one["stamps"], one["psf"], noise=0.01, wcs=one["wcs"])
    assert centred["flux"].mean() < 0.98 * shearq.measure(epochs=[one])["flux"].mean()


def test_epochs_of_any_orientation_measure_the_same_galaxies():
    rng = np.random.default_rng(3)
    shapes = galaxies(rng, 30)
    one = shearq.measure(epochs=[epoch(rng, shapes, noise=0.001)])
    turned = [epoch(rng, shapes, angle, noise=0.001) for angle in (0.4, 2.0, -1.1)]
    turned[1]["stamps"][4] = np.nan
    found = shearq.measure(epochs=turned, ids=np.arange(30))
    assert found.attrs["frame"] == "sky" and not found["flags"].any() and found["id"][4] == 4
    for name in ("e1", "e2", "psf_e1", "psf_e2", "psf_sigma"):
        assert np.allclose(found[name], one[name], atol=2e-3), name
    # The lags are on a grid along the first epoch, on which R depends by a per cent.
    for name in ("R11", "R22"):
        assert np.allclose(found[name], one[name], atol=0.015), name


def test_fluxes_of_bands_are_weights():
    rng = np.random.default_rng(5)
    shapes = galaxies(rng, 60)
    bright, faint = (lambda: epoch(rng, shapes, noise=4.0)), (lambda: epoch(rng, shapes, noise=4.0, flux=0.1))
    scatter = {}
    for name, weights in (("own", (1.0, 0.1)), ("equal", (0.55, 0.55))):
        bands = [{**one, "flux": flux} for one, flux in zip((bright(), faint()), weights)]
        noisy = shearq.measure(epochs=bands)
        exact = shearq.measure(epochs=[epoch(rng, shapes, noise=0.001)])
        good = noisy["flags"] == 0
        scatter[name] = np.std((noisy["e1"] / noisy["R11"].mean() - exact["e1"] / exact["R11"].mean())[good])
    # With equal weights, noise of the faint band takes part.
    assert scatter["own"] < 0.9 * scatter["equal"]


def observation(stamp, psf, noise, matrix, offset):
    names = ("get_dudcol", "get_dudrow", "get_dvdcol", "get_dvdrow")
    ways = {name: (lambda value=value: value) for name, value in zip(names, np.ravel(matrix))}
    centre = ((SIDE - 1) / 2 + offset[1], (SIDE - 1) / 2 + offset[0])
    jacobian = SimpleNamespace(get_cen=lambda: centre, **ways)
    star = SimpleNamespace(image=psf, jacobian=SimpleNamespace(**ways))
    return SimpleNamespace(image=stamp, weight=np.full(stamp.shape, noise**-2.0), psf=star, jacobian=jacobian)


class ObsList(list):
    """As that of ngmix."""


class MultiBandObsList(list):
    """As that of ngmix."""


def lists(epochs, k):
    return ObsList(observation(one["stamps"][k], one["psf"], one["noise"], one["wcs"], one["offsets"][k]) for one in epochs)


def test_lists_of_ngmix_are_epochs_and_bands():
    rng = np.random.default_rng(7)
    shapes = galaxies(rng, 12)
    epochs = [epoch(rng, shapes, angle) for angle in (0.0, 0.7)]
    found = shearq.measure(**adapters.from_ngmix([lists(epochs, k) for k in range(12)]))
    assert same_bits(found, shearq.measure(epochs=epochs))
    # A galaxy with one epoch fewer.
    several = [lists(epochs[: 1 if k == 5 else 2], k) for k in range(12)]
    short = shearq.measure(**adapters.from_ngmix(several))
    assert same_bits(short[:5], found[:5]) and short["e1"][5] != found["e1"][5]
    red = [epoch(rng, shapes, 0.2, flux=3.0)]
    bands = [MultiBandObsList([lists(epochs, k), lists(red, k)]) for k in range(12)]
    weights = [one["flux"] for one in adapters.from_ngmix(bands)["epochs"]]
    assert weights[0] == weights[1] and 2.5 < weights[2] / weights[0] < 3.5
    given = shearq.measure(**adapters.from_ngmix(bands, fluxes=[1.0, 3.0]))
    assert same_bits(given, shearq.measure(epochs=[*({**one, "flux": 1.0} for one in epochs), {**red[0], "flux": 3.0}]))
    one = adapters.from_ngmix(lists(epochs, 0))
    assert [part["stamps"].shape for part in one["epochs"]] == [(1, SIDE, SIDE)] * 2


def test_wrong_epochs_are_one_error_each():
    rng = np.random.default_rng(8)
    shapes = galaxies(rng, 3)
    good = epoch(rng, shapes)
    wrong = [
        ({**good, "stamp": 1}, "epochs: epoch 1: found .*; expected stamps, psf"),
        ({**good, "stamps": good["stamps"][:2], "offsets": None}, "epochs: epoch 1 has 2 stamps; expected 3"),
        ({**good, "offsets": np.zeros((3, 3))}, "epochs: epoch 1: offsets: found shape"),
        ({**good, "flux": 0.0}, "epochs: epoch 1: flux: found a number that is not positive"),
        ({**good, "wcs": None}, "some epochs have Jacobians and others have none"),
        ({**good, "wcs": np.ones((2, 2))}, "wcs: the Jacobian"),
    ]
    for other, message in wrong:
        with pytest.raises(ValueError, match=message):
            shearq.measure(epochs=[good, other])
    with pytest.raises(TypeError, match="noise: found with epochs"):
        shearq.measure(epochs=[good], noise=1.0)


def test_psfs_at_the_phases_of_galaxies_need_their_offsets():
    rng = np.random.default_rng(11)
    shapes = galaxies(rng, 60)
    epochs = [epoch(rng, shapes, angle, noise=0.01) for angle in (0.0, 0.7)]
    expected = shearq.measure(epochs=epochs)
    star = np.array((0.09, 0.004, 0.08))
    drawn = [{**one, "psf": np.array([gaussian(32, star, one["wcs"], at, 1.0) for at in one["offsets"]])} for one in epochs]
    with pytest.warns(shearq.DataWarning, match="the PSFs are at several places of their stamps"):
        shearq.measure(epochs=drawn)
    found = shearq.measure(epochs=[{**one, "psf_offsets": one["offsets"]} for one in drawn])
    for name in ("e1", "e2", "R11"):
        assert np.allclose(found[name], expected[name], atol=3e-3), name
    with pytest.raises(ValueError, match="psf_offsets: found shape"):
        shearq.measure(epochs=[{**epochs[0], "psf_offsets": [1.0]}])

    def observed(k):
        lists_of = lists(drawn, k)
        for one, of in zip(lists_of, drawn):
            one.psf.image = of["psf"][k]
            row, column = 15.5 + of["offsets"][k][1], 15.5 + of["offsets"][k][0]
            one.psf.jacobian.get_cen = lambda place=(row, column): place
        return lists_of

    # Observations of ngmix have the centres of both.
    same = shearq.measure(**adapters.from_ngmix([observed(k) for k in range(60)]))
    for name in ("e1", "e2", "R11"):
        assert np.allclose(same[name], found[name], atol=1e-9), name
