"""Images and profiles of GalSim, on one grid of square pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from ._warn import DataWarning, warn
from ._wcs import jacobians

PixelOfPsf = Literal["included", "convolve"]
# Profiles that are made of images of stars or of pixels, so that they contain the pixel already.
_WITH_PIXEL = ("InterpolatedImage", "InterpolatedKImage", "Pixel")

# Shear of pixels, and difference of pixel scales, that is tolerated: shears have this error then.
SAME = 1e-4


class GalSimImage(Protocol):
    """A ``galsim.Image``."""

    @property
    def array(self) -> Any: ...
    @property
    def bounds(self) -> Any: ...


class GalSimProfile(Protocol):
    """A ``galsim.GSObject``."""

    def drawImage(self, *args: Any, **kwargs: Any) -> Any: ...


def _is_image(value: Any) -> bool:
    return hasattr(value, "bounds") and isinstance(getattr(value, "array", None), np.ndarray)


def _is_profile(value: Any) -> bool:
    return hasattr(value, "drawImage")


def _many(value: Any, kind: Any) -> list[Any] | None:
    """The objects of a kind that ``value`` is or lists; None if it is something else."""
    if kind(value):
        return [value]
    if isinstance(value, (list, tuple)) and value and any(map(kind, value)):
        return list(value)
    return None


def _parts(profile: Any) -> list[Any]:
    """A profile and all profiles of which it is a sum, convolution or transformation."""
    inner = list(getattr(profile, "obj_list", ()))
    inner += [getattr(profile, name) for name in ("original", "orig_obj") if hasattr(profile, name)]
    return [profile, *(part for one in inner for part in _parts(one))]


def drawn(profiles: list[Any], side: int, pixels: list[dict[str, Any]], pixel: PixelOfPsf | None) -> list[NDArray[np.float64]]:
    """PSFs of profiles on stamps of ``side`` pixels, each with its ``pixels`` as drawImage takes them."""
    for k, profile in enumerate(profiles):
        if not _is_profile(profile):
            raise TypeError(f"psf: number {k} is of type {type(profile).__name__}; expected profiles of GalSim")
    if pixel not in (None, "included", "convolve"):
        raise ValueError(f"pixel: found {pixel!r}; expected 'included' or 'convolve'")
    if pixel is None:
        kinds = {type(part).__name__ for profile in profiles for part in _parts(profile)}
        doubtful = sorted(kinds.intersection(_WITH_PIXEL))
        if doubtful:
            warn(
                f"psf: the profile has a part of type {', '.join(doubtful)}, which usually contains the pixel, and is convolved with the"
                " pixel (expected a profile without it). A pixel too many gives m of 0.016 at a FWHM of 3.4 px."
                " Try: pixel='included', or pixel='convolve' if it has none",
                DataWarning,
            )
    method = "no_pixel" if pixel == "included" else "auto"
    return [
        profile.drawImage(nx=side, ny=side, dtype=np.float64, method=method, **how).array
        for profile, how in zip(profiles, pixels)
    ]


def no_pixel(pixel: PixelOfPsf | None) -> None:
    """Refuses a statement about the pixel of a PSF that is no profile."""
    if pixel is not None:
        raise TypeError("pixel: found with PSFs that are no profiles of GalSim; expected none, because images contain the pixel")


def square_pixels(name: str, jacobian: tuple[float, float, float, float], remedy: str) -> float:
    """The scale of pixels with (du/dx, du/dy, dv/dx, dv/dy), which must be square and along the axes."""
    xx, xy, yx, yy = jacobian
    scale: float = abs(xx * yy - xy * yx) ** 0.5
    if xx > 0 and max(abs(xy), abs(yx), abs(yy - xx)) <= SAME * scale:
        return scale
    if xx * yy - xy * yx <= 0:
        kind = "flipped"
    elif abs(xx - yy) <= SAME * scale and abs(xy + yx) <= SAME * scale:
        kind = "rotated"
    else:
        kind = "sheared"
    raise ValueError(
        f"{name} has {kind} pixels: (du/dx, du/dy, dv/dx, dv/dy) is ({xx:.6g}, {xy:.6g}, {yx:.6g}, {yy:.6g});"
        f" expected (s, 0, 0, s). {remedy}"
    )


def _local(image: Any) -> Any:
    """The local WCS at the centre of an image; None if it has none."""
    wcs = getattr(image, "wcs", None)
    return None if wcs is None else wcs.local(image.true_center)


def _jacobian(name: str, k: int, image: Any) -> NDArray[np.float64]:
    """(∂u/∂x, ∂u/∂y), (∂v/∂x, ∂v/∂y) at the centre of an image."""
    local = _local(image)
    if local is None:
        raise ValueError(f"{name}: image {k} has no WCS; expected one, to measure on the sky")
    local = local.jacobian()
    return np.array([[local.dudx, local.dudy], [local.dvdx, local.dvdy]])


def _scale(image: Any, name: str) -> float | None:
    """The pixel scale of an image; None if it has no WCS."""
    if getattr(image, "wcs", None) is None:
        return None
    local = image.wcs.local(image.true_center).jacobian()
    remedy = "Try: measure(…, wcs=image.wcs), or from_galsim(…, wcs='ignore') for shears along the pixel axes"
    return square_pixels(name, (local.dudx, local.dudy, local.dvdx, local.dvdy), remedy)


def _array(name: str, images: list[Any]) -> NDArray[Any]:
    """The pixels of images of one shape."""
    for k, image in enumerate(images):
        if not (_is_image(image) or isinstance(image, np.ndarray)):
            raise TypeError(f"{name}: number {k} is of type {type(image).__name__}; expected images of GalSim")
    arrays = [image.array if _is_image(image) else image for image in images]
    shapes = {array.shape for array in arrays}
    if len(shapes) > 1:
        raise ValueError(f"{name}: found images of shapes {sorted(shapes)}; expected one shape")
    return np.stack(arrays)


def _common(name: str, images: list[Any]) -> float | None:
    """The pixel scale that images share."""
    scales = [_scale(image, f"{name}: image {k}") for k, image in enumerate(images) if _is_image(image)]
    known = [scale for scale in scales if scale is not None]
    if known and max(known) - min(known) > SAME * min(known):
        raise ValueError(f"{name}: found pixel scales from {min(known):.6g} to {max(known):.6g}; expected one scale")
    return known[0] if known else None


def from_galsim(
    images: GalSimImage | Sequence[GalSimImage],
    psf: GalSimImage | GalSimProfile | Sequence[GalSimImage] | Sequence[GalSimProfile],
    *,
    wcs: Literal["check", "ignore", "sky"] = "check",
    pixel: PixelOfPsf | None = None,
) -> dict[str, NDArray[Any]]:
    """Arguments of :func:`measure` for stamps and PSFs of GalSim.

    Parameters
    ----------
    images : galsim.Image or sequence of them
        Stamps of one shape.
    psf : galsim.Image, galsim.GSObject, or sequence of them
        One for all galaxies or one per galaxy. A profile is drawn on the pixels of the stamps, and convolved with
        them.
    wcs : {'check', 'ignore', 'sky'}
        ``'check'`` refuses pixels that are flipped, rotated or sheared, and PSF images of another scale. ``'ignore'``
        measures shears along the pixel axes. ``'sky'`` measures any pixels in the frame of the sky, by the WCS of each image, and
        refuses PSF images on other pixels.
    pixel : {'included', 'convolve'}, optional
        Whether profiles contain the pixel, as those do that are interpolated from images of stars (``InterpolatedImage``,
        PSFEx) or convolved with a ``Pixel``. By default they are convolved with it, with a warning for such profiles.

    Returns
    -------
    dict
        ``stamps`` of shape (n, ny, nx), ``psf`` of shape (py, px) or (n, py, px), and for the sky ``wcs`` of shape (n, 2, 2).

    Raises
    ------
    ValueError
        If pixels are not square and along the axes, or scales or shapes differ.
    TypeError
        If an object is of another type.

    Examples
    --------
    ``shearq.measure(**shearq.from_galsim(images, psf))``
    """
    if wcs not in ("check", "ignore", "sky"):
        raise ValueError(f"wcs: found {wcs!r}; expected 'check', 'ignore' or 'sky'")
    stamps = _many(images, _is_image)
    if stamps is None:
        raise TypeError(f"images: found {type(images).__name__}; expected images of GalSim")
    if wcs == "sky":
        matrices = np.array([_jacobian("images", k, image) for k, image in enumerate(stamps)])
        for k, image in enumerate(_many(psf, _is_image) or []):
            of_psf, of_stamps = _jacobian("psf", k, image), matrices[k] if k < len(matrices) else matrices[0]
            if np.abs(of_psf - of_stamps).max() > SAME * np.abs(of_stamps).max():
                raise ValueError(f"psf: image {k} has the Jacobian {of_psf.tolist()} and its stamp {of_stamps.tolist()}; expected one")
        return {**from_galsim(images, psf, wcs="ignore", pixel=pixel), "wcs": matrices}
    pixels = _array("stamps", stamps)
    scale = _common("stamps", stamps) if wcs == "check" else None
    profiles = _many(psf, _is_profile)
    if profiles is not None:
        side = pixels.shape[-1]
        # Every profile on the pixels of its stamp, and one for all on those of each if they differ.
        shared = len(profiles) == 1 and len({repr(_local(image)) for image in stamps}) > 1
        profiles = profiles * len(stamps) if shared else profiles
        places = stamps if len(profiles) == len(stamps) else stamps[:1]
        local = [_local(places[k if len(places) > 1 else 0]) for k in range(len(profiles))]
        pixels_of = [{"scale": 1.0} if one is None else {"wcs": one} for one in local]
        found = drawn(profiles, side, pixels_of, pixel)
        return {"stamps": pixels, "psf": found[0] if _is_profile(psf) and not shared else np.stack(found)}
    no_pixel(pixel)
    stars = _many(psf, _is_image)
    if stars is None:
        return {"stamps": pixels, "psf": np.asarray(psf)}
    own = _common("psf", stars) if wcs == "check" else None
    if scale is not None and own is not None and abs(own - scale) > SAME * scale:
        raise ValueError(f"psf: found a pixel scale of {own:.6g} and stamps of {scale:.6g}; expected one scale")
    return {"stamps": pixels, "psf": stars[0].array if _is_image(psf) else _array("psf", stars)}


def _on_wcs(profiles: list[Any], stamps: Any, wcs: Any, x: Any, y: Any, pixel: PixelOfPsf | None) -> tuple[Any, NDArray[np.float64]]:
    """Stamps, and PSFs of profiles on their pixels, which a WCS states."""
    import galsim

    images = _many(stamps, _is_image)
    pixels = stamps if images is None else _array("stamps", images)
    count = len(pixels)
    if count == 0:
        raise ValueError("stamps: found none; expected one or more")
    side = np.shape(pixels[0])[-1]
    if len(profiles) not in (1, count):
        raise ValueError(f"psf: found {len(profiles)} profiles; expected one, or {count}, one for each stamp")
    local = [{"wcs": galsim.JacobianWCS(*matrix.ravel())} for matrix in jacobians(wcs, count, x, y, side)]
    n = max(len(profiles), len(local))
    profiles, local = (own * n if len(own) == 1 else own for own in (profiles, local))
    found = drawn(profiles, side, local, pixel)
    return pixels, found[0] if n == 1 else np.stack(found)


def unpacked(
    stamps: Any, psf: Any, *, check: bool, pixel: PixelOfPsf | None = None, wcs: Any = None, x: Any = None, y: Any = None
) -> tuple[Any, Any]:
    """Stamps and PSFs, of which GalSim's become arrays; with ``check``, pixels are square and along the axes."""
    profiles = _many(psf, _is_profile)
    if profiles is not None and wcs is not None:
        return _on_wcs(profiles, stamps, wcs, x, y, pixel)
    if _many(stamps, _is_image) is not None:
        if hasattr(psf, "fwhm") and not _is_profile(psf):
            # Formulas in pixels.
            no_pixel(pixel)
            images = _many(stamps, _is_image) or []
            if check:
                _common("stamps", images)
            return _array("stamps", images), psf
        found = from_galsim(stamps, psf, wcs="check" if check else "ignore", pixel=pixel)
        return found["stamps"], found["psf"]
    if profiles is not None:
        raise TypeError(
            "psf: found a profile of GalSim with stamps that have no WCS; expected one."
            " Try: wcs=np.diag([SCALE, SCALE]), or psf.drawImage(nx=48, ny=48, scale=SCALE), with the pixel scale of the stamps"
        )
    no_pixel(pixel)
    stars = _many(psf, _is_image)
    if stars is not None:
        if check:
            _common("psf", stars)
        psf = stars[0].array if _is_image(psf) else _array("psf", stars)
    return stamps, psf
