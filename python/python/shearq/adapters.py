"""Observations of ngmix as arguments of :func:`shearq.measure`, and tables of astropy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ._catalogue import Catalogue
from ._galsim import SAME, from_galsim as from_galsim, square_pixels

if TYPE_CHECKING:
    import astropy.table  # type: ignore[import-untyped, unused-ignore]

# Pixels between the centre of an observation and the middle of its stamp.
_OFF_CENTRE = 1.0


def _position(jacobian: Any, shape: tuple[int, int], k: int) -> None:
    """Refuses a centre that is not near the middle of the stamp."""
    if not hasattr(jacobian, "get_cen"):
        return
    row, column = jacobian.get_cen()
    off = max(abs(row - (shape[0] - 1) / 2), abs(column - (shape[1] - 1) / 2))
    if off > _OFF_CENTRE:
        raise ValueError(
            f"observations: the centre of observation {k} is ({row:.6g}, {column:.6g}) (row, column); expected the middle"
            f" of its {shape[0]} × {shape[1]} pixels. Try: cut the image around the galaxy"
        )


def from_ngmix(observations: Any) -> dict[str, NDArray[Any]]:
    """Arguments of :func:`measure` for an ngmix ``Observation``, or a sequence of them.

    The noise is the inverse root of the median of the positive weights. Pixels with a weight of zero, or with a bit of
    ``bmask``, are missing.

    Parameters
    ----------
    observations : ngmix.Observation or sequence of them
        One per galaxy, each with a PSF observation, and with its galaxy in the middle of the stamp.

    Returns
    -------
    dict
        ``stamps`` of shape (n, ny, nx), ``psf`` of shape (n, py, px), ``noise`` of shape (n,), and ``mask`` of shape
        (n, ny, nx) if pixels are missing.

    Raises
    ------
    ValueError
        If pixels are not square and along the axes, or scales or shapes differ; or if weights or a PSF are absent.

    Examples
    --------
    ``shearq.measure(**shearq.from_ngmix(observations))``
    """
    many = list(observations) if isinstance(observations, Sequence) else [observations]
    if not many:
        raise ValueError("observations: found none; expected one or more")
    stamps, psfs, noise, masks = [], [], [], []
    for k, observation in enumerate(many):
        if not hasattr(observation, "jacobian"):
            raise TypeError(
                f"observations: number {k} is of type {type(observation).__name__}; expected one Observation per galaxy,"
                " of one band and epoch"
            )
        scales = []
        try:
            pair = (("observation", observation), ("the PSF of observation", observation.psf))
        except (AttributeError, RuntimeError) as error:
            raise ValueError(f"observations: observation {k} has no PSF: {error}; expected one") from None
        for what, one in pair:
            jacobian = getattr(one, "jacobian", None)
            if jacobian is not None:
                values = [getattr(jacobian, f"get_d{way}")() for way in ("udcol", "udrow", "vdcol", "vdrow")]
                remedy = "Try: resample the image, or transform the shears of the pixel axes yourself"
                name = f"observations: {what} {k}"
                scales.append(square_pixels(name, (values[0], values[1], values[2], values[3]), remedy))
        if max(scales) - min(scales) > SAME * min(scales):
            raise ValueError(f"observations: observation {k} has the pixel scales {scales} (image, PSF); expected one scale")
        image, weight = np.asarray(observation.image), np.asarray(observation.weight)
        _position(observation.jacobian, (image.shape[0], image.shape[1]), k)
        positive = weight[weight > 0]
        if positive.size == 0:
            raise ValueError(f"observations: no weight of observation {k} is positive; expected inverse variances")
        missing = weight <= 0
        if getattr(observation, "bmask", None) is not None:
            missing |= np.asarray(observation.bmask) != 0
        stamps.append(image)
        psfs.append(np.asarray(observation.psf.image))
        noise.append(1 / np.sqrt(np.median(positive)))
        masks.append(missing)
    for name, images in (("image", stamps), ("PSF image", psfs)):
        shapes = {np.shape(image) for image in images}
        if len(shapes) > 1:
            raise ValueError(f"observations: {name}s of shapes {sorted(shapes)}; expected one shape")
    found = {"stamps": np.stack(stamps), "psf": np.stack(psfs), "noise": np.array(noise)}
    if any(mask.any() for mask in masks):
        found["mask"] = np.stack(masks)
    return found


def to_astropy(catalogue: Catalogue) -> astropy.table.Table:
    """As :meth:`Catalogue.to_astropy`."""
    return catalogue.to_astropy()


def from_astropy(table: astropy.table.Table) -> Catalogue:
    """As :meth:`Catalogue.from_table`."""
    return Catalogue.from_table(table)
