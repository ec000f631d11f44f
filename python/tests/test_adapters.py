"""Objects of other programs."""

from types import SimpleNamespace

import numpy as np
import pytest
from conftest import same_bits

import shearq
from shearq import adapters


def observation(stamp, psf, noise, jacobian=(0.2, 0.0, 0.0, 0.2)):
    """What ngmix's Observation has of what is read."""
    names = ("get_dudcol", "get_dudrow", "get_dvdcol", "get_dvdrow")
    ways = {name: (lambda value=value: value) for name, value in zip(names, jacobian)}
    weight = np.full(stamp.shape, noise**-2.0)
    star = SimpleNamespace(image=psf)
    return SimpleNamespace(image=stamp, weight=weight, psf=star, jacobian=SimpleNamespace(**ways))


def test_observations_of_ngmix_are_measured_as_their_arrays(image):
    observations = [observation(stamp, image.psf, image.noise) for stamp in image.stamps]
    found = shearq.measure(**adapters.from_ngmix(observations))
    assert same_bits(found, shearq.measure(image.stamps, image.psf, noise=image.noise))
    assert adapters.from_ngmix(observations[0])["stamps"].shape == (1, 48, 48)
    # Weights of zero and bits of bmask are missing pixels.
    mask = np.zeros(image.stamps.shape, bool)
    for k, one in enumerate(observations):
        one.weight[0, :5] = 0
        one.bmask = np.zeros((48, 48), "i4")
        one.bmask[40, k % 48] = 2
        mask[k, 0, :5] = mask[k, 40, k % 48] = True
    masked = shearq.measure(image.stamps, image.psf, noise=np.full(len(mask), image.noise), mask=mask)
    assert same_bits(shearq.measure(**adapters.from_ngmix(observations)), masked)


def test_an_observation_of_ngmix_itself_is_taken(image):
    ngmix = pytest.importorskip("ngmix", reason="ngmix could not be imported")
    jacobian = ngmix.DiagonalJacobian(row=23.5, col=23.5, scale=0.2)
    psf = ngmix.Observation(image.psf.astype("f8"), jacobian=jacobian)
    weight = np.full((48, 48), image.noise**-2.0)
    one = ngmix.Observation(image.stamps[0].astype("f8"), weight=weight, jacobian=jacobian, psf=psf)
    assert adapters.from_ngmix(one)["noise"] == pytest.approx([image.noise])


@pytest.mark.parametrize("jacobian", [(0.2, 0.1, -0.1, 0.2), (-0.2, 0, 0, 0.2), (0.2, 0, 0, 0.3), (0, 0.2, 0.2, 0)])
def test_pixels_that_are_turned_or_no_squares_are_refused(image, jacobian):
    with pytest.raises(ValueError, match="observations: observation 0 has (flipped|rotated|sheared) pixels"):
        adapters.from_ngmix(observation(image.stamps[0], image.psf, 1.0, jacobian))


def test_observations_without_noise_or_of_several_shapes_are_refused(image):
    blind = observation(image.stamps[0], image.psf, 1.0)
    blind.weight = np.zeros((48, 48))
    with pytest.raises(ValueError, match="observations: no weight of observation 0 is positive"):
        adapters.from_ngmix(blind)
    starless = observation(image.stamps[0], image.psf, 1.0)
    del starless.psf
    with pytest.raises(ValueError, match="observations: observation 0 has no PSF"):
        adapters.from_ngmix(starless)
    small = observation(image.stamps[0][1:-1, 1:-1], image.psf, 1.0)
    with pytest.raises(ValueError, match="observations: images of shapes"):
        adapters.from_ngmix([small, observation(image.stamps[0], image.psf, 1.0)])
    with pytest.raises(ValueError, match="observations: found none"):
        adapters.from_ngmix([])


def test_tables_of_astropy_keep_columns_and_attributes(image, tmp_path):
    table = pytest.importorskip("astropy.table", reason="tables of astropy need it")
    found = shearq.measure(image.stamps, image.psf, noise=image.noise)
    made = adapters.to_astropy(found)
    assert made.colnames == list(found.dtype.names) and made.meta["submiss"] == "48/linear/star"
    back = adapters.from_astropy(made)
    assert back.attrs == found.attrs and same_bits(back, found)
    assert back.mean_shear() == found.mean_shear()
    made.write(tmp_path / "c.ecsv")
    read = adapters.from_astropy(table.Table.read(tmp_path / "c.ecsv"))
    assert read.mean_shear().g1 == pytest.approx(found.mean_shear().g1)
    with pytest.raises(ValueError, match="table: no columns e2"):
        adapters.from_astropy(table.Table({"e1": [0.0], "x": [0.0]}))


def test_frames_are_made_of_a_catalogue_as_of_any_structured_array(image):
    pandas = pytest.importorskip("pandas", reason="frames of pandas need it")
    found = shearq.measure(image.stamps, image.psf, noise=image.noise)
    frame = pandas.DataFrame(found)
    assert list(frame.columns) == list(found.dtype.names) and same_bits(frame["e1"].to_numpy(), found["e1"])
