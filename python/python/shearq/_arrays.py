"""Arguments into arrays of known types and shapes. What does not fit is told by the argument's name."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np

MAX_THREADS = 1024


def shown(shape: tuple[int, ...]) -> str:
    """A shape as it is told."""
    return "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"


def numeric(name: str, value: Any) -> np.ndarray:
    """An array of real numbers: ``value`` itself where it is one, of whatever strides and order of bytes."""
    array = getattr(value, "array", None)
    if isinstance(array, np.ndarray) and hasattr(value, "bounds"):
        # A GalSim image.
        value = array
    if isinstance(value, np.ma.MaskedArray):
        if np.ma.is_masked(value):
            raise ValueError(f"{name}: an array with masked values; expected one without, as from .filled()")
        value = value.data
    if not isinstance(value, np.ndarray):
        if isinstance(value, (list, tuple)):
            value = [v.array if hasattr(v, "bounds") and hasattr(v, "array") else v for v in value]
        try:
            value = np.asarray(value)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{name}: no array can be made of it: {error}") from None
    if value.dtype.kind not in "fiu":
        raise TypeError(f"{name}: found numbers of type {value.dtype}; expected real ones")
    if value.dtype.kind == "f" and value.dtype.itemsize > 8:
        # Longer numbers than Rust has.
        value = value.astype(np.float64)
    return np.asarray(value)


def shaped(name: str, value: Any, expected: str, *, axes: int) -> np.ndarray:
    """The same with so many axes, which ``expected`` describes."""
    array = numeric(name, value)
    if array.ndim != axes:
        raise ValueError(f"{name}: found an array of shape {shown(array.shape)}; expected {expected}")
    return array


def double(name: str, value: Any) -> np.ndarray:
    """A copy in double precision where it is not, in C order."""
    return np.ascontiguousarray(numeric(name, value), dtype=np.float64)


def flat(name: str, value: Any) -> np.ndarray:
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


def thread_count(value: int | None) -> int | None:
    """A number of threads, or none asked for."""
    return None if value is None else whole("threads", value, 1, MAX_THREADS)


def callback(value: Any) -> Any:
    """Something to call with the number of galaxies done since the last call."""
    if value is not None and not callable(value):
        raise TypeError(
            f"progress: found {type(value).__name__}; expected a function of the number of galaxies, as tqdm's update"
        )
    return value
