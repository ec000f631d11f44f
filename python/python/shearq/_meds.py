"""Galaxies of MEDS files (Multi Epoch Data Structures) as epochs."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, Literal, Union

import numpy as np
from numpy.typing import NDArray

from ._arrays import whole
from ._tables import library
from .adapters import _epochs, _resized

MedsPsfs = Union[Callable[[Any, int, int], Any], Sequence[Any], Mapping[int, Any]]
"""PSFs of a MEDS file: a function of (meds, galaxy, cutout), or a model for each ``file_id``."""


class _MedsFile:
    """A MEDS file with the methods of ``meds.MEDS`` that are used here, read by astropy."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        fits = library("astropy.io.fits", "from_meds")
        self._path = path
        try:
            self._fits = fits.open(path, memmap=True, disable_image_compression=False)
        except FileNotFoundError:
            raise FileNotFoundError(f"meds: there is no file {os.fspath(path)}") from None
        except OSError as error:
            raise ValueError(f"meds: {os.fspath(path)}: {error}; expected a MEDS file") from None
        try:
            self._cat = np.asarray(self._fits["object_data"].data)
        except KeyError:
            names = ", ".join(hdu.name or "no name" for hdu in self._fits)
            raise ValueError(f"{path}: found the extensions {names}; expected object_data and image_cutouts of a MEDS file") from None

    def __del__(self) -> None:
        # As a file of Python, which nobody reads any more.
        if hasattr(self, "_fits"):
            self._fits.close()

    @property
    def size(self) -> int:
        return len(self._cat)

    def get_cat(self) -> NDArray[Any]:
        return self._cat

    def has_psf(self) -> bool:
        return "psf" in self._fits

    def _pixels(self, extension: str, start: int, rows: int, columns: int) -> NDArray[Any]:
        # Without the rest of the mosaic, which has all cutouts of the file.
        return np.asarray(self._fits[extension].section[start : start + rows * columns]).reshape(rows, columns)

    def get_cutout(self, galaxy: int, cutout: int, type: str = "image") -> NDArray[Any]:
        extension = f"{type}_cutouts"
        if extension not in self._fits:
            raise ValueError(f"{self._path}: has no extension {extension}")
        side = int(self._cat["box_size"][galaxy])
        return self._pixels(extension, int(self._cat["start_row"][galaxy, cutout]), side, side)

    def get_psf(self, galaxy: int, cutout: int) -> NDArray[Any]:
        names = self._cat.dtype.names or ()
        sides = ("psf_row_size", "psf_col_size") if "psf_row_size" in names else ("psf_box_size", "psf_box_size")
        rows, columns = (int(self._cat[name][galaxy, cutout] if self._cat[name].ndim > 1 else self._cat[name][galaxy]) for name in sides)
        return self._pixels("psf", int(self._cat["psf_start_row"][galaxy, cutout]), rows, columns)


def _centre(catalogue: Any, prefix: str, galaxy: int, cutout: int, shape: tuple[int, int]) -> tuple[float, float]:
    """Row and column of the centre of a cutout: the middle for PSFs whose file does not say it."""
    if f"{prefix}cutout_row" not in (catalogue.dtype.names or ()):
        return (shape[0] - 1) / 2, (shape[1] - 1) / 2
    return float(catalogue[f"{prefix}cutout_row"][galaxy, cutout]), float(catalogue[f"{prefix}cutout_col"][galaxy, cutout])


def _jacobian(catalogue: Any, galaxy: int, cutout: int, centre: tuple[float, float]) -> SimpleNamespace:
    """With the methods of a Jacobian of ngmix."""
    derivatives = {name: float(catalogue[name][galaxy, cutout]) for name in ("dudrow", "dudcol", "dvdrow", "dvdcol")}
    return SimpleNamespace(get_cen=lambda: centre, **{f"get_{name}": (lambda value=value: value) for name, value in derivatives.items()})


