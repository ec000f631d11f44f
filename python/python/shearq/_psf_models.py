"""Models of a PSF that varies over an image, drawn at the galaxies."""

from __future__ import annotations

import collections
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _shearq
from ._arrays import double, shown
from ._galsim import PixelOfPsf, _is_image, _is_profile, drawn, no_pixel
from ._warn import DataWarning, warn
from ._wcs import _local, jacobians

FINE_PROFILE = (
    "psf_oversampling: found with profiles of GalSim, which are drawn on the pixels of the stamps; expected images of PSFs on finer pixels."
    " Try: without psf_oversampling"
)

# What a model needs: the number of pixels on a side, x and y of the galaxy, the Jacobian of its pixels or None, and other
# properties of the galaxy.
_Draw = Callable[[int, float, float, Any, dict[str, Any]], Any]


def of_piff(psf: Any) -> _Draw:
    # Piff knows whether its model contains the pixel, and the WCS of the chip.
    return lambda side, x, y, _, properties: psf.draw(x=x, y=y, stamp_size=side, center=True, **properties).array


def _psfex(psf: Any) -> _Draw:
    import galsim

    def draw(side: int, x: float, y: float, _: Any, properties: dict[str, Any]) -> Any:
        place = galsim.PositionD(x, y)
        # Without a WCS of its own, a profile of PSFEx is in pixels. It contains the pixel.
        pixels = {"wcs": psf.wcs.local(place)} if psf.wcs else {"scale": 1.0}
        return psf.getPSF(place).drawImage(nx=side, ny=side, method="no_pixel", dtype=np.float64, **pixels).array

    return draw


def _point_of_rubin() -> Any:
    try:
        from lsst.geom import Point2D
    except ImportError:
        # Objects with the same methods outside Rubin's stack.
        return collections.namedtuple("Point2D", "x y")
    return Point2D


def _rubin(psf: Any) -> _Draw:
    point = _point_of_rubin()
    # Centred on a pixel, where computeImage would draw the phase of the galaxy.
    return lambda side, x, y, jacobian, properties: psf.computeKernelImage(point(x, y)).array


def _rubin_images(psf: Any) -> _Draw:
    # Of lsst.images, centred on a pixel, too.
    return lambda side, x, y, jacobian, properties: psf.compute_kernel_image(x=x, y=y).array


def _function(psf: Callable[..., Any], pixel: PixelOfPsf | None, fine: bool) -> _Draw:
    stated = [pixel]

    def draw(side: int, x: float, y: float, jacobian: Any, properties: dict[str, Any]) -> Any:
        found = psf(x, y, **properties)
        if not _is_profile(found):
            return found.array if hasattr(found, "bounds") else found
        if fine:
            raise ValueError(FINE_PROFILE)
        if jacobian is None:
            raise TypeError(
                "psf: the function returned a profile of GalSim, and the pixels have no WCS; expected one. Try: wcs=, or a function"
                " that returns an image"
            )
        import galsim

        local = galsim.JacobianWCS(*jacobian.ravel())
        image = drawn([found], side, [{"wcs": local}], stated[0])[0]
        # One warning is enough.
        stated[0] = stated[0] or "convolve"
        return image

    return draw


def _draw_of(psf: Any, pixel: PixelOfPsf | None = None, fine: bool = False) -> _Draw | None:
    """How a model is drawn; None for anything that is no model."""
    models = {
        ("interp_property_names", "draw"): of_piff,
        ("getPSF", "getPSFArray"): _psfex,
        ("computeKernelImage",): _rubin,
        ("compute_kernel_image",): _rubin_images,
    }
    for methods, drawer in models.items():
        if all(hasattr(psf, method) for method in methods):
            # These models know whether they contain the pixel.
            no_pixel(pixel)
            return drawer(psf)
    # An image of GalSim can be called, too.
    if callable(psf) and not (_is_profile(psf) or _is_image(psf) or isinstance(psf, type)):
        return _function(psf, pixel, fine)
    return None


