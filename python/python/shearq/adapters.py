"""Observations of ngmix as arguments of :func:`shearq.measure`, and tables of astropy."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ._arrays import whole
from ._catalogue import Catalogue
from ._galsim import SAME, from_galsim as from_galsim, square_pixels

if TYPE_CHECKING:
    import astropy.table

# Pixels between the centre of an observation and the middle of its stamp.
_OFF_CENTRE = 1.0
# σ in pixels of the Gaussian under which mean fluxes of bands are measured. Chosen by hand: they are weights only.
_FLUX_SIGMA = 3.0


def _check_centre(observation: Any, image: NDArray[Any], psf: NDArray[Any], k: int) -> None:
    """Refuses a galaxy that is not near the middle of its stamp, counted from its PSF's place."""
    offset = _galaxy_offset(observation, image, psf)
    if max(map(abs, offset)) <= _OFF_CENTRE:
        return
    own = _offset(observation.jacobian, image)
    if max(map(abs, own)) > _OFF_CENTRE:
        what, remedy = f"the galaxy of observation {k} is", "cut the image around the galaxy"
    else:
        own = _offset(getattr(observation.psf, "jacobian", None), psf)
        what, remedy = f"the PSF of observation {k} is, by its Jacobian,", "cut the PSF image around the PSF"
    raise ValueError(
        f"observations: {what} ({own[0]:+.3g}, {own[1]:+.3g}) px from the middle of its pixels; expected at most {_OFF_CENTRE:g} px"
        f" between galaxy and PSF. Try: {remedy}, or an ObsList for each galaxy"
    )


def from_ngmix(observations: Any, fluxes: Any = None, *, size: int | None = None) -> dict[str, Any]:
    """Arguments of :func:`measure` for ngmix ``Observation``, ``ObsList`` or ``MultiBandObsList``, or a sequence of them.

    The noise is the inverse root of the median of the positive weights. Pixels with a weight of zero, or with a bit of
    ``bmask``, are missing.

    Parameters
    ----------
    observations
        One per galaxy, each with a PSF observation. An ``Observation`` has its galaxy in the middle of the stamp. An
        ``ObsList`` has epochs, which may be rotated and dithered, and a ``MultiBandObsList`` has them in several bands.
    fluxes : array of shape (bands,) or (n, bands), optional
        Fluxes of the galaxies in the bands, in any unit. They weight the bands, with flux/noise², and should not be measured on
        the noise of the galaxy itself. By default they are the mean fluxes of all galaxies of the call under a Gaussian of
        σ = 3 px: any common weights leave the shear unbiased, so that only the noise grows where colours differ.
    size : int, optional
        Side of the stamps in pixels, for images of several or of small shapes. Larger images are cut around the galaxy, and smaller
        ones get borders of white noise. By default images are taken as they are.

    Returns
    -------
    dict
        ``stamps`` of shape (n, ny, nx), ``psf`` of shape (n, py, px), ``noise`` of shape (n,), and ``mask`` of shape
        (n, ny, nx) if pixels are missing. Of lists, ``epochs``, with a WCS: shapes are in the frame of ngmix's (u, v).

    Raises
    ------
    ValueError
        If pixels of single observations are not square and along the axes, or scales or shapes differ; if weights or a PSF are
        absent; or if the galaxies of a band have no mean flux.

    Examples
    --------
    ``shearq.measure(**shearq.from_ngmix(observations))``
    """
    is_one = not isinstance(observations, Sequence) or type(observations).__name__ in ("ObsList", "MultiBandObsList")
    many = [observations] if is_one else list(observations)
    if not many:
        raise ValueError("observations: found none; expected one or more")
    if size is not None:
        many = [_resized(one, whole("size", size, 1, 1 << 12)) for one in many]
    if any(isinstance(one, Sequence) for one in many):
        return {"epochs": _epochs([_bands(k, one) for k, one in enumerate(many)], fluxes)}
    if fluxes is not None:
        raise ValueError("fluxes: found for observations of one band; expected none")
    parts = []
    for k, observation in enumerate(many):
        image, psf, noise, missing, matrices = _arrays(f"observation {k}", observation)
        scales = []
        for what, matrix in zip(("observation", "the PSF of observation"), matrices):
            if matrix is not None:
                remedy = "Try: an ObsList for each galaxy, which is measured on the sky"
                scales.append(square_pixels(f"observations: {what} {k}", matrix, remedy))
        if max(scales) - min(scales) > SAME * min(scales):
            raise ValueError(f"observations: observation {k} has the pixel scales {scales} (image, PSF); expected one scale")
        _check_centre(observation, image, psf, k)
        parts.append((image, psf, noise, missing))
    stamps, psfs, levels, masks = zip(*parts)
    for name, images in (("image", stamps), ("PSF image", psfs)):
        _one_shape(name, images)
    found = {"stamps": np.stack(stamps), "psf": np.stack(psfs), "noise": np.array(levels)}
    if any(mask.any() for mask in masks):
        found["mask"] = np.stack(masks)
    return found


