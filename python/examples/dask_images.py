"""Measure 100 images on the workers of dask, and estimate m and c from their sums.

Each worker simulates and measures an image under +γ and −γ and returns only sums, which add up. On a cluster, replace
LocalCluster, and read your own images in `measure`. Run: python dask_images.py [--quick] [--out plot.png]
"""

import argparse
from typing import Any

import distributed
import numpy as np

import shearq

SHEAR = 0.02


def measure(seed: int, galaxies: int) -> shearq.BiasSums:
    """Sums of one image under +γ and −γ."""
    # Workers share the cores of the machine.
    shearq.set_threads(1)
    tables = []
    for sign in (1, -1):
        random = np.random.default_rng(seed)
        stamps, psf = simulated(sign * SHEAR, galaxies, random)
        catalogue = shearq.measure(stamps, psf)
        tables.append({**catalogue.columns(), "pair": np.full(galaxies, seed)})
    return shearq.bias_sums(tables, g1=[SHEAR, -SHEAR], g2=[0.0, 0.0], bins=("flux", [0, 700, 900, 5000]))


def simulated(shear: float, galaxies: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Gaussian galaxies behind a Gaussian PSF, with noise."""
    y, x = np.mgrid[:48, :48] - 23.5
    lens = np.array([[1 + shear, 0], [0, 1 - shear]]) / np.sqrt(1 - shear**2)
    stamps = np.empty((galaxies, 48, 48), dtype=np.float32)
    for stamp in stamps:
        size, angle, q = random.uniform(2.5, 3.5), random.uniform(0, np.pi), random.uniform(0.6, 1.0)
        dx, dy = random.uniform(-0.5, 0.5, 2)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        cov = lens @ turn @ np.diag([size**2 / q, size**2 * q]) @ turn.T @ lens.T + 2.0 * np.eye(2)
        inverse = np.linalg.inv(cov)
        radius = inverse[0, 0] * (x - dx) ** 2 + 2 * inverse[0, 1] * (x - dx) * (y - dy) + inverse[1, 1] * (y - dy) ** 2
        flux = random.uniform(500, 1100)
        stamp[:] = flux / (2 * np.pi * np.sqrt(np.linalg.det(cov))) * np.exp(-radius / 2)
        stamp += random.normal(size=stamp.shape)
    psf = np.exp(-(x**2 + y**2) / 4.0)
    return stamps, psf


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--quick", action="store_true", help="fewer galaxies per image")
    options.add_argument("--out", default="dask_images.png", help="the plot")
    arguments = options.parse_args()
    galaxies = 30 if arguments.quick else 400

    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
        with distributed.Client(cluster) as client:
            parts: Any = client.gather(client.map(measure, range(100), galaxies=galaxies))
    bias = shearq.BiasSums.merge(parts).result()
    print(bias)

    from matplotlib import pyplot

    figure, ax = pyplot.subplots(figsize=(5.5, 4.2), layout="constrained")
    bias.plot(ax=ax)
    figure.savefig(arguments.out, dpi=150)


if __name__ == "__main__":
    main()
