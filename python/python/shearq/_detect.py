"""Detect galaxies on exposures, with the response of the detection."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from . import _schema, _shearq
from ._arrays import double, real, shaped, shown, with_missing, without_sentinels
from ._catalogue import Catalogue
from ._threads import thread_count
from ._warn import DataWarning, warn
from ._wcs import WcsLike, jacobians


def detect(
    image: ArrayLike,
    psf: ArrayLike,
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
    psf : array of shape (py, px)
        The PSF of the exposure as a stamp that is centred on the star.
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
    star = double("psf", psf)
    if star.ndim != 2:
        raise ValueError(f"psf: found an array of shape {shown(star.shape)}; expected (py, px)")
    if not np.isfinite(star).all():
        raise ValueError("psf: found a pixel that is not finite; expected finite ones")
    level = real("noise", noise, "a positive number of image units", least=0.0)
    rows, columns = pixels.shape
    local = None
    if wcs is not None:
        middle = 1.0 if hasattr(wcs, "jacobian") else 0.0
        local = jacobians(wcs, 1, np.array([(columns - 1) / 2 + middle]), np.array([(rows - 1) / 2 + middle]))[0].tolist()
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
