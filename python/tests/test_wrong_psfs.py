"""PSF images with errors are measured with a warning, or refused."""

import warnings

import numpy as np
import pytest

import shearq


@pytest.fixture(scope="module")
def image():
    return shearq.simulate(set=2, seed=3, grid=24)[0]


def test_wrong_psfs_have_a_warning_and_good_ones_have_none(image):
    psf = np.asarray(image.psf, dtype=float)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        good = shearq.measure(image.stamps, psf)
    with pytest.warns(shearq.DataWarning, match="the PSF contains a background"):
        shearq.measure(image.stamps, psf + 0.01 * psf.max())
    with pytest.warns(shearq.DataWarning, match=r"off the centre of its stamp \(found \(\+3.0"):
        moved = shearq.measure(image.stamps, np.roll(psf, 3, axis=1))
    assert np.allclose(moved["e1"], good["e1"], atol=2e-3, equal_nan=True)


def test_a_psf_broader_than_the_galaxies_is_refused(image):
    # Twice as wide as it is.
    wide = shearq.FunctionalPsf(fwhm=6.8)
    with pytest.raises(ValueError, match="broader than the galaxies"):
        shearq.measure(image.stamps, wide)