def _arrays(what: str, observation: Any) -> tuple[Any, Any, float, Any, list[Any]]:
    """Image, PSF, noise, missing pixels, and the Jacobians (du/dx, du/dy, dv/dx, dv/dy) of both."""
    if not hasattr(observation, "jacobian"):
        raise TypeError(
            f"observations: {what} is of type {type(observation).__name__}; expected an Observation, ObsList or MultiBandObsList"
        )
    try:
        star = observation.psf
    except (AttributeError, RuntimeError) as error:
        raise ValueError(f"observations: {what} has no PSF: {error}; expected one") from None
    matrices: list[Any] = []
    for one in (observation, star):
        jacobian = getattr(one, "jacobian", None)
        ways = ("udcol", "udrow", "vdcol", "vdrow")
        matrices.append(None if jacobian is None else tuple(getattr(jacobian, f"get_d{way}")() for way in ways))
    image, weight = np.asarray(observation.image), np.asarray(observation.weight)
    positive = weight[weight > 0]
    if positive.size == 0:
        raise ValueError(f"observations: no weight of {what} is positive; expected inverse variances")
    missing = weight <= 0
    if getattr(observation, "bmask", None) is not None:
        missing |= np.asarray(observation.bmask) != 0
    return image, np.asarray(star.image), float(1 / np.sqrt(np.median(positive))), missing, matrices


def _one_shape(name: str, images: Sequence[Any]) -> None:
    shapes = {np.shape(image) for image in images}
    if len(shapes) > 1:
        remedy = ". Try: size=48" if name == "image" else ""
        raise ValueError(f"observations: {name}s of shapes {sorted(shapes)}; expected one shape{remedy}")


def _square(image: NDArray[Any], fill: float, centre: tuple[float, float], side: int) -> tuple[NDArray[Any], tuple[float, float]]:
    """``side`` pixels around the pixel at the centre, those beyond the image filled, and the centre there."""
    corner = [round(at - (side - 1) / 2) for at in centre]
    found = np.full((side, side), fill, dtype=image.dtype)
    own = tuple(slice(max(at, 0), max(min(at + side, n), 0)) for at, n in zip(corner, image.shape))
    there = tuple(slice(part.start - at, part.start - at + max(part.stop - part.start, 0)) for at, part in zip(corner, own))
    found[there] = image[own]
    return found, (centre[0] - corner[0], centre[1] - corner[1])


def _resized(observation: Any, size: int) -> Any:
    """Observations whose images have ``size`` pixels around their centres.

    Beyond the images is white noise of the median weight, the same for the same image. Missing pixels would flag the galaxy, because
    the opposite ones are missing, too; and zeros are taken for the borders of exposures.
    """
    if isinstance(observation, Sequence):
        return [_resized(one, size) for one in observation]
    try:
        image, jacobian, psf = np.asarray(observation.image), observation.jacobian, observation.psf
    except (AttributeError, RuntimeError):
        # `_arrays` says what is absent.
        return observation
    centre = tuple(jacobian.get_cen()) if hasattr(jacobian, "get_cen") else tuple((side - 1) / 2 for side in image.shape)

    def square(pixels: Any) -> NDArray[Any]:
        return _square(np.asarray(pixels), 0, centre, size)[0]

    stamp, middle = _square(image, 0, centre, size)
    weight, inside = square(observation.weight), square(np.ones(image.shape, bool))
    if (weight > 0).any():
        weight[~inside] = np.median(weight[weight > 0])
        noise = np.random.default_rng(zlib.crc32(image.astype("<f8").tobytes())).normal(size=np.count_nonzero(~inside))
        stamp[~inside] = noise / np.sqrt(weight[~inside])
    mask = getattr(observation, "bmask", None)
    derivatives = {f"get_d{way}": getattr(jacobian, f"get_d{way}") for way in ("udcol", "udrow", "vdcol", "vdrow")}
    jacobian = SimpleNamespace(get_cen=lambda: middle, **derivatives)
    return SimpleNamespace(image=stamp, weight=weight, bmask=None if mask is None else square(mask), jacobian=jacobian, psf=psf)


def _offset(jacobian: Any, image: NDArray[Any]) -> tuple[float, float]:
    """The centre (x, y) of an observation from the middle of its pixels; zero if it states none."""
    if not hasattr(jacobian, "get_cen"):
        return (0.0, 0.0)
    row, column = jacobian.get_cen()
    return (column - (image.shape[1] - 1) / 2, row - (image.shape[0] - 1) / 2)


