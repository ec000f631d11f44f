"""Stamps from GalSim: measure them and compare the shear with the truth.

Galaxies are drawn in pairs that are rotated by 90 degrees, so their shapes cancel and few galaxies suffice. All data are
simulated. Run: python galsim_stamps.py [--quick] [--out plot.png]
"""

import argparse
from typing import Any

import galsim
import numpy as np

import shearq

STAMP, SCALE = 48, 0.2  # pixels, arcsec per pixel
SNR = 40


def stamps(shear: float, pairs: int, psf: Any, seed: int) -> np.ndarray:
    """Noisy stamps of galaxies and of the same galaxies on their side, under a shear g1."""
    random = np.random.default_rng(seed)
    found = np.empty((2 * pairs, STAMP, STAMP), dtype=np.float32)
    for k in range(pairs):
        radius, angle = random.uniform(0.5, 0.8), random.uniform(0, np.pi)
        offset = random.uniform(-0.5, 0.5, 2)
        galaxy: Any = galsim.Exponential(half_light_radius=radius).shear(g=0.3, beta=angle * galsim.radians)
        for turned in (False, True):
            one: Any = galaxy.rotate(90 * galsim.degrees) if turned else galaxy
            one = galsim.Convolve(one.shear(g1=shear), psf)
            image = one.drawImage(nx=STAMP, ny=STAMP, scale=SCALE, offset=offset).array
            sigma = np.sqrt((image**2).sum()) / SNR
            # Stamps of one call share a noise level of 1.
            found[2 * k + turned] = image / sigma + random.normal(size=image.shape)
    return found


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--quick", action="store_true", help="fewer galaxies")
    options.add_argument("--out", default="galsim_stamps.png", help="the plot")
    arguments = options.parse_args()
    pairs = 150 if arguments.quick else 2000

    psf: Any = galsim.Moffat(beta=3, fwhm=0.7).shear(g1=0.02)
    star = psf.drawImage(nx=STAMP, ny=STAMP, scale=SCALE).array

    true = np.array([-0.04, -0.02, 0.0, 0.02, 0.04])
    tables, found, error = [], [], []
    for seed, shear in enumerate(true):
        catalogue = shearq.measure(stamps(shear, pairs, psf, seed), star)
        print(f"true g1 = {shear:+.2f}: {catalogue.mean_shear()}")
        # Errors of the mean shear assume independent galaxies. With pairs as units, shapes cancel also in the error.
        tables.append({**catalogue.columns(), "pair": np.arange(len(catalogue)) // 2 + seed * pairs})
        mean = shearq.bias(tables[-1], g1=0.0, g2=0.0)
        found.append(mean["c1"])
        error.append(mean["c1_error"])
    print(shearq.bias(tables, g1=list(true), g2=[0.0] * len(true)))

    from matplotlib import pyplot

    figure, ax = pyplot.subplots(figsize=(5, 4), layout="constrained")
    ax.axhline(0, color="0.5", linewidth=1)
    ax.errorbar(true, (np.array(found) - true) * 1e3, np.array(error) * 1e3, fmt="o", capsize=3)
    ax.set(xlabel="true $g_1$", ylabel="measured − true $g_1$ (10⁻³)", title=f"{2 * pairs} simulated galaxies per shear, S/N {SNR}")
    figure.savefig(arguments.out, dpi=150)


if __name__ == "__main__":
    main()
