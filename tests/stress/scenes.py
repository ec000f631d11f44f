"""Stamps of the cases, without noise, and their noise; GalSim renders them."""

import galsim
import numpy as np
from cases import PROFILES

SHEAR = 0.02
#: Galaxies that differ by turns of 45 degrees alone: their ellipticities cancel, and so does what one component of
#: shear does to the other, which goes as the product of those of the ellipticity.
TURNS = 4
PSF_SHAPE = {"g1": 0.03, "g2": -0.02}
ACCURACY = galsim.GSParams(folding_threshold=1e-3, maximum_fft_size=16384)
COSMOS = "real_galaxy_catalog_23.5_example.fits"
AEGIS = "AEGIS_F814w_catalog.fits"
#: Arcseconds a pixel of galaxies from catalogues.
PIXEL = 0.2
#: Half-light radii in pixels of mixed galaxies, and indices of their Sérsic profiles.
RADII, INDICES = {"mixed": (2.5, 5.0), "mixed8": (8.0, 8.0)}, (0.5, 4.0)
#: Galaxies whose light is lopsided, clumpy or hollow.
UNUSUAL = ("knots", "offset", "ring")
#: Galaxies that need no catalogue.
RENDERED = [*PROFILES, *RADII, *UNUSUAL]


def profile(kind):
    """Half the light in a de Vaucouleurs bulge, half in an exponential disc, round."""
    bulge, disc = PROFILES[kind]
    return 0.5 * galsim.DeVaucouleurs(half_light_radius=bulge) + 0.5 * galsim.Exponential(
        half_light_radius=disc
    )


def mixture(kind, random):
    """A bulge with a disc, or a Sérsic profile, whose index is a multiple of a quarter; round."""
    radius = random.uniform(*RADII[kind])
    if random.random() < 0.5:
        return galsim.Sersic(n=round(4 * random.uniform(*INDICES)) / 4, half_light_radius=radius)
    bulge = galsim.DeVaucouleurs(half_light_radius=0.6 * radius)
    return 0.5 * bulge + 0.5 * galsim.Exponential(half_light_radius=1.25 * radius)


def unusual(kind, random):
    """A disc with 40 % of its light in knots, with a bulge off by its half-light radius, or a ring; round but for those."""
    radius = random.uniform(3.0, 5.0)
    disc = galsim.Exponential(half_light_radius=radius)
    if kind == "knots":
        generator = galsim.BaseDeviate(int(random.integers(1, 2**31)))
        knots = galsim.RandomKnots(int(random.integers(10, 31)), profile=disc, rng=generator)
        return 0.6 * disc + 0.4 * knots
    if kind == "offset":
        bulge = galsim.DeVaucouleurs(half_light_radius=0.4 * radius)
        return 0.7 * disc + 0.3 * bulge.shift(*direction(random, radius))
    # A Gaussian with a hollow as wide as 0.7 of it, and as bright.
    sigma = 1.5 * radius
    return galsim.Gaussian(sigma=sigma) - 0.49 * galsim.Gaussian(sigma=0.7 * sigma)


class Galaxies:
    """Draws galaxies of a kind before shear and PSF."""

    def __init__(self, kind, folder):
        self.kind = kind
        if kind == "cosmos":
            self.catalogue = galsim.COSMOSCatalog(
                COSMOS, dir=str(folder), use_real=False, exclusion_level="none"
            )
        elif kind == "aegis":
            self.catalogue = galsim.RealGalaxyCatalog(AEGIS, dir=str(folder))

    def __call__(self, random):
        if self.kind in RENDERED:
            modulus = min(random.rayleigh(0.14), 0.6)
            angle = random.uniform(0.0, np.pi)
            if self.kind in PROFILES:
                round_one = profile(self.kind)
            elif self.kind in UNUSUAL:
                round_one = unusual(self.kind, random)
            else:
                round_one = mixture(self.kind, random)
            return round_one.shear(
                g1=modulus * np.cos(2 * angle), g2=modulus * np.sin(2 * angle)
            )
        index = int(random.integers(self.catalogue.nobjects))
        if self.kind == "cosmos":
            galaxy = self.catalogue.makeGalaxy(index, gal_type="parametric")
        else:
            galaxy = galsim.RealGalaxy(self.catalogue, index=index)
        turned = galaxy.rotate(random.uniform(0.0, 360.0) * galsim.degrees)
        return turned.dilate(1.0 / PIXEL)


def psf_of(case, random):
    if case.psf == "airy":
        return galsim.Airy(lam_over_diam=2.4, obscuration=0.3).shear(**PSF_SHAPE)
    fwhm = random.uniform(*case.fwhm) if isinstance(case.fwhm, tuple) else case.fwhm
    if case.psf == "kolmogorov":
        return galsim.Kolmogorov(fwhm=fwhm).shear(**PSF_SHAPE)
    return galsim.Moffat(beta=3, fwhm=fwhm).shear(**PSF_SHAPE)


