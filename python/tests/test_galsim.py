"""Galaxies that GalSim draws: the shear, the ellipticities of HSM, and errors of wrong calls."""

import os

import numpy as np
import pytest

import shearq

if os.environ.get("CI"):
    import galsim
else:
    galsim = pytest.importorskip("galsim", reason="drawing galaxies needs GalSim, which could not be imported")

STAMP, SHEAR, COUNT, NOISE = 48, 0.02, 150, 1.0
# High enough that noise does not hide a bias.
SNR = 40


def draw(rng, psf, shear):
    """Noise-free stamps of pairs of galaxies, turned by 90° against each other so that their shapes cancel."""
    stamps = np.empty((COUNT, 2, STAMP, STAMP), np.float32)
    for pair in stamps:
        modulus, angle, radius = min(rng.rayleigh(0.15), 0.5), rng.uniform(0, np.pi), rng.uniform(2.5, 4.0)
        place = rng.uniform(-0.5, 0.5, 2)
        for turn, stamp in enumerate(pair):
            shape = galsim.Shear(g=modulus, beta=(angle + turn * np.pi / 2) * galsim.radians)
            galaxy = galsim.Exponential(half_light_radius=radius, flux=1.0).shear(shape).shear(**shear).shift(*place)
            stamp[:] = galsim.Convolve(galaxy, psf).drawImage(nx=STAMP, ny=STAMP, scale=1.0).array
        pair *= SNR * NOISE / np.sqrt((pair**2).sum((1, 2)).mean())
    return stamps.reshape(-1, STAMP, STAMP)


@pytest.fixture(scope="module")
def psf():
    return galsim.Moffat(beta=3.0, fwhm=3.4).shear(g1=0.03, g2=-0.02)


@pytest.fixture(scope="module")
def star(psf):
    return psf.drawImage(nx=STAMP, ny=STAMP, scale=1.0)


@pytest.mark.parametrize("component", [0, 1])
def test_shear_is_recovered_within_errors(psf, star, component):
    means = []
    for sign in (1, -1):
        shear = {"g1": 0.0, "g2": 0.0, f"g{component + 1}": sign * SHEAR}
        # The same galaxies and noise under both signs, so that their scatter cancels in the difference.
        rng = np.random.default_rng([7, component])
        stamps = draw(rng, psf, shear)
        stamps += rng.normal(0, NOISE, stamps.shape).astype(np.float32)
        catalogue = shearq.measure(stamps, star, noise=NOISE)
        assert catalogue.good.mean() > 0.99
        pairs = np.stack([catalogue[f"e{component + 1}"][k::2] for k in (0, 1)]).mean(0)
        means.append((catalogue.mean_shear(), pairs))
    (plus, pairs_plus), (minus, pairs_minus) = means
    # Errors come from the scatter of pairs, in which the shapes cancel.
    difference = (pairs_plus - pairs_minus) / 2
    error = difference.std(ddof=1) / np.sqrt(COUNT)
    value = [(getattr(plus, f"g{k}") - getattr(minus, f"g{k}")) / 2 for k in (1, 2)]
    # 3σ, and the error of the mean response of 300 galaxies.
    assert value[component] == pytest.approx(SHEAR, abs=3 * error + 0.015 * SHEAR)
    assert value[1 - component] == pytest.approx(0.0, abs=3 * error + 0.001)
    for found in (plus, minus):
        assert abs(getattr(found, f"g{component + 1}")) < SHEAR + 5 * getattr(found, f"g{component + 1}_error")
    assert error < 0.05 * SHEAR


def test_ellipticities_correlate_with_hsm(psf, star):
    rng = np.random.default_rng(3)
    stamps = draw(rng, psf, {"g1": 0.0, "g2": 0.0})
    images = [galsim.Image(np.ascontiguousarray(stamp), scale=1.0) for stamp in stamps[:100]]
    catalogue = shearq.measure(images, star, noise=0.01)
    results = [galsim.hsm.EstimateShear(image, star, strict=False) for image in images]
    good = catalogue.good & np.array([result.error_message == "" for result in results])
    assert good.mean() > 0.95
    for name in ("e1", "e2"):
        hsm = np.array([getattr(result, f"corrected_{name}") for result in results])[good]
        ours = catalogue[name][good]
        # HSM measures distortions, which are about twice a shear.
        assert np.corrcoef(hsm, ours)[0, 1] > 0.98
        assert 0.3 < (hsm * ours).sum() / (hsm**2).sum() < 0.9


def test_a_single_image_is_one_stamp_and_a_single_array_is_an_error(star):
    with pytest.warns(shearq.DataWarning):
        assert len(shearq.measure(star, star, noise=1.0)) == 1
    with pytest.raises(ValueError, match=r"stamps: found an array of shape \(48, 48\); expected \(n, ny, nx\)"):
        shearq.measure(star.array, star, noise=1.0)


