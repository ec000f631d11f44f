"""Detect galaxies on exposures, with the response of the detection."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _schema, _shearq
from ._arrays import double, real, shaped, shown, with_missing, without_sentinels
from ._catalogue import Catalogue
from ._psf_models import PsfsOfModel, _doubts, _draw_of
from ._threads import thread_count
from ._warn import DataWarning, warn
from ._wcs import AstropyWcs, WcsLike, jacobians


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


def _places(first: Any, own: Any) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """A function that returns the places in FITS pixels that one WCS has where another one has places."""
    both = (first, own)
    if all(hasattr(wcs, "world_to_pixel_values") for wcs in both):

        def of_astropy(places: NDArray[np.float64]) -> NDArray[np.float64]:
            world = first.pixel_to_world_values(*(places - 1.0).T)
            return np.asarray(np.stack(own.world_to_pixel_values(*world), axis=-1) + 1.0, dtype=np.float64)

        return of_astropy
    if all(hasattr(wcs, "toWorld") for wcs in both):
        import galsim

        def of_galsim(places: NDArray[np.float64]) -> NDArray[np.float64]:
            found = (own.toImage(first.toWorld(galsim.PositionD(x, y))) for x, y in places)
            return np.array([(at.x, at.y) for at in found], dtype=np.float64).reshape(-1, 2)

        return of_galsim
    raise ValueError(
        "wcs: found Jacobians or WCSs of several kinds; expected those of astropy or of GalSim for several exposures, by which their"
        " pixels have places on the sky"
    )


def _each(name: str, value: Any, count: int) -> list[Any]:
    """One value for each exposure, from one for all or a list."""
    if not isinstance(value, (list, tuple)):
        return [value] * count
    if len(value) != count:
        raise ValueError(f"{name}: found {len(value)}; expected {count}, one for each exposure")
    return list(value)


def _pixels(image: Any, mask: Any) -> NDArray[np.float32]:
    pixels = shaped("image", with_missing("image", image, mask), "(ny, nx)", axes=2)
    return np.ascontiguousarray(without_sentinels(pixels), dtype=np.float32)


def _star(psf: Any, wcs: Any) -> Any:
    """A stamp of the PSF, or a function that draws it."""
    draw = _draw_of(psf)
    if draw is not None:
        return _stars(psf, draw, wcs)
    star = double("psf", psf)
    if star.ndim != 2:
        raise ValueError(f"psf: found an array of shape {shown(star.shape)}; expected (py, px)")
    if not np.isfinite(star).all():
        raise ValueError("psf: found a pixel that is not finite; expected finite ones")
    return star


def _level(noise: Any) -> float:
    return real("noise", noise, "a positive number of image units", least=0.0)


def _local(wcs: Any, pixels: NDArray[np.float32]) -> list[list[float]] | None:
    """The Jacobian of a WCS in the middle of an image."""
    rows, columns = pixels.shape
    return None if wcs is None else _jacobians(wcs, np.array([[(columns + 1) / 2, (rows + 1) / 2]]))[0].tolist()


def detect(
    image: ArrayLike | Sequence[ArrayLike],
    psf: Any,
    *,
    noise: float | Sequence[float],
    mask: ArrayLike | Sequence[ArrayLike | None] | None = None,
    wcs: WcsLike | Sequence[AstropyWcs] | None = None,
    threshold: float = 6.0,
    threads: int | None = None,
) -> Catalogue:
    """Detect the galaxies of an exposure and measure them, with the response of the detection to shear.

    Each pixel has a weight, by its light above a threshold and above four neighbours, and an ellipticity. Both are functions of the
    image whose response to shear is known in closed form, so that the mean shear is calibrated with its detection. Pixels with a
    weight that touch each other are a row of the catalogue.

    Of a list of exposures of one sky, the light at each place is combined before the detection, with weights by the noise behind the PSF of
    each. They may be dithered, rotated and mirrored, have other pixels, and be partly beyond each other. Their fluxes need one zero point.

    Parameters
    ----------
    image : array of shape (ny, nx), or list of them
        The exposure, without sky. Pixels that are masked, not finite or −1e30 are missing: nothing is detected near them, unless another
        exposure of a list has them. Detections are on the pixels of the first one.
    psf : array of shape (py, px), model, or function of (x, y)
        The PSF of the exposure as a stamp that is centred on the star. If it varies: a model of Piff, PSFEx or Rubin, or a function
        that returns an image or a profile of GalSim at a place in FITS pixels, as for :func:`measure`. It is drawn at the middle of
        each part of about 400 pixels a side, in which it is taken as constant. One for all exposures, or a list.
    noise : float, or list of floats
        Standard deviation of the noise of a pixel, which has to be white and of one level. One for all exposures, or a list.
    mask : array of shape (ny, nx), optional
        True for missing pixels. Of several exposures a list, in which None is a mask without missing pixels.
    wcs : array of shape (2, 2), or WCS of GalSim or astropy, optional
        As for :func:`measure`, at the middle of the image: shapes and responses are then in the frame of the sky. Several exposures need a
        list of WCSs of GalSim or astropy, and have the frame of the sky of the first one.
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
    if isinstance(image, (list, tuple)) and len(image) > 0 and np.ndim(image[0]) == 2:
        count = len(image)
        frames = list(wcs) if isinstance(wcs, (list, tuple)) else [wcs]
        given = sum(own is not None for own in frames)
        if not given == len(frames) == count:
            raise ValueError(f"wcs: found {given}; expected {count}, one for each exposure")
        masks = [None] * count if mask is None else _each("mask", mask, count)
        images = [_pixels(*pair) for pair in zip(image, masks)]
        stars = [_star(*pair) for pair in zip(_each("psf", psf, count), frames)]
        levels = [_level(own) for own in _each("noise", noise, count)]
        places = [_places(frames[0], own) for own in frames]
        local = _local(frames[0], images[0])
        for at, own in enumerate(images):
            if any(np.array_equal(own, other, equal_nan=True) for other in images[:at]):
                raise ValueError(f"image: exposure {at + 1} has the same pixels as an earlier one; expected each exposure once, with its own noise")
        found, doubts = _shearq.detect_epochs(
            list(zip(images, stars, levels, places)), float(threshold), local, thread_count(threads)
        )
    else:
        single = _pixels(image, mask)
        local = _local(wcs, single)
        found, doubts = _shearq.detect(single, _star(psf, wcs), _level(noise), float(threshold), local, thread_count(threads))
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