def drawn(galaxy, psf, side):
    image = galsim.Convolve(galaxy, psf, gsparams=ACCURACY)
    return image.drawImage(nx=side, ny=side, scale=1).array


def direction(random, length):
    angle = random.uniform(0.0, 2 * np.pi)
    return length * np.array([np.cos(angle), np.sin(angle)])


def missing(case, random):
    """True where a stamp has no pixel."""
    side = case.stamp
    lost = np.zeros((side, side), dtype=bool)
    if case.missing == "bad":
        lost = random.random((side, side)) < 0.01
        x, y = random.integers(0, side - 3, 2)
        lost[y : y + 3, x : x + 3] = True
    if case.missing == "edge":
        lost[:, : int(random.integers(1, side // 4 + 1))] = True
        lost = np.rot90(lost, random.integers(4))
    return lost


def neighbour(case, others, random):
    """A second galaxy in its place, unless it is to be drawn anew for each turn."""
    if not isinstance(case.neighbour, tuple):
        return None
    low, high = np.log(case.ratio)
    # As many per area of the ring.
    distance = np.sqrt(random.uniform(*np.square(case.neighbour)))
    other = others(random) * np.exp(random.uniform(low, high))
    return other.shift(*direction(random, distance))


def seconds(case, other, psf, place):
    """A second galaxy on a stamp, `[±shear, y, x]`."""
    signs = (SHEAR, -SHEAR) if case.sheared else (0.0, 0.0)
    moved = [other.shear(g1=g, g2=g).shift(*place) for g in signs]
    return np.array([drawn(one, psf, case.stamp) for one in moved])


def render(case, count, random, folder):
    """Stamps without noise, `[±shear, galaxy, y, x]`, of galaxies in fours turned by 45 degrees, and their PSF; σ is one."""
    kinds = Galaxies(case.galaxy, folder)
    ranged = isinstance(case.neighbour, tuple)
    others = Galaxies("mixed" if ranged else "fiducial", folder)
    psf = psf_of(case, random)
    side = case.stamp
    stamps = np.empty((2, count, side, side))
    strength = np.empty(count)
    for first in range(0, count, TURNS):
        galaxy = kinds(random)
        second = neighbour(case, others, random)
        for turn in range(TURNS):
            at = first + turn
            place = direction(random, case.off) if case.off else random.uniform(-0.5, 0.5, 2)
            if not case.dithered:
                place = np.zeros(2)
            turned = galaxy.rotate(180 / TURNS * turn * galsim.degrees)
            for sign in range(2):
                g = SHEAR * (1 - 2 * sign)
                stamps[sign, at] = drawn(turned.shear(g1=g, g2=g).shift(*place), psf, side)
            strength[at] = np.sqrt((stamps[:, at] ** 2).sum((1, 2)).mean())
            if second:
                stamps[:, at] += seconds(case, second.rotate(180 / TURNS * turn * galsim.degrees), psf, place)
            elif case.neighbour:
                other = others(random).shift(*direction(random, case.neighbour))
                stamps[:, at] += drawn(other, psf, side)
    # One factor for a four: behind an elliptical PSF galaxies along it are brighter than those across.
    strength = np.sqrt((strength.reshape(-1, TURNS) ** 2).mean(1)).repeat(TURNS)
    if case.own_flux:
        stamps *= 12.0 / np.percentile(strength, 25)
    else:
        stamps *= (case.snr / strength)[None, :, None, None]
    if case.missing:
        stamps[:, np.array([missing(case, random) for _ in range(count)])] = np.nan
    return stamps, psf


def noise_field(case, shape, random):
    """Noise of variance one in every pixel."""
    field = random.standard_normal(shape)
    if case.noise == "summed":
        return sum(
            np.roll(field, (dy, dx), (1, 2)) for dy in (0, 1) for dx in (0, 1)
        ) / 2
    if case.noise == "smoothed":
        k = 2 * np.pi * np.fft.fftfreq(shape[-1])
        gain = np.exp(-0.5 * 0.7**2 * (k[:, None] ** 2 + k**2))
        gain /= np.sqrt((gain**2).mean())
        return np.fft.ifft2(np.fft.fft2(field) * gain).real
    return field


def bound(case):
    """Cramér–Rao bound on the shear of a round galaxy in this noise, per component; None where there is none."""
    if case.galaxy not in PROFILES or case.neighbour or case.noise == "smoothed":
        return None
    # Light beyond the stamp tells nothing.
    side = case.stamp
    images = [
        drawn(profile(case.galaxy).shear(g1=g, g2=0.0), psf_of(case, None), side) for g in (0.01, 0.0, -0.01)
    ]
    slope = (images[0] - images[2]) / 0.02 * case.snr / np.sqrt((images[1] ** 2).sum())
    power = np.ones((side, side))
    if case.noise == "summed":
        k = 2 * np.pi * np.fft.fftfreq(side)
        power = np.maximum(np.outer(1 + np.cos(k), 1 + np.cos(k)), 1e-2)
    information = (np.abs(np.fft.fft2(slope)) ** 2 / power).mean()
    return 1.0 / np.sqrt(information)
