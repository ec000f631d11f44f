"""Objects of other programs into what :func:`shearq.measure` takes, and catalogues into theirs.

None of those programs is needed unless its objects are used. A GalSim image, or a list of them, is taken by
:func:`shearq.measure` as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ._measure import Catalogue

# Relative, of pixel scales that should be the same.
_SAME = 1e-6


def from_ngmix(observations: Any) -> dict[str, Any]:
    """Arguments of :func:`shearq.measure` for an ngmix ``Observation``, or a sequence of them.

    The image and the PSF's are taken as they are; the noise is the inverse root of the median of the weights that are
    positive. Pixels have to be square and along the axes, with x along columns.

    Parameters
    ----------
    observations : ngmix.Observation or sequence of them
        Each with a PSF observation, and centred: ngmix's row and column of the centre are not looked at.

    Returns
    -------
    dict
        ``stamps`` of shape (n, ny, nx), ``psf`` of shape (n, py, px), ``noise`` of shape (n,).

    Examples
    --------
    >>> shearq.measure(**shearq.adapters.from_ngmix(observations))
    """
    many = list(observations) if isinstance(observations, Sequence) else [observations]
    if not many:
        raise ValueError("observations: found none; expected one or more")
    stamps, psfs, noise = [], [], []
    for k, observation in enumerate(many):
        jacobian = observation.jacobian
        xx, xy = jacobian.get_dudcol(), jacobian.get_dudrow()
        yx, yy = jacobian.get_dvdcol(), jacobian.get_dvdrow()
        if not (xx > 0 and max(abs(xy), abs(yx), abs(yy - xx)) <= _SAME * xx):
            raise ValueError(
                f"observations: the jacobian of observation {k} is ({xx}, {xy}, {yx}, {yy}) (dudcol, dudrow, dvdcol,"
                " dvdrow); expected square pixels along the axes, (s, 0, 0, s)"
            )
        weight = np.asarray(observation.weight)
        positive = weight[weight > 0]
        if positive.size == 0:
            raise ValueError(f"observations: no weight of observation {k} is positive; expected inverse variances")
        try:
            psfs.append(observation.psf.image)
        except (AttributeError, RuntimeError) as error:
            raise ValueError(f"observations: observation {k} has no PSF: {error}; expected one") from None
        stamps.append(observation.image)
        noise.append(1 / np.sqrt(np.median(positive)))
    for name, images in (("image", stamps), ("PSF image", psfs)):
        shapes = {np.shape(image) for image in images}
        if len(shapes) > 1:
            raise ValueError(f"observations: {name}s of shapes {sorted(shapes)}; expected one shape")
    return {"stamps": np.stack(stamps), "psf": np.stack(psfs), "noise": np.array(noise)}


def to_astropy(catalogue: Catalogue) -> Any:
    """An ``astropy.table.Table`` of a catalogue, with its ``attrs`` as ``meta``.

    Raises
    ------
    ImportError
        Where astropy is not installed.
    """
    from astropy.table import Table

    return Table(catalogue.view(np.ndarray), meta=dict(catalogue.attrs))


def from_astropy(table: Any) -> Catalogue:
    """The catalogue of an ``astropy.table.Table`` that :func:`to_astropy` made, or read back from a file of it.

    Raises
    ------
    ValueError
        Where columns that a catalogue needs are not there.
    """
    needed = ("e1", "e2", "R11", "R22", "flags")
    missing = [name for name in needed if name not in table.colnames]
    if missing:
        raise ValueError(f"table: no columns {', '.join(missing)}; expected {', '.join(needed)}")
    catalogue = np.asarray(table.as_array()).view(Catalogue)
    # FITS files write the keys of their headers in capitals.
    catalogue.attrs = {key.lower(): value for key, value in table.meta.items()}
    return catalogue
