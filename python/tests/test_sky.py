"""Shapes in the frame of the sky."""

import numpy as np
import pytest
import shearq
from shearq._wcs import jacobians

from conftest import same_bits

# Mirrored, turned and sheared pixels.
MATRIX = np.array([[0.02, 0.16], [0.157, -0.01]])
CENTRE = (150.0, 60.0)


def test_mirrored_pixels_change_the_sign_of_e2(image):
    plain = shearq.measure(image.stamps, image.psf)
    assert plain.attrs["frame"] == "pixel"
    along = shearq.measure(image.stamps, image.psf, wcs=np.diag([0.2, 0.2]))
    assert along.attrs["frame"] == "sky"
    for name in ("e1", "e2", "R12", "size_g2", "n2_es"):
        assert same_bits(plain[name], along[name])
    mirrored = shearq.measure(image.stamps, image.psf, wcs=np.tile(np.diag([-0.2, 0.2]), (len(plain), 1, 1)))
    for name, sign in {"e1": 1, "e2": -1, "R11": 1, "R12": -1, "size_g1": 1, "size_g2": -1}.items():
        assert np.allclose(mirrored[name], sign * plain[name], rtol=1e-12, equal_nan=True), name
    with pytest.raises(ValueError, match="frames of pixels and of the sky"):
        shearq.concatenate([plain, along])


def test_turned_pixels_turn_ellipticities_and_responses(image):
    plain = shearq.measure(image.stamps, image.psf)
    cos, sin = np.cos(np.radians(37)), np.sin(np.radians(37))
    turned = shearq.measure(image.stamps, image.psf, wcs=0.2 * np.array([[cos, -sin], [sin, cos]]))
    (e1, e2), (f1, f2) = [plain[f"e{k}"] for k in "12"], [turned[f"e{k}"] for k in "12"]
    expected = (e1 + 1j * e2) * np.exp(2j * np.radians(37))
    assert np.allclose(f1 + 1j * f2, expected, atol=1e-12, equal_nan=True)
    trace, other = plain["R11"] + plain["R22"], turned["R11"] + turned["R22"]
    assert np.allclose(trace, other, rtol=1e-12, equal_nan=True)
    # The frame is kept by files.
    assert shearq.concatenate([turned, turned]).attrs["frame"] == "sky"


def test_blocks_take_their_own_jacobians(image):
    each = np.array([MATRIX * (1 if k % 3 else -1) @ np.diag([1 + 1e-3 * (k % 5), 1]) for k in range(144)])
    blocks = list(shearq.measure_blocks(image.stamps, image.psf, block=72, wcs=each))
    assert [part.attrs["frame"] for part in blocks] == ["sky", "sky"]
    alone = shearq.measure(image.stamps[72:], image.psf, wcs=each[72:])
    assert same_bits(blocks[1], alone)


def test_axes_of_the_sky_may_come_in_either_order():
    pytest.importorskip("astropy")
    from astropy.wcs import WCS

    def at_centre(names, values, matrix):
        wcs = WCS(naxis=2)
        wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix, wcs.wcs.cd = names, values, [24.0, 24.0], matrix
        return jacobians(wcs, 1, np.array([23.0]), np.array([23.0]))

    matrix = np.array([[-3e-5, 1e-5], [1e-5, 4e-5]])
    usual = at_centre(["RA---TAN", "DEC--TAN"], [150.0, 2.0], matrix)
    assert np.allclose(usual, [[[0.108, -0.036], [0.036, 0.144]]], atol=1e-6)
    assert np.allclose(at_centre(["DEC--TAN", "RA---TAN"], [2.0, 150.0], matrix[::-1]), usual, atol=1e-12)
    with pytest.raises(ValueError, match="galactic.lon.*expected right ascension"):
        at_centre(["GLON-TAN", "GLAT-TAN"], [150.0, 2.0], matrix)


def test_a_wcs_gives_the_same_jacobians_in_galsim_and_astropy():
    galsim = pytest.importorskip("galsim")
    pytest.importorskip("astropy")
    from astropy.wcs import WCS

    header = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRPIX1": 100.0, "CRPIX2": 120.0}
    header |= {"CRVAL1": CENTRE[0], "CRVAL2": CENTRE[1], "CUNIT1": "deg", "CUNIT2": "deg"}
    # Right ascension is to the east, −u.
    header |= {f"CD{i}_{j}": value / 3600 for (i, j), value in {(1, 1): -0.02, (1, 2): -0.16, (2, 1): 0.157, (2, 2): -0.01}.items()}
    affine = galsim.AffineTransform(*MATRIX.ravel(), origin=galsim.PositionD(100.0, 120.0))
    centre = galsim.CelestialCoord(CENTRE[0] * galsim.degrees, CENTRE[1] * galsim.degrees)
    x, y = np.array([100.0, 9000.0, -4000.0]), np.array([120.0, 500.0, 8000.0])
    by_galsim = jacobians(galsim.TanWCS(affine, centre), 3, x, y)
    by_astropy = jacobians(WCS(header), 3, x - 1, y - 1)
    assert np.allclose(by_galsim[0], MATRIX, atol=1e-9)
    assert np.allclose(by_astropy, by_galsim, atol=1e-8)
    # It varies.
    assert np.abs(by_galsim[1] - MATRIX).max() > 1e-4
    assert np.array_equal(jacobians(galsim.JacobianWCS(*MATRIX.ravel()), 3, None, None), [MATRIX])
    assert np.array_equal(jacobians([galsim.PixelScale(0.1 * k) for k in (1, 2, 3)], 3, None, None)[1], 0.2 * np.eye(2))
    with pytest.raises(ValueError, match="Try: x=, y="):
        jacobians(WCS(header), 3, None, None)
    with pytest.raises(ValueError, match=r"expected \(3,\)"):
        jacobians(WCS(header), 3, x[:2], y[:2])


