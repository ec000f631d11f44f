"""Images of FITS files and of astropy, with the pixels that their headers state."""

from __future__ import annotations

import os
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from . import _galsim, _shearq
from ._arrays import shown
from ._warn import DataWarning, warn


class Hdu(Protocol):
    """An image HDU of astropy."""

    @property
    def data(self) -> Any: ...
    @property
    def header(self) -> Any: ...


def _is_hdu(value: Any) -> bool:
    return hasattr(value, "header") and hasattr(value, "data") and hasattr(value.header, "cards")


# What opens the models of PSFs that FITS files contain, by cards of their headers.
_MODELS = {b"EXTNAME = 'PSF_DATA'": "galsim.des.DES_PSFEx", b"EXTNAME = 'psf     '": "piff.PSF.read"}
# Bytes in which these cards are: some headers without data before them.
_HEADERS = 1 << 16


def _of_model(path: str) -> str:
    """The remedy for a file with a model of the PSF; empty for others."""
    try:
        with open(path, "rb") as file:
            start = file.read(_HEADERS)
    except OSError:
        return ""
    return next((f". Try: psf={opener}({path!r}), with x= and y=" for card, opener in _MODELS.items() if card in start), "")


# What a header states: arcseconds per pixel, pixels of a PSF along a pixel of the galaxies, electrons per unit, and the level of saturation.
_Size = tuple[float | None, float | None, float | None, float | None]
_NO_SIZE: _Size = (None, None, None, None)
Detector = tuple[float | None, float | None]
NO_DETECTOR: Detector = (None, None)


def _opened(name: str, value: Any, has_wcs: bool) -> tuple[Any, NDArray[np.float64] | None, _Size]:
    """The pixels of a path or HDU, and the Jacobians of its images and the size of their pixels; anything else as it is, without."""
    if isinstance(value, (str, os.PathLike)):
        try:
            pixels, matrices, fault, size, messages = _shearq.read_images(os.fspath(value), name == "psf")
        except ValueError as error:
            raise ValueError(f"{name}: {error}{_of_model(os.fspath(value)) if name == 'psf' else ''}") from None
    elif _is_hdu(value):
        pixels = value.data
        if pixels is None or np.ndim(pixels) not in (2, 3):
            found = "no pixels" if pixels is None else f"an array of shape {shown(np.shape(pixels))}"
            raise ValueError(f"{name}: found an HDU with {found}; expected (ny, nx) or (n, ny, nx)")
        if "BSOFTEN" in value.header:
            raise ValueError(f"{name}: found asinh magnitudes (BSOFTEN); expected fluxes. Try: the path of the file, whose pixels are converted")
        cards = {card.keyword: f"'{card.value}'" if isinstance(card.value, str) else str(card.value) for card in value.header.cards if card.keyword}
        rows, columns = np.shape(pixels)[-2:]
        planes = len(pixels) if pixels.ndim == 3 else 1
        matrix, fault, size, messages = _shearq.header_pixels(cards, columns, rows, planes)
        matrices = None if matrix is None else np.array([matrix])
    else:
        return value, None, _NO_SIZE
    if fault is not None and name == "stamps" and not has_wcs:
        raise ValueError(f"{name}: {fault}. Try: wcs=WCS(header) with x= and y=, or the array of pixels, for ellipticities along the pixel axes")
    for message in messages:
        warn(f"{name}: {message}", DataWarning)
    if name == "psf":
        pixels = pixels[0] if pixels.ndim == 3 and len(pixels) == 1 else pixels
    elif pixels.ndim == 2:
        pixels = pixels[np.newaxis]
    return pixels, matrices, size


def _scale(stamps: Any, wcs: Any) -> float | None:
    """The pixel scale of a given Jacobian, or of images of GalSim."""
    if wcs is None:
        images = _galsim._many(stamps, _galsim._is_image)
        return None if images is None else _galsim._common("stamps", images)
    matrix = np.asarray(wcs)
    if matrix.dtype.kind not in "fiu" or matrix.shape[-2:] != (2, 2):
        return None
    return float(np.sqrt(abs(np.linalg.det(matrix.reshape(-1, 2, 2)[0]))))


def opened(stamps: Any, psf: Any, wcs: Any, oversampling: int | None) -> tuple[Any, Any, Any, int | None, Detector]:
    """Stamps, PSFs and their WCS, of which paths and HDUs become arrays, and their headers the WCS and oversampling that are not given.

    Also what the header of the stamps states of the detector.
    """
    stamps, own, size = _opened("stamps", stamps, wcs is not None)
    psf, of_psf, psf_size = _opened("psf", psf, wcs is not None)
    stated, fault = None, None
    if psf_size != _NO_SIZE:
        stated, fault = _shearq.stated_oversampling(psf_size, (_scale(stamps, wcs) or size[0], None, None, None))
    if oversampling is None and stated is not None:
        oversampling = stated
        message = f"psf: has {stated} × {stated} pixels for a pixel of the galaxies, as OVERSAMP, PSF_SAMP or SAMPLING of its header states. psf_oversampling=1 ignores that"
        warn(message, DataWarning)
    is_fine = oversampling not in (None, 1)
    if fault is not None and not is_fine and (own is None or of_psf is None):
        warn(f"psf: {fault}", DataWarning)
    if own is not None:
        # Headers of finer pixels state another scale.
        if of_psf is not None and not is_fine:
            found = _shearq.pixel_difference(of_psf, own)
            if found is not None:
                raise ValueError(f"psf: {found}")
        # As `gather` has it: pixels along the axes of the sky need no Jacobians.
        if wcs is None and not _shearq.are_aligned(own):
            wcs = own[0] if len(own) == 1 else own
    return stamps, psf, wcs, oversampling, size[2:]