def _wcs(dudx, dudy, dvdx, dvdy):
    return galsim.JacobianWCS(dudx, dudy, dvdx, dvdy)


def _images(galaxy, wcs, count=3):
    return [galaxy.drawImage(nx=STAMP, ny=STAMP, wcs=wcs, dtype=np.float32) for _ in range(count)]


@pytest.mark.parametrize(
    "jacobian, kind",
    [((-0.2, 0, 0, 0.2), "flipped"), ((0, 0.2, -0.2, 0), "rotated"), ((0.2, 0.01, 0.01, 0.2), "sheared"), ((0.2, 0, 0, 0.21), "sheared")],
)
def test_pixels_that_would_change_shears_are_refused(psf, star, jacobian, kind):
    images = _images(psf.dilate(0.4), _wcs(*jacobian))
    with pytest.raises(ValueError, match=f"stamps: image 0 has {kind} pixels.*wcs='ignore'"):
        shearq.measure(images, star.array)
    assert shearq.from_galsim(images, star.array, wcs="ignore")["stamps"].shape == (3, STAMP, STAMP)


def test_profiles_are_drawn_on_the_pixels_of_the_stamps():
    profile = galsim.Moffat(beta=3.0, fwhm=0.68).shear(g1=0.03, g2=-0.02)
    wcs = galsim.PixelScale(0.2)
    images = _images(galsim.Convolve(galsim.Exponential(half_light_radius=0.6, flux=100.0), profile), wcs)
    drawn = profile.drawImage(nx=STAMP, ny=STAMP, scale=0.2, dtype=np.float64)
    stamps = np.stack([image.array for image in images])
    rng = np.random.default_rng(1)
    noise = rng.normal(0, 0.01, stamps.shape).astype(np.float32)
    for image, more in zip(images, noise):
        image.array[:] += more
    expected = shearq.measure(stamps + noise, drawn.array, noise=0.01)
    for given in (profile, drawn, [profile] * 3, [drawn] * 3):
        found = shearq.measure(images, given, noise=0.01)
        assert np.allclose(found["e1"], expected["e1"], rtol=1e-6)
    # Of a WCS that bends, every profile has the pixels of its own stamp.
    for image in images:
        image.wcs = galsim.OffsetWCS(0.2)
    assert len(shearq.from_galsim(images, [profile] * 3)["psf"]) == 3
    coarse = profile.drawImage(nx=STAMP, ny=STAMP, scale=0.3)
    with pytest.raises(ValueError, match="psf: found a pixel scale of 0.3 and stamps of 0.2"):
        shearq.measure(images, coarse)
    images[1].wcs = galsim.PixelScale(0.25)
    with pytest.raises(ValueError, match="stamps: found pixel scales from 0.2 to 0.25"):
        shearq.measure(images, profile)
    with pytest.raises(TypeError, match="psf: found a profile of GalSim with stamps that have no WCS.*drawImage"):
        shearq.measure(stamps, profile)
    with pytest.raises(TypeError, match="images: found ndarray"):
        shearq.from_galsim(stamps, profile)


def test_profiles_that_contain_the_pixel_are_drawn_without_it():
    galsim = pytest.importorskip("galsim", reason="profiles of GalSim")
    psf, pixel = galsim.Moffat(beta=3, fwhm=0.68), galsim.Pixel(0.2)
    stamps = []
    for k in range(40):
        galaxy = galsim.Exponential(half_light_radius=0.5).shear(g1=0.2 * np.cos(k), g2=0.2 * np.sin(k))
        stamps.append(galsim.Convolve(galaxy, psf).drawImage(nx=48, ny=48, scale=0.2))
    effective = galsim.InterpolatedImage(psf.drawImage(nx=64, ny=64, scale=0.2), x_interpolant="lanczos15")
    expected = shearq.measure(stamps, psf, noise=1e-4)
    for profile, kind in ((effective, "InterpolatedImage"), (galsim.Convolve(psf, pixel), "Pixel"), (effective.rotate(0 * galsim.degrees) * 2, "Interp")):
        with pytest.warns(shearq.DataWarning, match=f"psf: the profile has a part of type {kind}"):
            broad = shearq.measure(stamps, profile, noise=1e-4)
        included = shearq.measure(stamps, profile, noise=1e-4, pixel="included")
        assert np.allclose(included["e1"], expected["e1"], atol=1e-3)
        assert np.abs(broad["R11"] / expected["R11"] - 1).mean() > 0.005
    with pytest.raises(ValueError, match="pixel: found 'yes'"):
        shearq.measure(stamps, psf, pixel="yes")
    with pytest.raises(TypeError, match="pixel: found with PSFs that are no profiles"):
        shearq.measure(stamps, psf.drawImage(nx=48, ny=48, scale=0.2), pixel="included")
