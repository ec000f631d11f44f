"""Detections of arrays."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
import shearq
from numpy.typing import NDArray

STAR = np.exp(-(np.add.outer(np.arange(-23.0, 24) ** 2, np.arange(-23.0, 24) ** 2)) / 4.5)


def image(places: list[tuple[int, int]], side: int = 260) -> NDArray[np.float32]:
    pixels = np.random.default_rng(2).normal(0, 1, (side, side))
    y, x = np.mgrid[:side, :side]
    for column, row in places:
        pixels += 25 * np.exp(-((x - column) ** 2 / 24 + (y - row) ** 2 / 14))
    return pixels.astype(np.float32)


def test_places_and_signs_are_those_of_the_pixels() -> None:
    found = shearq.detect(image([(100, 70), (180, 150)]), STAR, noise=1.0)
    whole = found["selection"] > 0.5
    assert np.allclose(np.sort(found["x"][whole]), [101, 181], atol=0.7)
    assert np.allclose(np.sort(found["y"][whole]), [71, 151], atol=0.7)
    # Elongated along x.
    assert (found["e1"] > 5 * abs(found["e2"]))[whole].all()
    assert (found["R11"][whole] > 0).all() and found.attrs["frame"] == "pixel"
    # Noise is above the threshold with little weight.
    assert found["selection"][~whole].sum() < 0.05 < 15 < found["selection"][whole].sum()
    assert found.mean_shear().g1 > 0.05


def test_results_do_not_depend_on_threads_nor_on_the_type() -> None:
    pixels = image([(100, 70), (180, 150)])
    one = shearq.detect(pixels, STAR, noise=1.0, threads=1)
    for other in (pixels.astype(np.float64), pixels[:, ::-1][:, ::-1]):
        assert (shearq.detect(other, STAR, noise=1.0, threads=3) == one).all()


def test_nothing_is_detected_near_missing_pixels() -> None:
    pixels = image([(100, 70), (180, 150)])
    mask = np.zeros(pixels.shape, bool)
    mask[72, 95] = True
    found = shearq.detect(pixels, STAR, noise=1.0, mask=mask)
    (x,) = found["x"][found["selection"] > 0.5]
    assert abs(x - 181) < 1


def test_a_psf_that_varies_is_drawn_at_its_places() -> None:
    pixels = image([(100, 70), (180, 150)])
    places = []

    def psf(x: float, y: float) -> NDArray[np.float64]:
        places.append((x, y))
        return STAR

    found = shearq.detect(pixels, psf, noise=1.0)
    # One PSF, by another way: that of four parts along each axis, and of the only cell.
    assert np.allclose(found["e1"], shearq.detect(pixels, STAR, noise=1.0)["e1"])
    assert {(33.0, 33.0), (130.5, 130.5)} < set(places)

    def negative(x: float, y: float) -> NDArray[np.float64]:
        return STAR if x < 200 else -STAR

    with pytest.raises(ValueError, match="psf: .* at x = 228.0, y = 33.0 sum to -"):
        shearq.detect(pixels, negative, noise=1.0)


def test_a_wrong_noise_level_is_named() -> None:
    pixels = np.random.default_rng(8).normal(0.0, 3.0, (300, 300)).astype(np.float32)
    with pytest.warns(shearq.DataWarning, match="the noise is stated as 9.000, and measured as (2.9|3.0)"):
        shearq.detect(pixels, STAR, noise=9.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shearq.detect(pixels, STAR, noise=3.0)


def test_a_wcs_turns_shapes_to_the_sky() -> None:
    pixels = image([(100, 70)])
    plain = shearq.detect(pixels, STAR, noise=1.0)
    # x to the south and y to the east: e1 changes its sign.
    sky = shearq.detect(pixels, STAR, noise=1.0, wcs=[[0.0, -0.2], [-0.2, 0.0]])
    assert np.allclose(sky["e1"], -plain["e1"], rtol=1e-3) and sky.attrs["frame"] == "sky"


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"noise": 0.0}, "noise"),
        ({"noise": 1.0, "threshold": 1.0}, "threshold"),
        ({"noise": 1.0, "psf": STAR[0]}, "psf"),
        ({"noise": 1.0, "image": np.zeros((3, 50, 50))}, "image"),
        ({"noise": 1.0, "wcs": [[1.0, 2.0], [2.0, 4.0]]}, "wcs"),
    ],
)
def test_wrong_arguments_are_named(arguments: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        shearq.detect(**{"image": np.zeros((60, 60)), "psf": STAR, **arguments})  # type: ignore[arg-type]


def _wcs(matrix: list[list[float]], origin: tuple[float, float]) -> Any:
    astropy_wcs = pytest.importorskip("astropy.wcs")
    wcs = astropy_wcs.WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = [30.0, 10.0]
    wcs.wcs.crpix = list(origin)
    wcs.wcs.cd = np.array(matrix) * 0.2 / 3600
    return wcs


def test_exposures_of_one_sky_are_combined() -> None:
    pixels = image([(100, 70), (180, 150)])
    # Turned by 180 degrees, with other noise.
    other = np.ascontiguousarray((image([(100, 70), (180, 150)]) - 0.2 * image([]))[::-1, ::-1])
    frames = [_wcs([[-1.0, 0.0], [0.0, 1.0]], (130.5, 130.5)), _wcs([[1.0, 0.0], [0.0, -1.0]], (130.5, 130.5))]
    both = shearq.detect([pixels, other], STAR, noise=[1.0, 0.8], wcs=frames, threads=2)
    alone = shearq.detect(pixels, STAR, noise=1.0, wcs=frames[0])
    bright = both[both["selection"] > 5]
    assert np.allclose(np.sort(bright["x"]), [101, 181], atol=0.7) and both.attrs["frame"] == "sky"
    assert bright["snr"].min() > 1.2 * alone["snr"][alone["selection"] > 5].min()
    assert np.allclose(bright["e1"] / bright["R11"], (alone["e1"] / alone["R11"])[alone["selection"] > 5], atol=0.05)
    # One of them alone, where the other one is masked.
    nothing = np.ones(pixels.shape, bool)
    masked = shearq.detect([pixels, other], [STAR, STAR], noise=1.0, mask=[None, nothing], wcs=frames)
    single = shearq.detect(pixels, STAR, noise=1.0, wcs=frames[0])
    assert np.allclose(np.sort(masked["x"]), np.sort(single["x"]), atol=1e-3)
    assert np.isclose(masked["R11"].sum(), single["R11"].sum(), rtol=1e-4)


def test_exposures_of_one_sky_by_galsim() -> None:
    galsim = pytest.importorskip("galsim")
    pixels = image([(100, 70)])
    turned = np.ascontiguousarray(pixels.T)
    frames = [
        galsim.AffineTransform(-0.2, 0.0, 0.0, 0.2, origin=galsim.PositionD(1, 1)),
        galsim.AffineTransform(0.0, -0.2, 0.2, 0.0, origin=galsim.PositionD(1, 1)),
    ]
    both = shearq.detect([pixels, turned], STAR, noise=1.0, wcs=frames)
    (bright,) = both[both["selection"] > 5]
    assert abs(bright["x"] - 101) < 0.7 and abs(bright["y"] - 71) < 0.7 and bright["e1"] > 0


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"wcs": None}, "wcs: found 0; expected 2"),
        ({"wcs": [np.eye(2), np.eye(2)]}, "wcs: found Jacobians"),
        ({"psf": [STAR]}, "psf: found 1; expected 2"),
        ({"noise": [1.0, 2.0, 3.0]}, "noise: found 3; expected 2"),
        ({"psf": [STAR, -STAR]}, r"psf: .*\(exposure 2\)"),
        ({"image": [np.zeros((60, 60))] * 2}, "image: exposure 2 has the same pixels"),
    ],
)
def test_wrong_lists_are_named(arguments: dict[str, object], words: str) -> None:
    frames = [_wcs([[-1.0, 0.0], [0.0, 1.0]], (30.5, 30.5))] * 2
    with pytest.raises(ValueError, match=words):
        shearq.detect(**{"image": [np.zeros((60, 60)), np.ones((60, 60))], "psf": STAR, "noise": 1.0, "wcs": frames, **arguments})
