"""Arguments into arrays of known types and shapes. Errors name the argument."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_THREADS = 1024
# Longest vector whose numbers are columns; longer ones are stamps.
MAX_VECTOR = 8


def shown(shape: tuple[int, ...]) -> str:
    """A shape as it is told."""
    return "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"


def _shapes(value: Any) -> list[tuple[int, ...]]:
    """The first shapes of a sequence of arrays."""
    found: list[tuple[int, ...]] = []
    for one in value if isinstance(value, (list, tuple)) else ():
        try:
            shape = np.shape(one)
        except ValueError:
            return []
        if shape not in found and len(found) < 4:
            found.append(shape)
    return found


def numeric(name: str, value: Any) -> NDArray[Any]:
    """An array of real numbers: ``value`` itself where it is one, of whatever strides and order of bytes."""
    if isinstance(value, np.ma.MaskedArray):
        if np.ma.is_masked(value):
            raise ValueError(f"{name}: found masked values; expected none. Only stamps may have masked pixels")
        value = value.data
    if not isinstance(value, np.ndarray):
        try:
            value = np.asarray(value)
        except (TypeError, ValueError, OverflowError) as error:
            shapes = _shapes(value)
            if len(shapes) > 1:
                raise ValueError(f"{name}: found arrays of shapes {', '.join(map(shown, shapes))}; expected one shape") from None
            raise ValueError(f"{name}: no array can be made of it: {error}") from None
    if value.dtype.kind not in "fiu":
        raise TypeError(f"{name}: found numbers of type {value.dtype}; expected real ones")
    if value.dtype.kind == "f" and value.dtype.itemsize > 8:
        # Longer numbers than Rust has.
        value = value.astype(np.float64)
    return np.asarray(value)


def with_missing(name: str, value: Any, mask: Any) -> Any:
    """``value`` with NaN for its masked pixels and for those that ``mask`` marks; itself if there are none."""
    if isinstance(value, (list, tuple)) and any(isinstance(one, np.ma.MaskedArray) for one in value):
        value = np.ma.stack(value)
    missing = np.ma.getmaskarray(value) if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value) else None
    if isinstance(value, np.ma.MaskedArray):
        value = value.data
    if mask is not None:
        given = np.asarray(mask)
        if given.dtype != bool:
            raise TypeError(f"mask: found values of type {given.dtype}; expected booleans, True for missing pixels")
        value = numeric(name, value)
        if given.shape not in (value.shape, value.shape[1:]):
            raise ValueError(f"mask: found an array of shape {shown(given.shape)}; expected {shown(value.shape)}, as the stamps have")
        missing = given if missing is None else missing | given
    if missing is None:
        return value
    single = value.dtype.itemsize < 4 or value.dtype.kind == "f" and value.dtype.itemsize == 4
    filled = value.astype(np.float32 if single else np.float64)
    filled[np.broadcast_to(missing, filled.shape)] = np.nan
    return filled


# Missing pixels in survey images, as SExtractor writes them; in double precision, too, and rounded to single before.
_MISSING_PIXELS = (-1e30, float(np.float32(-1e30)))
# Stamps tested at once, which bounds the memory of the comparison.
_TESTED = 256


def without_sentinels(value: NDArray[Any]) -> NDArray[Any]:
    """An array with NaN for pixels of −1e30, as files are read; the array itself if there are none."""
    if value.dtype.kind != "f" or value.dtype.itemsize < 4:
        return value
    missing = _MISSING_PIXELS[1:] if value.dtype.itemsize == 4 else _MISSING_PIXELS
    size = _TESTED if value.ndim == 3 else max(len(value), 1)
    parts = (value[start : start + size] for start in range(0, len(value), size))
    if not any((part == pixel).any() for part in parts for pixel in missing):
        return value
    return np.where(np.isin(value, missing), value.dtype.type(np.nan), value)


def shaped(name: str, value: Any, expected: str, *, axes: int) -> NDArray[Any]:
    """The same with so many axes, which ``expected`` describes."""
    array = numeric(name, value)
    if array.ndim != axes:
        raise ValueError(f"{name}: found an array of shape {shown(array.shape)}; expected {expected}")
    return array


def double(name: str, value: Any) -> NDArray[np.float64]:
    """A copy in double precision where it is not, in C order."""
    return np.ascontiguousarray(numeric(name, value), dtype=np.float64)


def flat(name: str, value: Any) -> NDArray[np.float64]:
    """The same without its shape."""
    return double(name, value).reshape(-1)


def real(name: str, value: Any, expected: str, *, least: float = -np.inf, most: float = np.inf) -> float:
    """One finite number within a range."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise TypeError(f"{name}: found {type(value).__name__}; expected {expected}") from None
    if not (np.isfinite(number) and least <= number <= most):
        raise ValueError(f"{name}: found {number}; expected {expected}")
    return number


def degrees(value: Any) -> float:
    """The side of a field in degrees: beyond the whole sky multipoles are no numbers to bin by."""
    return real("field_degrees", value, "a positive number, at most 360", least=1e-9, most=360.0)


def whole(name: str, value: Any, least: int, most: int) -> int:
    """One whole number within a range."""
    try:
        number = operator.index(value)
    except TypeError:
        raise TypeError(
            f"{name}: found {type(value).__name__}; expected a whole number from {least} to {most}"
        ) from None
    if not least <= number <= most:
        raise ValueError(f"{name}: found {number}; expected a whole number from {least} to {most}")
    return number


def callback(value: Any) -> Any:
    """Something to call with the number of galaxies done since the last call."""
    if value is not None and not callable(value):
        raise TypeError(
            f"progress: found {type(value).__name__}; expected a function of the number of galaxies, as tqdm's update"
        )
    return value
