"""GREAT10-like sets in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from . import _shearq
from ._arrays import callback, real, whole
from ._measure import FunctionalPsf
from ._threads import thread_count

_SETS = 24
_MOST_IMAGES = 999_999


@dataclass(frozen=True, eq=False)
class SimulatedImage:
    """One image: ``shearq.measure(image.stamps, image.psf, noise=image.noise)``.

    Attributes
    ----------
    number : int
        From 1.
    stamps : float32 array of shape (n², 48, 48)
        Noisy stamps in the order of the grid, x running fastest.
    psf : float32 array of shape (48, 48) or (n², 32, 32)
        Noise-free stars: one for all, or one each.
    functional_psf : FunctionalPsf
        The same by their formulas.
    noise : float
        Standard deviation of the noise per pixel.
    intrinsic, observed : float64 array of shape (n², 2)
        Shear-type ellipticities before and after lensing.
    """

    number: int
    stamps: NDArray[np.float32]
    psf: NDArray[np.float32]
    functional_psf: FunctionalPsf
    noise: float
    intrinsic: NDArray[np.float64]
    observed: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Simulation:
    """A simulated set: a sequence of its images, and what they share.

    Attributes
    ----------
    set : int
        Its number, 1 to 24.
    kind : str
        What its galaxies and PSF are like.
    g1, g2 : float64 array of shape (n, n)
        True shear, indexed [y, x]; the same in all images.
    x, y : float64 array of shape (n²,)
        Positions of the galaxies in FITS pixels, in the order of the grid.
    images : tuple of SimulatedImage
    """

    set: int
    kind: str
    g1: NDArray[np.float64]
    g2: NDArray[np.float64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    images: tuple[SimulatedImage, ...]

    def __len__(self) -> int:
        return len(self.images)

    def __iter__(self) -> Iterator[SimulatedImage]:
        return iter(self.images)

    def __getitem__(self, place: int) -> SimulatedImage:
        return self.images[place]

    def __repr__(self) -> str:
        side = len(self.g1)
        return f"<shearq.Simulation of set {self.set} ({self.kind}): {len(self)} images of {side} × {side} galaxies>"


def simulate(
    set: int = 8,
    images: int = 1,
    seed: int = 1,
    *,
    grid: int = 100,
    amplitude: float = 1.0,
    tilt: float = 0.0,
    intrinsic_sigma: float | None = None,
    fixed_psf: Literal["one", "field"] = "one",
    threads: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> Simulation:
    """Simulate images of a GREAT10-like set, the same as the command line writes with the same settings, `--fixed-psf` among them.

    Parameters
    ----------
    set : int
        1 to 24, those of GREAT10: 2, 5, 8 have fixed PSFs, and galaxies of S/N 20, 10, 40.
    images : int
        How many. One takes 9 kB for each of its `grid`² galaxies.
    seed : int
        Of all random numbers.
    grid : int
        Galaxies a side, 8 to 400.
    amplitude, tilt : float
        Factor on the shear power spectrum, and its extra slope about ℓ = 1000.
    intrinsic_sigma : float, optional
        Standard deviation per component of the galaxies' own shear-type ellipticities; 0.14 by default.
    fixed_psf : {"one", "field"}
        PSFs of sets whose PSFs are fixed: one of all galaxies, or a field over the image that is the same in all images, with a
        star for each galaxy, as in GREAT10.
    threads, progress
        As for :func:`measure`.

    Returns
    -------
    Simulation
    """
    if fixed_psf not in ("one", "field"):
        raise ValueError(f"fixed_psf is {fixed_psf!r}; expected 'one' or 'field'")
    expected = "a finite number, not negative"
    grid = whole("grid", grid, 8, 400)
    set, images = whole("set", set, 1, _SETS), whole("images", images, 1, _MOST_IMAGES)
    numbers = range(1, images + 1)
    found = _shearq.simulate(
        set,
        list(numbers),
        whole("seed", seed, 0, 2**64 - 1),
        grid,
        real("amplitude", amplitude, expected, least=0.0),
        real("tilt", tilt, "a finite number"),
        None if intrinsic_sigma is None else real("intrinsic_sigma", intrinsic_sigma, expected, least=0.0),
        fixed_psf == "field",
        thread_count(threads),
        callback(progress),
    )
    cells, side = grid * grid, found["stamp"]
    stamps = found["stamps"].reshape(images, cells, side, side)
    formulas = found["formulas"].reshape(images, -1, 4)
    own = formulas.shape[1]
    star = round((found["stars"].size / (images * own)) ** 0.5)
    stars = found["stars"].reshape((images, star, star) if own == 1 else (images, own, star, star))
    truth, positions = found["truth"].reshape(grid, grid, 2), found["positions"].reshape(cells, 2)
    shapes = {name: found[name].reshape(images, cells, 2) for name in ("intrinsic", "observed")}
    return Simulation(
        set,
        found["kind"],
        np.ascontiguousarray(truth[..., 0]),
        np.ascontiguousarray(truth[..., 1]),
        np.ascontiguousarray(positions[:, 0]),
        np.ascontiguousarray(positions[:, 1]),
        tuple(
            SimulatedImage(
                number,
                stamps[k],
                stars[k],
                FunctionalPsf._of_rows(formulas[k]),
                found["noise"],
                shapes["intrinsic"][k],
                shapes["observed"][k],
            )
            for k, number in enumerate(numbers)
        ),
    )
