"""Wrong data are measured with a warning, good data without one."""

import warnings

import numpy as np
import pytest

import shearq


def measured(image, stamps, **more):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        shearq.measure(stamps, image.psf, **more)
    return caught


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda stamps, x: stamps + 3, "the stamps contain sky (found "),
        (lambda stamps, x: stamps + np.float32(0.05) * x, "the sky has a gradient"),
        (lambda stamps, x: np.roll(stamps, 3, axis=2), "off the centre of their stamps"),
        (lambda stamps, x: -stamps, "darker than their surroundings"),
        (lambda stamps, x: np.repeat(stamps[:1], len(stamps), axis=0), "copies of each other"),
    ],
    ids=["sky", "gradient", "off centre", "negative", "copies"],
)
def test_wrong_stamps_are_warned_of(image, spoil, expected):
    x = np.arange(48, dtype=np.float32) - 23.5
    caught = measured(image, spoil(image.stamps, x).astype(np.float32), noise=1.0)
    found = [str(warning.message) for warning in caught]
    assert any(expected in text for text in found), found
    assert all(warning.category is shearq.DataWarning for warning in caught)
    # The warning points at the caller.
    assert all(warning.filename == __file__ for warning in caught)


def test_blank_stamps_are_an_error_after_their_warning(image):
    with pytest.warns(shearq.DataWarning, match="the stamps are blank"):
        with pytest.raises(ValueError, match="no galaxy could be measured"):
            shearq.measure(0 * image.stamps, image.psf, noise=1.0)


@pytest.mark.parametrize("submission", ["48/linear/star", "23/raw/star"])
def test_good_stamps_have_no_warning(image, submission):
    assert not measured(image, image.stamps, submission=submission)


def test_a_wrong_noise_is_warned_of_and_a_right_one_is_not(image):
    caught = measured(image, image.stamps, noise=2.0)
    assert [str(warning.message).split(" (")[0] for warning in caught] == [
        "the given noise disagrees with the noise of the stamps"
    ]
    assert not measured(image, image.stamps, noise=1.0)


def test_masks_of_good_pixels_are_named(image):
    mask = np.zeros(image.stamps.shape, bool)
    mask[:, 5, 5] = True
    assert not measured(image, image.stamps, mask=mask)
    with pytest.warns(shearq.DataWarning, match="mask: found 100% of the pixels marked; .* Try: mask=~mask"):
        with pytest.raises(ValueError, match="144 of them with missing pixels"):
            shearq.measure(image.stamps, image.psf, mask=~mask)
    with pytest.raises(ValueError, match="mask: found 100% of the pixels marked; .* Try: mask=~mask"):
        shearq.measure(image.stamps, image.psf, mask=np.ones((48, 48), bool))


def test_units_out_of_range_are_an_error_of_the_stamps(image):
    with pytest.raises(ValueError, match="stamps: pixel values are out of range"):
        shearq.measure(image.stamps * np.float32(1e20), image.psf)
