"""Exposures and coadds of Rubin's pipelines, cut into stamps at the places of galaxies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ._arrays import double, shown, whole

# Planes of masks whose pixels have no light of the sky: those of afw's single exposures and of its coadds.
_PLANES = ("BAD", "CR", "EDGE", "INTRP", "NO_DATA", "SAT")


class _SkyWcs:
    """A ``SkyWcs`` of Rubin with the interface of astropy."""

    def __init__(self, wcs: Any) -> None:
        self._wcs = wcs

    def pixel_to_world_values(self, x: Any, y: Any) -> Any:
        return self._wcs.pixelToSkyArray(np.asarray(x, dtype=float), np.asarray(y, dtype=float), degrees=True)


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
        An ``lsst.afw.image.Exposure``, or an object with its attributes ``image``, ``mask`` and ``variance`` (each with ``array``),
        ``psf``, ``wcs`` and the method ``getXY0``. The sky is subtracted.
    x, y : array of shape (n,)
        Places of the galaxies in pixels of the exposure's parent frame, as in its source tables.
    size : int
        Side of the stamps in pixels.
    planes : sequence of str, optional
        Names of the mask planes whose pixels are missing. By default those of BAD, CR, EDGE, INTRP, NO_DATA and SAT that the
        mask has.
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
        if column.ndim != 1 or column.shape != columns[0].shape or not np.isfinite(column).all():
            raise ValueError(f"{name}: found an array of shape {shown(column.shape)}; expected finite places of shape (n,) like x")
    psf = exposure.psf if psf is None else psf
    for what, value in (("PSF", psf), ("WCS", exposure.wcs)):
        if value is None:
            raise ValueError(f"exposure: has no {what}; expected one")
    image, variance = np.asarray(exposure.image.array), np.asarray(exposure.variance.array)
    known = exposure.mask.getMaskPlaneDict()
    names = [plane for plane in _PLANES if plane in known] if planes is None else list(planes)
    absent = [name for name in names if name not in known]
    if absent:
        raise ValueError(f"planes: the mask has no plane {', '.join(absent)}; expected some of {', '.join(sorted(known))}")
    bits = exposure.mask.getPlaneBitMask(names) if names else 0
    missing = (np.asarray(exposure.mask.array) & bits) != 0
    missing |= ~(np.isfinite(variance) & (variance > 0))
    first = exposure.getXY0()
    stamps = np.full((len(columns[0]), side, side), np.nan, dtype=image.dtype)
    noise = np.empty(len(stamps))
    offsets = np.empty((len(stamps), 2))
    typical = np.sqrt(np.median(variance[~missing])) if not missing.all() else np.nan
    for k, place in enumerate(zip(*columns)):
        # From the corner of the stamp, whose pixels are whole numbers.
        at = [value - start for value, start in zip(place, (first[0], first[1]))]
        corner = [round(value - (side - 1) / 2) for value in at]
        offsets[k] = [value - start - (side - 1) / 2 for value, start in zip(at, corner)]
        # Of the image and of the stamp, in the order of axes y, x.
        own = tuple(slice(max(start, 0), max(min(start + side, n), 0)) for start, n in zip(corner[::-1], image.shape))
        there = tuple(slice(part.start - start, part.start - start + max(part.stop - part.start, 0)) for start, part in zip(corner[::-1], own))
        good = ~missing[own]
        stamps[k][there] = np.where(good, image[own], np.nan)
        noise[k] = np.sqrt(np.median(variance[own][good])) if good.any() else typical
    epoch = {"stamps": stamps, "psf": psf, "noise": noise, "wcs": _SkyWcs(exposure.wcs), "x": columns[0], "y": columns[1], "offsets": offsets}
    return {"epochs": [epoch], "x": columns[0], "y": columns[1], **({} if ids is None else {"ids": ids})}
