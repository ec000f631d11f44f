"""Sizes of either parity, and missing pixels."""

import warnings

import numpy as np
import pytest
from conftest import same_bits

import shearq

SHEAR = (0.03, -0.02)


def gaussian(side, xx, yy, xy, x=0.0, y=0.0):
    """A Gaussian of the covariance ((xx, xy), (xy, yy)) in px² and of flux one, by its place from the middle."""
    v, u = np.mgrid[:side, :side] - (side - 1) / 2
    u, v = u - x, v - y
    determinant = xx * yy - xy * xy
    power = (yy * u * u - 2 * xy * u * v + xx * v * v) / determinant
    return np.exp(-0.5 * power) / (2 * np.pi * np.sqrt(determinant))


def galaxies(side, count=40):
    """Noisy galaxies of random orientation in pairs that are turned by 90°, sheared, and seen through a Gaussian PSF."""
    rng = np.random.default_rng(5)
    stamps = []
    matrix = np.array([[1 + SHEAR[0], SHEAR[1]], [SHEAR[1], 1 - SHEAR[0]]]) / np.sqrt(1 - SHEAR[0] ** 2 - SHEAR[1] ** 2)
    for _ in range(count // 2):
        angle, size = rng.uniform(0, np.pi), rng.uniform(4, 7)
        place = rng.uniform(-0.4, 0.4, 2)
        for turn in (0, np.pi / 2):
            c, s = np.cos(angle + turn), np.sin(angle + turn)
            axes = np.array([[c, -s], [s, c]])
            lensed = matrix @ axes @ np.diag([1.2 * size, size / 1.2]) @ axes.T @ matrix
            stamps.append(gaussian(side, lensed[0, 0] + 2.2, lensed[1, 1] + 1.9, lensed[0, 1], *place))
    stamps = np.array(stamps) * 400
    return stamps + rng.normal(0, 0.02, stamps.shape)


def star(side):
    return gaussian(side, 2.2, 1.9, 0.0)


@pytest.fixture(scope="module")
def even():
    return shearq.measure(galaxies(48), star(48), noise=0.02)


@pytest.mark.parametrize("side, of_star", [(48, 33), (48, 49), (48, 53), (49, 48), (49, 49), (49, 32), (64, 47), (51, 53)])
def test_stamps_and_psfs_of_either_parity_give_the_shear(even, side, of_star):
    found = shearq.measure(galaxies(side), star(of_star), noise=0.02)
    assert found.good.all()
    mean, expected = found.mean_shear(), even.mean_shear()
    for k in (0, 1):
        # Other pixels and other noise: 0.02 per pixel is S/N 400 or more, an error of 2e-4 each. The limit is three
        # standard errors of the difference.
        assert list(mean)[k] == pytest.approx(list(expected)[k], abs=8.5e-4)
        assert list(mean)[k] == pytest.approx(SHEAR[k], abs=1.5e-3)
    stars = np.repeat(star(of_star)[np.newaxis], len(found), axis=0)
    assert same_bits(shearq.measure(galaxies(side), stars, noise=0.02), found)


def test_a_psf_that_is_drawn_half_a_pixel_off_would_be_noticed(even):
    # The test above is not blind: without the shift the middle of the galaxy leaves the middle of the window.
    shifted = gaussian(48, 2.2, 1.9, 0.0, 0.5, 0.5)
    found = shearq.measure(galaxies(48), shifted, noise=0.02)
    assert not same_bits(found["e1"], even["e1"])


def test_masked_pixels_are_missing(image):
    mask = np.random.default_rng(1).random(image.stamps.shape) < 0.002
    stamps = np.where(mask, np.float32(np.nan), image.stamps)
    expected = shearq.measure(stamps, image.psf)
    assert expected.good.all()
    filled = np.ma.masked_array(np.where(mask, np.float32(1e20), image.stamps), mask)
    masked = np.ma.masked_array(image.stamps, mask)
    for found in (
        shearq.measure(image.stamps, image.psf, mask=mask),
        shearq.measure(filled, image.psf),
        shearq.measure(list(filled), image.psf),
        shearq.measure(masked, image.psf, mask=np.zeros((48, 48), bool)),
        shearq.measure(masked, image.psf, mask=mask),
    ):
        assert same_bits(found, expected)
    one = np.zeros((48, 48), bool)
    one[20, 3] = True
    each = np.broadcast_to(one, image.stamps.shape)
    assert same_bits(shearq.measure(image.stamps, image.psf, mask=one), shearq.measure(image.stamps, image.psf, mask=each))


def test_missing_pixels_in_a_corner_are_no_reason_to_doubt_the_noise(image):
    corner = np.zeros((48, 48), bool)
    corner[0, :5] = True
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shearq.measure(image.stamps, image.psf, mask=corner, noise=image.noise)


def test_too_small_psfs_are_refused_with_the_size(image):
    with pytest.raises(ValueError, match="psf: a PSF stamp of 31 × 31 pixels; expected at least 32 × 32"):
        shearq.measure(image.stamps, star(31))


@pytest.mark.parametrize("kind", ["f4", ">f4", "f8", "f4 as f8"])
def test_pixels_of_minus_1e30_are_missing_as_in_files(image, kind):
    mask = np.random.default_rng(1).random(image.stamps.shape) < 0.002
    filled = np.where(mask, np.float32(-1e30), image.stamps)
    given = {"f8": np.where(mask, -1e30, image.stamps.astype("f8")), "f4 as f8": filled.astype("f8")}.get(kind)
    given = filled.astype(kind) if given is None else given
    expected = shearq.measure(image.stamps, image.psf, mask=mask, noise=image.noise)
    before = given.copy()
    assert same_bits(shearq.measure(given, image.psf, noise=image.noise), expected)
    (block,) = shearq.measure_blocks(given, image.psf, noise=image.noise)
    assert same_bits(block, expected) and same_bits(given, before)
    psf = image.psf.copy()
    psf[3, 3] = -1e30
    with pytest.raises(ValueError, match="psf: "):
        shearq.measure(image.stamps, psf, noise=image.noise)