def _galaxy_offset(observation: Any, image: NDArray[Any], psf: NDArray[Any]) -> tuple[float, float]:
    """Where the galaxy is without its PSF: deconvolution moves it by the place of the PSF, which MEDS draws at the galaxy's phase."""
    own, of_psf = _offset(observation.jacobian, image), _offset(getattr(observation.psf, "jacobian", None), psf)
    return (own[0] - of_psf[0], own[1] - of_psf[1])


def _bands(k: int, galaxy: Any) -> list[list[Any]]:
    """The epochs of a galaxy in each band."""
    if not isinstance(galaxy, Sequence):
        raise TypeError(f"observations: galaxy {k} is an Observation and others are lists; expected one kind")
    bands = list(galaxy)
    return bands if bands and all(isinstance(band, Sequence) for band in bands) else [bands]


def _epochs(galaxies: list[list[list[Any]]], fluxes: Any) -> list[dict[str, Any]]:
    """Epochs of all galaxies: the first of each, the second, and so on, band by band."""
    bands = len(galaxies[0])
    if any(len(galaxy) != bands for galaxy in galaxies):
        raise ValueError(f"observations: the galaxies have other numbers of bands; expected {bands}, empty lists without epochs")
    found = []
    for band in range(bands):
        for number in range(max(len(galaxy[band]) for galaxy in galaxies)):
            found.append((band, _epoch_of(galaxies, band, number)))
    if not found:
        raise ValueError("observations: found no epoch; expected one or more")
    if fluxes is None:
        mean = [_mean_flux([epoch for of, epoch in found if of == band]) for band in range(bands)]
        for band, flux in enumerate(mean):
            if bands > 1 and not flux > 0:
                raise ValueError(f"observations: the galaxies of band {band} have no mean flux (found {flux:g}). Try: without the band")
        weights = np.array(mean) / np.nanmax(mean) if bands > 1 else np.ones(1)
    else:
        weights = np.asarray(fluxes, dtype=float)
        if weights.shape not in ((bands,), (len(galaxies), bands)):
            raise ValueError(f"fluxes: found shape {weights.shape}; expected ({bands},) or ({len(galaxies)}, {bands})")
    for band, epoch in found:
        if bands > 1:
            epoch["flux"] = weights[..., band]
    return [epoch for _, epoch in found]


def _epoch_of(galaxies: list[list[list[Any]]], band: int, number: int) -> dict[str, Any]:
    """One epoch of each galaxy, with stamps of NaN for those without it."""
    parts = {}
    for k, galaxy in enumerate(galaxies):
        if number < len(galaxy[band]):
            what = f"epoch {number} of band {band} of galaxy {k}"
            observation = galaxy[band][number]
            image, psf, noise, missing, (own, of_psf) = _arrays(what, observation)
            if of_psf is not None and not np.allclose(own, of_psf, rtol=0, atol=SAME * np.max(np.abs(own))):
                raise ValueError(f"observations: the PSF of {what} has another Jacobian; expected the pixels of its image")
            offset = _galaxy_offset(observation, image, psf)
            parts[k] = np.where(missing, np.nan, image), psf, noise, np.reshape(own, (2, 2)), offset
    for name, place in (("image", 0), ("PSF image", 1)):
        _one_shape(name, [part[place] for part in parts.values()])
    stamp, psf, noise, matrix, _ = next(iter(parts.values()))
    none = np.full(np.shape(stamp), np.nan), psf, noise, matrix, (0.0, 0.0)
    columns = zip(*(parts.get(k, none) for k in range(len(galaxies))))
    return dict(zip(("stamps", "psf", "noise", "wcs", "offsets"), map(np.array, columns)))


def _mean_flux(epochs: list[dict[str, Any]]) -> float:
    """The mean flux of galaxies under a Gaussian, with inverse-variance weights."""
    light = weights = 0.0
    for epoch in epochs:
        side = epoch["stamps"].shape[-1]
        rows, columns = np.indices((side, side)) - (side - 1) / 2
        for stamp, noise, offset in zip(epoch["stamps"], epoch["noise"], epoch["offsets"]):
            window = np.exp(-((columns - offset[0]) ** 2 + (rows - offset[1]) ** 2) / (2 * _FLUX_SIGMA**2))
            seen = np.isfinite(stamp)
            light += np.sum(window[seen] * stamp[seen]) / noise**2
            weights += np.sum(window[seen] ** 2) / noise**2
    return float(light / weights) if weights > 0 else np.nan


def to_astropy(catalogue: Catalogue) -> astropy.table.Table:
    """As :meth:`Catalogue.to_astropy`."""
    return catalogue.to_astropy()


def from_astropy(table: astropy.table.Table) -> Catalogue:
    """As :meth:`Catalogue.from_table`."""
    return Catalogue.from_table(table)