def from_meds(
    meds: Any,
    psfs: MedsPsfs | None = None,
    *,
    coadd: Literal["skip", "only", "absent"],
    size: int = 48,
    block: int = 2000,
    start: int = 0,
    end: int | None = None,
    bits: int = -1,
    fluxes: Any = None,
) -> Iterator[dict[str, Any]]:
    """Arguments of :func:`measure` for the galaxies of a MEDS file, block by block.

    Parameters
    ----------
    meds : path or object, or list of them
        A MEDS file, which is read by astropy, or an object with the methods of ``meds.MEDS``. Of a list, one for each band, with the
        same galaxies in the same rows; the bands are combined as by :func:`from_ngmix`.
    psfs : optional
        By default the extension ``psf`` of the file. For a list of files, a list. Otherwise a function of (meds, galaxy, cutout) that returns an image,
        centred in the middle, or a profile of GalSim; or for each ``file_id`` a model of the PSF, as :func:`measure` takes them, drawn at
        ``orig_col`` + 1 and ``orig_row`` + 1, a profile or an image.
    coadd : {'skip', 'only', 'absent'}
        Whether the first cutout of each galaxy is a coadd, as in most files of DES: ``'skip'`` uses all others, ``'only'`` this
        one, and ``'absent'`` all.
    size : int
        Side of the stamps in pixels. Larger cutouts are cut around the galaxy, and smaller ones get borders of white noise.
    block : int
        Galaxies of a block; noise, sky and galaxy size are measured on each block.
    start, end : int, optional
        Numbers of the first galaxy, and of that behind the last one.
    fluxes : array of shape (bands,) or (n, bands), optional
        As for :func:`from_ngmix`, n being all galaxies of the file.
    bits : int
        Bits of ``bmask`` whose pixels are missing; all by default. Pixels with a weight of zero are missing, too.

    Yields
    ------
    dict
        ``epochs`` and ``ids`` (the column ``id``, or the numbers of the galaxies). Shapes are in the frame of the file's (u, v).

    Raises
    ------
    ValueError
        If the file has no PSFs and none are given, or a table lacks a column.

    Examples
    --------
    ``catalogues = [shearq.measure(**part) for part in shearq.from_meds("tile.fits", coadd="skip")]``
    """
    if coadd not in ("skip", "only", "absent"):
        raise ValueError(f"coadd: found {coadd!r}; expected 'skip', 'only' or 'absent'")
    side, most = whole("size", size, 1, 1 << 12), whole("block", block, 1, 1 << 24)
    several = isinstance(meds, (list, tuple))
    files = [_MedsFile(one) if isinstance(one, (str, os.PathLike)) else one for one in (meds if several else [meds])]
    stars = list(psfs) if several and isinstance(psfs, Sequence) else [psfs] * len(files)
    if not files or len(stars) != len(files):
        raise ValueError(f"psfs: found {len(stars)} for {len(files)} files; expected one for each")
    for star in stars:
        if not (star is None or callable(star) or isinstance(star, (Sequence, Mapping))):
            raise TypeError(
                f"psfs: found {type(star).__name__}; expected a function of (meds, galaxy, cutout), or a list or dict with a model for each"
                " file_id"
            )
    catalogues = [file.get_cat() for file in files]
    for k, (file, star, catalogue) in enumerate(zip(files, stars, catalogues)):
        of = f"meds: file {k}" if several else "meds"
        if star is None and not file.has_psf():
            raise ValueError(f"{of}: has no extension psf. Try: psfs=, a function of (meds, galaxy, cutout), or a model for each file_id")
        needed = ("ncutout", "box_size", "cutout_row", "cutout_col", "dudrow", "dudcol", "dvdrow", "dvdcol")
        absent = [name for name in needed if name not in (catalogue.dtype.names or ())]
        if absent:
            raise ValueError(f"{of}: object_data lacks {', '.join(absent)}; expected the columns of a MEDS file")
        if len(catalogue) != len(catalogues[0]) or (_ids(catalogue) != _ids(catalogues[0])).any():
            raise ValueError(f"{of}: has {len(catalogue)} galaxies, and not those of file 0; expected the same in the same rows")
    last = len(catalogues[0]) if end is None else min(whole("end", end, 0, 1 << 40), len(catalogues[0]))
    first = whole("start", start, 0, 1 << 40)
    if first >= last:
        raise ValueError(f"start: found {first}; expected less than {last}, the end of the galaxies")

    def blocks() -> Iterator[dict[str, Any]]:
        for at in range(first, last, most):
            rows = range(at, min(at + most, last))
            bands = list(zip(files, catalogues, stars))
            galaxies = [[_cutouts(*band, row, coadd, side, bits) for band in bands] for row in rows]
            weights = fluxes if np.ndim(fluxes) < 2 else fluxes[rows.start : rows.stop]
            yield {"epochs": _epochs(galaxies, weights), "ids": _ids(catalogues[0])[rows.start : rows.stop]}

    return blocks()


