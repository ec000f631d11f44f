"""The columns and metadata of catalogues: one schema for arrays, tables and files (docs/files.md)."""

from __future__ import annotations

import hashlib
import re
from typing import Any

# The bit of ``flags`` of a galaxy whose ellipticity is missing.
NOT_FINITE = 1
# Whole numbers; the other columns of the schema are reals.
WHOLE = ("flags", "iterations", "stop", "updated")
# What the mean shear follows from.
NEEDED = ("e1", "e2", "flags", "R11", "R22")
REAL: tuple[str, ...] = ("x", "y", "e1", "e2", "first_energy", "energy", "noise", "flux", "radius", "size", "R11", "R22", "R12", "R21")
# What linear configurations add: S/N, and how flux and size change with shear and noise (docs/files.md).
OBSERVED: tuple[str, ...] = ("flux_error", "flux_g1", "flux_g2", "size_g1", "size_g2")
OBSERVED += tuple(f"n{k}_{pair}" for k in "12" for pair in ("ef", "es", "ff", "fs", "ss"))
OBSERVED += tuple(f"t_{pair}" for pair in ("e1f", "e1s", "e2f", "e2s", "ff", "fs", "ss", "s"))
OBSERVED += ("ring", "ring_g1", "ring_g2")
OBSERVED += tuple(f"n{k}_{pair}" for k in "12" for pair in ("er", "fr", "sr", "rr"))
OBSERVED += tuple(f"t_{pair}" for pair in ("e1r", "e2r", "fr", "sr", "rr"))
# The star that all galaxies of an image share, and what its noise does to m and c.
STAR: tuple[str, ...] = ("psf_id", "psf_m", "psf_c")
REAL += ("psf_e1", "psf_e2", "psf_sigma", "snr", "neighbour", *OBSERVED, *STAR)
# What a selection reads.
SELECTED = ("e1", "e2", "flags", "R11", "R22", "R12", "R21", "flux", "size", *OBSERVED)
UNITS = {"x": "pix", "y": "pix", "radius": "pix", "psf_sigma": "pix"}

# Keys of files, and the names of ``attrs``.
KEYS = {"submiss": "submission", "elltype": "ellipticity", "settings": "settings", "creator": "version"}
# Keys of the command line's files that are kept as they are.
OTHER_KEYS = ("set", "image", "warnings", "frame", "response")
# Value of ``response`` of ellipticities that are still to be divided by it.
NOT_APPLIED = "not applied"
# The keys of the command line's files for the noise of a star, and for its fingerprint.
STAR_KEY, PSF_KEY = "psfnoise", "psf"
_CREATOR = "shearq "
_ESCAPED = re.compile(r"\\(?:([nrt\\])|u\{([0-9a-fA-F]{1,6})\})")
_PLAIN = {"n": "\n", "r": "\r", "t": "\t", "\\": "\\"}


def star_number(name: bytes) -> float:
    """A whole number below 2^48 that distinguishes a star from others."""
    return float(int.from_bytes(hashlib.sha256(name).digest()[:6], "big"))


def to_keys(attrs: dict[str, Any]) -> dict[str, str]:
    """``attrs`` by the keys of files."""
    names = {name: key for key, name in KEYS.items()}
    found = {names.get(name, name): str(value) for name, value in attrs.items()}
    if "creator" in found:
        found["creator"] = _CREATOR + found["creator"]
    return found


def to_attrs(metadata: Any) -> dict[str, Any]:
    """``attrs`` from metadata by the keys of files, in any case, or by their own names."""
    found: dict[str, Any] = {}
    for key, value in dict(metadata).items():
        name = KEYS.get(str(key).lower(), str(key).lower())
        if name not in KEYS.values() and name not in OTHER_KEYS:
            continue
        if name == "settings" and isinstance(value, str) and "\n" not in value:
            value = _ESCAPED.sub(lambda m: _PLAIN[m[1]] if m[1] else chr(int(m[2], 16)), value)
        found[name] = value.removeprefix(_CREATOR) if name == "version" and isinstance(value, str) else value
    return found


def in_header(text: str) -> str:
    """A text in the characters that a FITS header may have, as the command line writes it."""
    known = {plain: "\\" + name for name, plain in _PLAIN.items()}
    return "".join(known.get(c) or (c if " " <= c <= "~" else f"\\u{{{ord(c):x}}}") for c in text)
