"""Detect galaxies on exposures, with the response of the detection."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _schema, _shearq
from ._arrays import double, real, shaped, shown, with_missing, without_sentinels
from ._catalogue import Catalogue
from ._psf_models import PsfsOfModel, _doubts, _draw_of
from ._threads import thread_count
from ._warn import DataWarning, warn
from ._wcs import WcsLike, jacobians


# Pixels a side of PSFs that are drawn: beyond them, a Moffat profile of β = 2.5 with a FWHM of 4 px has 1 % of its light.
_STAR = 64


def _jacobians(wcs: WcsLike, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Those at places in FITS pixels, from which the WCS of astropy counts as numpy does."""
    x, y = (places - (0.0 if hasattr(wcs, "jacobian") else 1.0)).T
    return jacobians(wcs, len(places), x, y)


def _stars(psf: Any, draw: Callable[..., Any], wcs: WcsLike | None) -> Callable[[list[tuple[float, float]]], NDArray[np.float64]]:
    """A function that draws the PSFs of a model at places in FITS pixels."""

    def stars(places: list[tuple[float, float]]) -> NDArray[np.float64]:
        at = np.array(places)
        _doubts(psf, at, wcs, {}, ("parts of the image", "part"))
        return np.ascontiguousarray(PsfsOfModel(draw, _STAR, at, None if wcs is None else _jacobians(wcs, at), {}))

    return stars


def detect(
    image: ArrayLike,
    psf: Any,
    *,
    noise: float,
    mask: ArrayLike | None = None,
    wcs: WcsLike | None = None,
    threshold: float = 6.0,
    threads: int | None = None,
) -> Catalogue:
    """Detect the galaxies of an exposure and measure them, with the response of the detection to shear.

    Each pixel has a weight, by its light above a threshold and above four neighbours, and an ellipticity. Both are functions of the
    image whose response to shear is known in closed form, so that the mean shear is calibrated with its detection. Pixels with a
    weight that touch each other are a row of the catalogue.

    Parameters
    ----------
    image : array of shape (ny, nx)
        The exposure, without sky. Pixels that are masked, not finite or −1e30 are missing: nothing is detected near them.
    psf : array of shape (py, px), model, or function of (x, y)
        The PSF of the exposure as a stamp that is centred on the star. If it varies: a model of Piff, PSFEx or Rubin, or a function
        that returns an image or a profile of GalSim at a place in FITS pixels, as for :func:`measure`. It is drawn at the middle of
        each part of about 400 pixels a side, in which it is taken as constant.
    noise : float
        Standard deviation of the noise of a pixel, which has to be white and of one level.
    mask : array of shape (ny, nx), optional
        True for missing pixels.
    wcs : array of shape (2, 2), or WCS of GalSim or astropy, optional
        As for :func:`measure`, at the middle of the image: shapes and responses are then in the frame of the sky.
    threshold : float
        S/N of the smoothed light at which a pixel has half of its weight.
    threads : int, optional
        Worker threads; see :func:`set_threads` for the default. Results do not depend on it.

    Returns
    -------
    Catalogue
        A row for each detection: ``x`` and ``y`` in FITS pixels (the first pixel is 1), sums of weighted ellipticities ``e1`` and
        ``e2`` and their responses ``R11``, ``R22``, ``R12``, ``R21``, the sum of weights ``selection``, the largest S/N of
        the smoothed light ``snr``, the number of ``pixels`` with a weight, and ``flags``, which are 0. Use it as it is:
        weights are in e and R, and a cut on its columns has a response that is not known.

    Raises
    ------
    ValueError, TypeError
        If an argument does not fit.

    Examples
    --------
    >>> import numpy, shearq
    >>> y, x = numpy.mgrid[:200, :200] - 100.0
    >>> psf = numpy.exp(-(x * x + y * y)[77:124, 77:124] / 4.5)
    >>> image = 20 * numpy.exp(-(x * x + y * y) / 20) + numpy.random.default_rng(1).normal(0, 1, x.shape)
    >>> shearq.detect(image, psf, noise=1.0)
    <shearq.Catalogue of 1 galaxies, 0 flagged: x, y, e1, e2, R11, R22, R12, R21, selection, snr, flags, pixels>
    """
    pixels = shaped("image", with_missing("image", image, mask), "(ny, nx)", axes=2)
    draw = _draw_of(psf)
    star = double("psf", psf) if draw is None else _stars(psf, draw, wcs)
    if isinstance(star, np.ndarray) and star.ndim != 2:
        raise ValueError(f"psf: found an array of shape {shown(star.shape)}; expected (py, px)")
    if isinstance(star, np.ndarray) and not np.isfinite(star).all():
        raise ValueError("psf: found a pixel that is not finite; expected finite ones")
    level = real("noise", noise, "a positive number of image units", least=0.0)
    rows, columns = pixels.shape
    local = None
    if wcs is not None:
        local = _jacobians(wcs, np.array([[(columns + 1) / 2, (rows + 1) / 2]]))[0].tolist()
    single = np.ascontiguousarray(without_sentinels(pixels), dtype=np.float32)
    found, doubts = _shearq.detect(single, star, level, float(threshold), local, thread_count(threads))
    for doubt in doubts:
        warn(f"{doubt}.", DataWarning)
    catalogue = np.empty(len(found["e1"]), dtype=[(name, column.dtype) for name, column in found.items()]).view(Catalogue)
    for name, column in found.items():
        catalogue[name] = column
    catalogue.attrs = {
        "submission": "detection",
        "ellipticity": "shear",
        "frame": "pixel" if local is None else "sky",
        "version": _shearq.__version__,
        "response": _schema.NOT_APPLIED,
    }
    return catalogue