def _ids(catalogue: Any) -> NDArray[np.int64]:
    """The identifiers of the galaxies, or their rows."""
    return np.asarray(catalogue["id"] if "id" in catalogue.dtype.names else np.arange(len(catalogue)), dtype=np.int64)


def _cutouts(meds: Any, catalogue: Any, psfs: Any, galaxy: int, coadd: str, side: int, bits: int) -> list[Any]:
    """The cutouts of a galaxy that have good pixels, as observations of ngmix."""
    count = int(catalogue["ncutout"][galaxy])
    numbers = {"skip": range(1, count), "only": range(min(count, 1)), "absent": range(count)}[coadd]
    found = []
    for cutout in numbers:
        image = np.asarray(meds.get_cutout(galaxy, cutout))
        weight = np.array(meds.get_cutout(galaxy, cutout, type="weight"), dtype=np.float64)
        try:
            flags = np.asarray(meds.get_cutout(galaxy, cutout, type="bmask"))
        except (ValueError, OSError):
            flags = np.zeros(image.shape, dtype=np.int64)
        weight[(flags.astype(np.int64) & bits) != 0] = 0.0
        centre = _centre(catalogue, "", galaxy, cutout, image.shape)
        own = _jacobian(catalogue, galaxy, cutout, centre)
        observation = _resized(SimpleNamespace(image=image, weight=weight, jacobian=own, psf=None), side)
        if not (observation.weight > 0).any():
            # As cutouts at the edge of an exposure: absent, and not an error of the file.
            continue
        psf = _psf(meds, catalogue, psfs, galaxy, cutout, side)
        observation.psf = SimpleNamespace(
            image=psf,
            jacobian=_jacobian(
                catalogue,
                galaxy,
                cutout,
                _centre(catalogue, "psf_" if psfs is None else "none_", galaxy, cutout, psf.shape),
            ),
        )
        found.append(observation)
    return found


def _psf(meds: Any, catalogue: Any, psfs: Any, galaxy: int, cutout: int, side: int) -> NDArray[Any]:
    if psfs is None:
        return np.asarray(meds.get_psf(galaxy, cutout))
    from ._psf_models import one

    if not isinstance(psfs, (Sequence, Mapping)):
        model = psfs(meds, galaxy, cutout)
    else:
        number = int(catalogue["file_id"][galaxy, cutout])
        try:
            model = psfs[number]
        except (KeyError, IndexError):
            raise ValueError(f"psfs: none for file_id {number} (galaxy {galaxy}, cutout {cutout}); expected a model for each file") from None
    # The first pixel of an exposure is 0 in MEDS, and 1 for Piff, PSFEx and GalSim. Profiles and images need no place.
    names = catalogue.dtype.names or ()
    x, y = (float(catalogue[name][galaxy, cutout]) + 1.0 if name in names else np.nan for name in ("orig_col", "orig_row"))
    matrix = np.array([[float(catalogue[f"d{of}d{along}"][galaxy, cutout]) for along in ("col", "row")] for of in "uv"])
    try:
        return one(model, side, x, y, matrix)
    except (TypeError, ValueError) as error:
        raise type(error)(f"psfs: galaxy {galaxy}, cutout {cutout}: {error}") from None
