"""Draws a model of Piff for ``shearq gather --psf``: places on standard input, pixels on standard output.

``python3 -m shearq._drawn_psfs FILE CHIP CHIPS SIDE [SCALE]`` reads a line ``x y`` for each galaxy, and then writes SIDE × SIDE numbers of
32 bits for each, the lowest byte first. SCALE is that of the image of the galaxies, in arcsec per pixel.
"""

from __future__ import annotations

import sys
from typing import Any, BinaryIO

import numpy as np

# Packages that models need and PyPI has not: the WCS of DES.
_SOURCES = {"pixmappy": "git+https://github.com/gbernstein/pixmappy"}
# Galaxies that are drawn at a time.
_BLOCK = 64


def _properties(psf: Any, chip: int, chips: int) -> dict[str, int]:
    """The chip, of a model with several."""
    own = list(psf.wcs)
    if len(own) == 1:
        return {}
    if len(own) != chips:
        raise ValueError(f"the model has {len(own)} chips and there are {chips} exposures; expected as many")
    return {"chipnum": own[chip]}


# Relative difference of pixel scales, above which they are those of different images: distortions are smaller. Chosen by hand.
_SCALE_DIFFERENCE = 0.1


def _check_scale(wcs: Any, place: Any, scale: float) -> None:
    import galsim

    # Others have no unit.
    if wcs.isCelestial():
        own = float(np.sqrt(wcs.pixelArea(image_pos=galsim.PositionD(*place))))
        if abs(own / scale - 1) > _SCALE_DIFFERENCE:
            raise ValueError(f"the model has pixels of {own:.4g} arcsec, and the image of the galaxies of {scale:.4g} arcsec; expected the same")


def draw(path: str, chip: int, chips: int, side: int, places: str, out: BinaryIO, scale: float | None = None) -> None:
    import piff

    from ._psf_models import PsfsOfModel, of_piff

    psf = piff.PSF.read(path)
    at = np.array([line.split() for line in places.splitlines()], dtype=np.float64)
    properties = _properties(psf, chip, chips)
    if scale is not None:
        _check_scale(psf.wcs[properties.get("chipnum", next(iter(psf.wcs)))], at[0], scale)
    drawn = PsfsOfModel(of_piff(psf), side, at, None, properties)
    for first in range(0, len(at), _BLOCK):
        out.write(np.ascontiguousarray(drawn[slice(first, first + _BLOCK)], dtype="<f4").tobytes())


def main() -> int:
    path, *words = sys.argv[1:]
    try:
        chip, chips, side = map(int, words[:3])
        scale = float(words[3]) if words[3:] else None
        draw(path, chip, chips, side, sys.stdin.read(), sys.stdout.buffer, scale)
    except ImportError as error:
        package = error.name or "piff"
        print(f"error: {path}: {error}. Try: {sys.executable} -m pip install {_SOURCES.get(package, package)}", file=sys.stderr)
        return 1
    except Exception as error:
        print(f"error: {path}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
