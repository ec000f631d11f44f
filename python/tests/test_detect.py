"""Detections of arrays."""

from __future__ import annotations

import warnings

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
    with pytest.warns(shearq.DataWarning, match="the noise is stated as 9.0000, and measured as (2.9|3.0)"):
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