def _own_wcs(psf: Any, properties: Mapping[str, Any]) -> tuple[Any, str]:
    """The WCS that a model of Piff or PSFEx has, and how to write it; None for others."""
    wcs = getattr(psf, "wcs", None)
    if not isinstance(wcs, Mapping):
        return (wcs, "psf.wcs") if hasattr(wcs, "isUniform") else (None, "")
    chips = list(wcs)
    chip = np.ravel(properties["chipnum"])[0] if "chipnum" in properties else chips[0] if chips else None
    return wcs.get(chip), f"psf.wcs[{chip}]"


# Distance from the stars of a model in units of their range, from which galaxies are not on its chip. Chosen by hand: a few stars seldom
# reach the borders of their chip.
MAX_EXTRAPOLATION = 1.0


def _range_of_stars(psf: Any) -> NDArray[np.float64] | None:
    """The least and largest x and y of the stars of a model of Piff or PSFEx; None if it does not state them."""
    stars = [star.image_pos for star in getattr(psf, "stars", None) or () if hasattr(star, "image_pos")]
    if len(stars) > 1:
        at = np.array([(star.x, star.y) for star in stars])
        return np.stack([at.min(axis=0), at.max(axis=0)])
    if all(hasattr(psf, name) for name in ("x_zero", "y_zero", "x_scale", "y_scale")):
        # POLZERO is the middle of the range, and POLSCAL its width.
        middle, width = np.array([psf.x_zero, psf.y_zero]), np.array([psf.x_scale, psf.y_scale])
        return np.stack([middle - width / 2, middle + width / 2])
    return None


def _doubts(psf: Any, places: NDArray[np.float64], wcs: Any, properties: Mapping[str, Any], what: tuple[str, str] = ("galaxies", "galaxy")) -> None:
    """Warns of places that are not on the chip of a model, and of pixels whose WCS the model has and the call has not."""
    stars = _range_of_stars(psf)
    if stars is not None:
        margin = MAX_EXTRAPOLATION * (stars[1] - stars[0])
        outside = ((places < stars[0] - margin) | (places > stars[1] + margin)).any(axis=1)
        if outside.any():
            k = int(outside.argmax())
            (x0, y0), (x1, y1) = stars
            warn(
                f"psf: {int(outside.sum())} of {len(places)} {what[0]} are far from the stars of the model: {what[1]} {k} is at x = {places[k, 0]:.6g},"
                f" y = {places[k, 1]:.6g} (expected x from {x0:.6g} to {x1:.6g} and y from {y0:.6g} to {y1:.6g}, about)."
                " Try: x=, y=, in pixels of the exposure to which the model was fitted",
                DataWarning,
            )
    own, name = _own_wcs(psf, properties)
    if wcs is None and own is not None:
        matrix = np.array(_local(own, None if own.isUniform() else places[0]))
        if not _shearq.are_aligned(matrix[np.newaxis]):
            warn(
                f"psf: the model has a WCS whose pixels are rotated, mirrored or sheared, and none is given, so that shapes are in the frame"
                f" of the pixels. Try: wcs={name} for shapes on the sky, or wcs=np.eye(2) if this frame is meant",
                DataWarning,
            )


