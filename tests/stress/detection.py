#!/usr/bin/env python3
"""m of blended scenes with detection: galaxies at random places, detected by sep on each sheared image, and measured at their
detections.

    python3 detection.py --scenes 12 [--threads 2]

The whole scene is sheared, places too. Each scene is drawn under +γ and −γ, and turned by 90 degrees, with the same noise. Needs
numpy, galsim, sep and the shearq package. Prints m and c (10⁻³) with errors from a jackknife over scenes.
"""

import argparse

import galsim
import numpy as np
import sep

import shearq

SIDE, SCALE, STAMP = 1200, 0.2, 48  # px, arcsec, px
MARGIN = 40  # px beyond the image where galaxies are drawn, and within it where detections are left out
SHEAR = 0.02
FWHM = 0.7  # arcsec
PSF = galsim.Moffat(beta=3.0, fwhm=FWHM).shear(g1=0.03, g2=-0.02)
DENSITY = 74.0  # galaxies above the faintest S/N per square arcminute
FAINT, BRIGHT = 3.0, 300.0  # matched-filter S/N; numbers fall as (S/N)⁻²
SIZE, SIZE_SCATTER = 0.30, 0.35  # half-light radius in arcsec at S/N 10, ∝ S/N^0.2, and its scatter in ln
SHAPES, MAX_SHAPE = 0.25, 0.7  # σ of a component, largest |ε|
FAST = galsim.GSParams(folding_threshold=2e-2, maxk_threshold=5e-3, kvalue_accuracy=1e-4)


def population(random):
    """Places in pixels around the centre, S/N, half-light radii, shapes and bulge fractions."""
    side = SIDE + 2 * MARGIN
    n = random.poisson(DENSITY * (side * SCALE / 60) ** 2)
    places = random.uniform(-side / 2, side / 2, (n, 2))
    u = random.uniform(0, 1, n)
    snr = 1 / (u / FAINT + (1 - u) / BRIGHT)
    radius = SIZE * (snr / 10) ** 0.2 * np.exp(random.normal(0, SIZE_SCATTER, n))
    shape = random.normal(0, SHAPES, n) + 1j * random.normal(0, SHAPES, n)
    shape *= np.minimum(1, MAX_SHAPE / np.abs(shape))
    return places, snr, radius, shape, random.uniform(0, 1, n) < 0.3


def draw(galaxies, shear, turned):
    """The scene under a shear, without noise; σ of the noise is 1."""
    lens = np.array([[1 + shear[0], shear[1]], [shear[1], 1 - shear[0]]]) / np.sqrt(1 - shear[0] ** 2 - shear[1] ** 2)
    image = galsim.ImageF(SIDE, SIDE, scale=SCALE)
    for place, snr, radius, shape, bulge in zip(*galaxies):
        if turned:
            place, shape = np.array([-place[1], place[0]]), -shape
        x, y = lens @ place + (SIDE + 1) / 2
        kind = galsim.DeVaucouleurs if bulge else galsim.Exponential
        profile = kind(half_light_radius=radius, gsparams=FAST).shear(g1=shape.real, g2=shape.imag).shear(g1=shear[0], g2=shear[1])
        profile = galsim.Convolve(profile, PSF, gsparams=FAST)
        size = 64 if snr > 30 else 40
        stamp = profile.drawImage(nx=size, ny=size, scale=SCALE, center=galsim.PositionD(x, y))
        # The flux at which a round galaxy has this S/N; shear changes neither.
        round_one = galsim.Convolve(kind(half_light_radius=radius, gsparams=FAST), PSF, gsparams=FAST)
        stamp *= snr / _norm(round_one, kind, radius)
        overlap = stamp.bounds & image.bounds
        if overlap.isDefined():
            image[overlap] += stamp[overlap]
    return image.array.astype(float)


_NORMS = {}


def _norm(profile, kind, radius):
    key = (kind, radius)
    if key not in _NORMS:
        _NORMS[key] = np.sqrt((profile.drawImage(nx=48, ny=48, scale=SCALE).array ** 2).sum())
    return _NORMS[key]


def measured(image, star, threads):
    """The catalogue of detections on an image of noise 1."""
    kernel = galsim.Gaussian(fwhm=FWHM).drawImage(nx=9, ny=9, scale=SCALE).array
    found = sep.extract(image, 1.0, err=1.0, minarea=5, filter_kernel=kernel)
    x, y = found["x"], found["y"]
    inside = (np.minimum(x, y) > MARGIN) & (np.maximum(x, y) < SIDE - 1 - MARGIN)
    x, y = x[inside], y[inside]
    corners = np.rint(np.stack([x, y], axis=-1) - (STAMP - 1) / 2).astype(int)
    stamps = np.array([image[b : b + STAMP, a : a + STAMP] for a, b in corners])
    offsets = np.stack([x, y], axis=-1) - corners - (STAMP - 1) / 2
    epoch = {"stamps": stamps, "psf": star, "noise": 1.0, "offsets": offsets}
    return shearq.measure(epochs=[epoch], threads=threads)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=12)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    star = PSF.drawImage(nx=STAMP, ny=STAMP, scale=SCALE, dtype=float).array
    sums = {cut: [] for cut in (None, "step(snr, 10)", "step(snr, 10) and 1 - step(neighbour, 0.6)")}
    count = 0
    for scene in range(options.scenes):
        random = np.random.default_rng([options.seed, scene])
        galaxies = population(random)
        noise = random.normal(0, 1, (SIDE, SIDE))
        catalogues, shears = [], []
        for turned in (False, True):
            for sign in (1, -1):
                shear = (sign * SHEAR, sign * SHEAR)
                catalogue = measured(draw(galaxies, shear, turned) + noise, star, options.threads)
                catalogues.append({**catalogue.columns(), "scene": np.full(len(catalogue), scene)})
                shears.append(sign * SHEAR)
        count += len(catalogues[0]["e1"])
        for cut, parts in sums.items():
            parts.append((catalogues, shears, cut))
    area = options.scenes * ((SIDE - 2 * MARGIN) * SCALE / 60) ** 2
    print(f"{count / area:.1f} detections per square arcminute, {count} in {options.scenes} scenes")
    for cut, parts in sums.items():
        # Rows of all scenes under one sign are a catalogue; scenes are the units.
        tables = [{} for _ in range(4)]
        for catalogues, _, _ in parts:
            for table, catalogue in zip(tables, catalogues):
                for name, column in catalogue.items():
                    table.setdefault(name, []).append(column)
        tables = [{name: np.concatenate(columns) for name, columns in table.items()} for table in tables]
        shears = parts[0][1]
        found = shearq.bias(tables, g1=shears, g2=shears, units="scene", where=cut)
        values = ", ".join(f"{name} = {1e3 * found[name]:+.1f} ± {1e3 * found[name + '_error']:.1f}" for name in ("m1", "m2", "c1", "c2"))
        print(f"{cut or 'no cut'}: {values}")


if __name__ == "__main__":
    main()
