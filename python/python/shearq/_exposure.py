"""Exposures and coadds of Rubin's pipelines, cut into stamps at the places of galaxies."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._arrays import double, shown, whole
from ._tables import library

# Planes of masks whose pixels have no light of the sky: those of afw's exposures and coadds, and their names in lsst.images.
_PLANES = (
    *("BAD", "CR", "EDGE", "INTRP", "NO_DATA", "SAT"),
    *("COSMIC_RAY", "DETECTION_EDGE", "INTERPOLATED", "SATURATED"),
)


class _Projection:
    """A function from pixels to right ascension and declination in degrees with the interface of astropy."""

    def __init__(self, to_sky: Callable[[Any, Any], Any]) -> None:
        self._to_sky = to_sky

    def pixel_to_world_values(self, x: Any, y: Any) -> Any:
        return self._to_sky(np.asarray(x, dtype=float), np.asarray(y, dtype=float))


class _Parts(NamedTuple):
    """What exposures of all kinds have, in the pixels of the parent frame."""

    image: NDArray[Any]
    variance: NDArray[Any]
    # Column and row of the first pixel.
    first: tuple[int, int]
    psf: Any
    wcs: _Projection | None
    # The pixels of each plane of the mask.
    planes: Mapping[str, Callable[[], NDArray[np.bool_]]]


def _of_afw(exposure: Any) -> _Parts:
    mask, wcs = exposure.mask, exposure.wcs
    first = exposure.getXY0()

    def plane(name: str) -> Callable[[], NDArray[np.bool_]]:
        return lambda: (np.asarray(mask.array) & mask.getPlaneBitMask([name])) != 0

    to_sky = None if wcs is None else _Projection(lambda x, y: wcs.pixelToSkyArray(x, y, degrees=True))
    planes = {name: plane(name) for name in mask.getMaskPlaneDict()}
    return _Parts(np.asarray(exposure.image.array), np.asarray(exposure.variance.array), (first[0], first[1]), exposure.psf, to_sky, planes)


def _of_images(exposure: Any) -> _Parts:
    """Of a ``VisitImage``, a coadd or a ``MaskedImage`` of lsst.images."""
    projection = exposure.sky_projection

    def to_sky(x: Any, y: Any) -> Any:
        sky = projection.pixel_to_sky(x=x, y=y)
        return sky.ra.deg, sky.dec.deg

    def plane(name: str) -> Callable[[], NDArray[np.bool_]]:
        return lambda: np.asarray(exposure.mask.get(name))

    column, row = exposure.bbox.start.xy
    planes = {name: plane(name) for name in exposure.mask.schema.names}
    wcs = None if projection is None else _Projection(to_sky)
    return _Parts(np.asarray(exposure.image.array), np.asarray(exposure.variance.array), (column, row), getattr(exposure, "psf", None), wcs, planes)


def _of_file(path: str) -> _Parts:
    """Of a FITS file with images called IMAGE, MASK and VARIANCE, as afw and lsst.images write them. Its PSF is not read."""
    fits, celestial = (library(name, "from_exposure of a file") for name in ("astropy.io.fits", "astropy.wcs"))
    with fits.open(path) as hdus:
        absent = [name for name in ("IMAGE", "MASK", "VARIANCE") if name not in hdus]
        if absent:
            raise ValueError(f"{path}: no image is called {', '.join(absent)}; expected IMAGE, MASK and VARIANCE")
        image, mask, variance = (np.array(hdus[name].data) for name in ("IMAGE", "MASK", "VARIANCE"))
        header, of_mask = hdus["IMAGE"].header, hdus["MASK"].header
        wcs = celestial.WCS(header)
    # afw states bits, lsst.images masks.
    bits = {key[3:]: 1 << int(value) for key, value in of_mask.items() if key.startswith("MP_")}
    bits |= {str(value): int(of_mask[f"MSKM{key[4:]}"]) for key, value in of_mask.items() if key.startswith("MSKN")}
    first = (round(-header.get("LTV1", 0)), round(-header.get("LTV2", 0)))

    def plane(bit: int) -> Callable[[], NDArray[np.bool_]]:
        return lambda: (mask & bit) != 0

    to_sky = _Projection(lambda x, y: wcs.pixel_to_world_values(x - first[0], y - first[1])) if wcs.has_celestial else None
    return _Parts(image, variance, first, None, to_sky, {name: plane(bit) for name, bit in bits.items()})


def _parts(exposure: Any) -> _Parts:
    if isinstance(exposure, (str, os.PathLike)):
        return _of_file(os.fspath(exposure))
    if hasattr(exposure, "sky_projection"):
        return _of_images(exposure)
    return _of_afw(exposure)


def from_exposure(
    exposure: Any,
    x: ArrayLike,
    y: ArrayLike,
    *,
    size: int = 48,
    planes: Sequence[str] | None = None,
    psf: Any = None,
    ids: ArrayLike | None = None,
) -> dict[str, Any]:
    """Arguments of :func:`measure` for galaxies on an exposure or coadd of Rubin.

    Parameters
    ----------
    exposure
        An ``lsst.afw.image.Exposure``, a ``VisitImage``, coadd or ``MaskedImage`` of lsst.images, an object with the same
        attributes and methods, or a FITS file of one with images called IMAGE, MASK and VARIANCE, whose PSF is not read. The sky
        is subtracted.
    x, y : array of shape (n,)
        Places of the galaxies in pixels of the exposure's parent frame, as in its source tables.
    size : int
        Side of the stamps in pixels.
    planes : sequence of str, optional
        Names of the mask planes whose pixels are missing. By default those of BAD, CR, EDGE, INTRP, NO_DATA and SAT (in
        lsst.images COSMIC_RAY, DETECTION_EDGE, INTERPOLATED and SATURATED) that the mask has.
    psf : optional
        A PSF in place of the exposure's, as :func:`measure` takes it.
    ids : array of shape (n,), optional
        Identifiers, which become the column ``id``.

    Returns
    -------
    dict
        One epoch with ``stamps``, ``psf``, ``noise``, ``wcs`` and ``offsets``, and ``x``, ``y`` and perhaps ``ids``. Shapes are in
        the frame of the sky. Pixels beyond the exposure are missing, so that galaxies outside it are flagged.

    Raises
    ------
    ValueError
        If a mask lacks a plane, or the exposure a PSF or WCS.

    Examples
    --------
    ``shearq.measure(**shearq.from_exposure(calexp, table["x"], table["y"]))``
    """
    side = whole("size", size, 1, 1 << 12)
    columns = [double(name, value) for name, value in (("x", x), ("y", y))]
    for name, column in zip("xy", columns):
        if column.ndim != 1 or column.shape != columns[0].shape:
            raise ValueError(f"{name}: found an array of shape {shown(column.shape)}; expected places of shape (n,) like x")
        bad = ~np.isfinite(column)
        if bad.any():
            row = int(bad.argmax())
            raise ValueError(
                f"{name}: found {column[row]:g} in row {row} (from 0), and {int(bad.sum())} such rows; expected finite places."
                " Try: rows for which np.isfinite(x) & np.isfinite(y)"
            )
    image, variance, first, own_psf, wcs, known = _parts(exposure)
    psf = own_psf if psf is None else psf
    for what, value, hint in (("PSF", psf, ". Try: psf="), ("WCS", wcs, "")):
        if value is None:
            raise ValueError(f"exposure: has no {what}; expected one{hint}")
    names = [plane for plane in _PLANES if plane in known] if planes is None else list(planes)
    absent = [name for name in names if name not in known]
    if absent:
        raise ValueError(f"planes: the mask has no plane {', '.join(absent)}; expected some of {', '.join(sorted(known))}")
    missing = ~(np.isfinite(variance) & (variance > 0))
    shares = {"the variance": missing.mean()}
    for name in names:
        of_plane = known[name]()
        shares[name] = of_plane.mean()
        missing |= of_plane
    if missing.all():
        masked = ", ".join(f"{name} {share:.0%}" for name, share in shares.items() if share > 0)
        raise ValueError(f"exposure: all pixels are masked (by {masked}); expected some good ones. Try: planes=, without one that marks good pixels")
    stamps = np.full((len(columns[0]), side, side), np.nan, dtype=image.dtype)
    noise = np.empty(len(stamps))
    offsets = np.empty((len(stamps), 2))
    typical = np.sqrt(np.median(variance[~missing]))
    for k, place in enumerate(zip(*columns)):
        # From the corner of the stamp, whose pixels are whole numbers.
        at = [value - start for value, start in zip(place, first)]
        corner = [round(value - (side - 1) / 2) for value in at]
        offsets[k] = [value - start - (side - 1) / 2 for value, start in zip(at, corner)]
        # Of the image and of the stamp, in the order of axes y, x.
        own = tuple(slice(max(start, 0), max(min(start + side, n), 0)) for start, n in zip(corner[::-1], image.shape))
        there = tuple(slice(part.start - start, part.start - start + max(part.stop - part.start, 0)) for start, part in zip(corner[::-1], own))
        good = ~missing[own]
        stamps[k][there] = np.where(good, image[own], np.nan)
        noise[k] = np.sqrt(np.median(variance[own][good])) if good.any() else typical
    epoch = {"stamps": stamps, "psf": psf, "noise": noise, "wcs": wcs, "x": columns[0], "y": columns[1], "offsets": offsets}
    return {"epochs": [epoch], "x": columns[0], "y": columns[1], **({} if ids is None else {"ids": ids})}
