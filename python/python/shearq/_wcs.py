"""World coordinate systems into Jacobians of stamps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._arrays import double, numeric, shown

# Half of the distance in pixels over which astropy's coordinates are differentiated.
_HALF_STEP = 0.5
_EQUATORIAL = ("pos.eq.ra", "pos.eq.dec")
_ARCSEC = 180.0 * 3600.0 / np.pi


class GalSimWcs(Protocol):
    """A ``galsim.BaseWCS``."""

    def jacobian(self, *args: Any, **kwargs: Any) -> Any: ...
    def isUniform(self) -> bool: ...


class AstropyWcs(Protocol):
    """An ``astropy.wcs.WCS``, or another one with the interface of APE 14."""

    def pixel_to_world_values(self, *args: Any) -> Any: ...


WcsLike = Union[ArrayLike, GalSimWcs, AstropyWcs, Sequence[GalSimWcs]]
"""Jacobians of shape (2, 2) or (n, 2, 2), a WCS of astropy, or one of GalSim or one for each stamp."""


def _is_galsim(wcs: Any) -> bool:
    return hasattr(wcs, "isUniform") and hasattr(wcs, "jacobian")


def jacobians(wcs: Any, count: int, x: Any, y: Any, side: int | None = None) -> NDArray[np.float64]:
    """The matrices (∂u/∂x, ∂u/∂y), (∂v/∂x, ∂v/∂y) of ``count`` stamps at x, y, of shape (1, 2, 2) or (count, 2, 2).

    A WCS of astropy whose image has ``side`` × ``side`` pixels is that of the stamps themselves, and is used in their middle.
    """
    many = isinstance(wcs, (list, tuple)) and bool(wcs) and all(map(_is_galsim, wcs))
    if _is_galsim(wcs) or many:
        each = list(wcs) if many else [wcs]
        if len(each) not in (1, count):
            raise ValueError(f"wcs: found {len(each)}; expected one, or {count}, one for each stamp")
        if all(one.isUniform() for one in each):
            return np.array([_local(one) for one in each])
        places = _places(count, x, y)
        each = each * count if len(each) == 1 else each
        return np.array([_local(one, place) for one, place in zip(each, places)]).reshape(-1, 2, 2)
    if hasattr(wcs, "pixel_to_world_values"):
        if x is None and y is None and side is not None and tuple(getattr(wcs, "pixel_shape", None) or ())[:2] == (side, side):
            return _on_sphere(wcs, np.full((1, 2), (side - 1) / 2))
        return _on_sphere(wcs, _places(count, x, y))
    matrices = double("wcs", numeric("wcs", wcs))
    if matrices.shape not in ((2, 2), (count, 2, 2)):
        raise ValueError(
            f"wcs: found an array of shape {shown(matrices.shape)}; expected (2, 2), or ({count}, 2, 2), one for each stamp"
        )
    return matrices.reshape(-1, 2, 2)


def _places(count: int, x: Any, y: Any) -> NDArray[np.float64]:
    if x is None or y is None:
        raise ValueError("wcs: its Jacobian varies over the image, and there are no places. Try: x=, y=, one of each for each stamp")
    columns = [double(name, value) for name, value in (("x", x), ("y", y))]
    for name, column in zip("xy", columns):
        if column.shape != (count,):
            raise ValueError(f"{name}: found an array of shape {shown(column.shape)}; expected ({count},), one for each stamp")
    return np.stack(columns, axis=-1)


def _local(wcs: Any, place: Any = None) -> list[list[float]]:
    """The Jacobian of a WCS of GalSim, whose (u, v) are to the west and north for celestial coordinates."""
    if place is None:
        local = wcs.jacobian()
    else:
        import galsim

        local = wcs.jacobian(image_pos=galsim.PositionD(*place))
    return [[local.dudx, local.dudy], [local.dvdx, local.dvdy]]


def _on_sphere(wcs: Any, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Jacobians of a celestial WCS from the directions of places on both sides along x and y."""
    if hasattr(wcs, "celestial"):
        if not wcs.has_celestial:
            raise ValueError("wcs: found no celestial axes; expected right ascension and declination")
        wcs = wcs.celestial
    # Declination may come first. Without types, as of own objects, right ascension does.
    types = list(getattr(wcs, "world_axis_physical_types", None) or _EQUATORIAL)
    if sorted(map(str, types)) != sorted(_EQUATORIAL):
        raise ValueError(f"wcs: found the axes {', '.join(map(str, types))}; expected right ascension and declination")
    order = [types.index(own) for own in _EQUATORIAL]

    def directions(offset: tuple[float, float]) -> tuple[Any, Any, NDArray[np.float64]]:
        values = wcs.pixel_to_world_values(places[:, 0] + offset[0], places[:, 1] + offset[1])
        lon, lat = (np.radians(values[k]) for k in order)
        return lon, lat, np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)

    lon, lat, _ = directions((0.0, 0.0))
    west = np.stack([np.sin(lon), -np.cos(lon), np.zeros_like(lon)], axis=-1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=-1)
    columns = []
    for along in ((_HALF_STEP, 0.0), (0.0, _HALF_STEP)):
        step = directions(along)[2] - directions((-along[0], -along[1]))[2]
        step *= _ARCSEC / (2.0 * _HALF_STEP)
        columns.append(np.stack([(step * west).sum(axis=-1), (step * north).sum(axis=-1)], axis=-1))
    return np.stack(columns, axis=-1)