class PsfsOfModel:
    """The PSFs of a model at galaxies as an array of shape (n, py, px) that is drawn when its rows are read."""

    ndim = 3
    dtype = np.dtype(np.float64)

    def __init__(self, draw: _Draw, side: int, places: NDArray[np.float64], matrices: Any, properties: Mapping[str, Any]) -> None:
        self._draw, self._side, self._places = draw, side, places
        self._matrices, self._properties = matrices, properties
        # The size is the model's own for Rubin's and for images of functions.
        self._first: NDArray[np.float64] | None = None
        self._first = self._one(0)
        self.shape = (len(places), *self._first.shape)

    def _one(self, k: int) -> NDArray[np.float64]:
        # Drawn for its shape.
        if k == 0 and self._first is not None:
            return self._first
        properties = {name: value if np.ndim(value) == 0 else value[k] for name, value in self._properties.items()}
        matrix = None if self._matrices is None else self._matrices[k if len(self._matrices) > 1 else 0]
        x, y = map(float, self._places[k])
        try:
            found = np.asarray(self._draw(self._side, x, y, matrix, properties), dtype=np.float64)
        except Exception as error:
            raise ValueError(f"psf: the model has no PSF at x = {x:.6g}, y = {y:.6g} (galaxy {k}): {error}") from error
        if found.ndim != 2:
            raise ValueError(f"psf: the model returned an array of shape {shown(found.shape)}; expected (py, px)")
        return found

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, rows: slice) -> NDArray[np.float64]:
        drawn = [self._one(k) for k in range(*rows.indices(len(self)))]
        for k, one in enumerate(drawn):
            if one.shape != self.shape[1:]:
                raise ValueError(
                    f"psf: the model returned images of shapes {shown(self.shape[1:])} and {shown(one.shape)} (galaxy {k}); expected one shape"
                )
        return np.stack(drawn) if drawn else np.empty((0, *self.shape[1:]))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[:], dtype=dtype)


def at_galaxies(
    psf: Any,
    stamps: Any,
    x: Any,
    y: Any,
    wcs: Any,
    properties: Mapping[str, ArrayLike] | None,
    pixel: PixelOfPsf | None = None,
    fine: bool = False,
) -> Any:
    """The PSFs of a model at the galaxies, whose images may have ``fine`` pixels; anything else as it is."""
    draw = _draw_of(psf, pixel, fine)
    if draw is None:
        if properties is not None:
            raise TypeError(f"properties: found with a PSF of type {type(psf).__name__}; expected a model of Piff, or a function")
        return psf
    if _is_image(stamps):
        stamps = [stamps]
    count = len(stamps)
    if count == 0:
        raise ValueError("stamps: found none; expected one or more")
    side = np.shape(stamps[0].array if _is_image(stamps[0]) else stamps[0])[-1]
    if x is None or y is None:
        raise ValueError("psf: found a model, and no places of the galaxies. Try: x=, y=, in pixels of the image from which the stamps were cut")
    places = []
    for name, value in (("x", x), ("y", y)):
        column = double(name, value)
        if column.shape != (count,):
            raise ValueError(f"{name}: found an array of shape {shown(column.shape)}; expected ({count},), one for each stamp")
        places.append(column)
    given = dict(properties or {})
    for name, value in given.items():
        if np.ndim(value) and len(value) != count:  # type: ignore[arg-type]
            raise ValueError(f"properties: {name} has {len(value)} values; expected one, or {count}")  # type: ignore[arg-type]
    matrices = None if wcs is None else jacobians(wcs, count, x, y)
    at = np.stack(places, axis=-1)
    _doubts(psf, at, wcs, given)
    return PsfsOfModel(draw, side, at, matrices, given)


def one(model: Any, side: int, x: float, y: float, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The PSF of a model, profile or image at one place, on pixels with a Jacobian."""
    if _is_profile(model):
        import galsim

        return drawn([model], side, [{"wcs": galsim.JacobianWCS(*matrix.ravel())}], None)[0]
    image = np.asarray(model.array if _is_image(model) else model)
    if image.ndim == 2 and image.dtype.kind in "fiu":
        return image
    draw = _draw_of(model)
    if draw is None:
        found = f"an array of shape {shown(image.shape)}" if image.ndim else type(model).__name__
        raise TypeError(
            f"psf: found {found}; expected an image of shape (py, px), a profile of GalSim, a model of Piff, PSFEx or Rubin, or a"
            " function of (x, y)"
        )
    return PsfsOfModel(draw, side, np.array([[x, y]]), matrix[np.newaxis], {})._one(0)