def test_galsim_images_are_measured_on_their_own_pixels():
    galsim = pytest.importorskip("galsim")
    wcs = galsim.JacobianWCS(*MATRIX.ravel())
    psf = galsim.Moffat(beta=3, fwhm=0.55).shear(g1=0.03, g2=-0.02)
    shapes = [(0.1, 0.0), (-0.1, 0.0), (0.0, 0.1), (0.0, -0.1)]
    galaxies = [galsim.Exponential(half_light_radius=0.6, flux=1e3).shear(g1=g1, g2=g2) for g1, g2 in shapes]
    images = [galsim.Convolve(galaxy, psf).drawImage(nx=48, ny=48, wcs=wcs) for galaxy in galaxies]
    found = shearq.measure(images, psf, noise=0.01, wcs=wcs)
    # Galaxies of these shapes, not of shears: they respond by a little less than the mean.
    assert np.allclose(np.sign(np.round(found["e1"], 2)), [1, -1, 0, 0])
    assert np.allclose(np.sign(np.round(found["e2"], 2)), [0, 0, 1, -1])


    arguments = shearq.from_galsim(images, psf, wcs="sky")
    assert np.array_equal(arguments["wcs"], [MATRIX] * 4)
    again = shearq.measure(**arguments, noise=0.01)
    assert again.attrs["frame"] == "sky" and np.array_equal(again["e1"], found["e1"])
    star = psf.drawImage(nx=48, ny=48, scale=0.2)
    with pytest.raises(ValueError, match="psf: image 0 has the Jacobian .* and its stamp"):
        shearq.from_galsim(images, star, wcs="sky")
    with pytest.raises(ValueError, match="images: image 0 has no WCS"):
        shearq.from_galsim([galsim.Image(48, 48)], star, wcs="sky")


def test_the_shape_of_the_psf_is_that_of_hsm_in_the_frame(image):
    galsim = pytest.importorskip("galsim")
    profile = galsim.Moffat(beta=3, fwhm=0.6).shear(g1=0.05, g2=-0.03)
    wcs = galsim.JacobianWCS(*MATRIX.ravel())
    own = shearq.measure(image.stamps[:2], profile.drawImage(nx=48, ny=48, wcs=wcs).array, noise=1.0, wcs=MATRIX)
    moments = galsim.hsm.FindAdaptiveMom(profile.drawImage(nx=96, ny=96, scale=0.2, method="no_pixel"))
    # Pixels make it rounder by a few per cent of its shape.
    assert np.allclose([own["psf_e1"][0], own["psf_e2"][0]], [moments.observed_shape.g1, moments.observed_shape.g2], atol=5e-3)
    assert own["psf_sigma"][0] == pytest.approx(moments.moments_sigma * 0.2 / np.sqrt(abs(np.linalg.det(MATRIX))), rel=0.1)
    pixels = galsim.hsm.FindAdaptiveMom(profile.drawImage(nx=48, ny=48, scale=0.2))
    flat = shearq.measure(image.stamps[:2], profile.drawImage(nx=48, ny=48, scale=0.2).array, noise=1.0)
    expected = [pixels.observed_shape.g1, pixels.observed_shape.g2, pixels.moments_sigma]
    assert np.allclose([flat[name][0] for name in ("psf_e1", "psf_e2", "psf_sigma")], expected, atol=1e-3)


def test_catalogues_of_two_frames_have_no_bias(image):
    flat, sky = (shearq.measure(image.stamps, image.psf, noise=1.0, wcs=wcs) for wcs in (None, np.eye(2)))
    with pytest.raises(ValueError, match="found ellipticities in the frames pixel and sky"):
        shearq.bias([flat, sky], g1=[0.02, -0.02], g2=0.0)


def test_wrong_wcs_are_named(image):
    def measure(wcs, **more):
        return shearq.measure(image.stamps, image.psf, wcs=wcs, **more)

    with pytest.raises(ValueError, match=r"wcs: found an array of shape \(3, 2, 2\); expected \(2, 2\), or \(144, 2, 2\)"):
        measure(np.ones((3, 2, 2)))
    with pytest.raises(ValueError, match="wcs: the Jacobian .* determinant other than zero"):
        measure([[0.2, 0.1], [0.4, 0.2]])
    with pytest.raises(ValueError, match="sheared by .* Try: resampled images"):
        measure(np.diag([0.3, 0.1]))
    with pytest.raises(ValueError, match="sheared by .* Try: a linear configuration"):
        measure(MATRIX, submission="23/raw/star")
    with pytest.raises(TypeError, match="wcs"):
        measure("header")
