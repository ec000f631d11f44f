"""Measure stamps and PSFs into catalogues of ellipticities and their responses to shear."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _galsim, _images, _psf_models, _schema, _shearq
from ._arrays import callback, double, numeric, real, shaped, shown, whole, with_missing, without_sentinels
from ._catalogue import Catalogue
from ._galsim import GalSimImage, GalSimProfile, PixelOfPsf
from ._images import Hdu
from ._submissions import Configuration, SubmissionLike, submission as resolve
from ._threads import thread_count
from ._warn import DataWarning as DataWarning, warn
from ._wcs import WcsLike, jacobians

StampsLike = Union[ArrayLike, GalSimImage, Sequence[GalSimImage], str, "os.PathLike[str]", Hdu]
"""Stamps: an array, a sequence of arrays, one or more GalSim images, a FITS file, or an HDU of astropy."""
PsfLike = Union[ArrayLike, "FunctionalPsf", GalSimImage, GalSimProfile, Sequence[GalSimImage], Sequence[GalSimProfile], Callable[..., Any], Any]
"""PSFs: arrays, formulas, images or profiles of GalSim, or models of Piff, PSFEx and Rubin."""


class FunctionalPsf:
    """PSFs given by a formula: round profiles made elliptical by a shear, drawn without noise.

    Parameters
    ----------
    fwhm : float or array of shape (n,)
        Full width at half maximum of the round profile, in pixels.
    e1, e2 : float or array of shape (n,)
        Shear-type ellipticity (1 − q)/(1 + q); e1 > 0 along +x, e2 > 0 along x = y.
    beta : float or array of shape (n,), optional
        Exponent of a Moffat profile, above 1. None gives a Kolmogorov profile.
    """

    __slots__ = ("_rows",)

    _rows: NDArray[np.float64]

    def __init__(
        self,
        fwhm: ArrayLike,
        e1: ArrayLike = 0.0,
        e2: ArrayLike = 0.0,
        *,
        beta: ArrayLike | None = 3.0,
    ) -> None:
        named = {"fwhm": fwhm, "e1": e1, "e2": e2}
        if beta is not None:
            named["beta"] = beta
        columns = [double(name, value) for name, value in named.items()]
        for name, column in zip(named, columns):
            if not np.isfinite(column).all():
                raise ValueError(f"{name}: found a number that is not finite; expected finite ones")
        try:
            columns = list(np.broadcast_arrays(*columns))
        except ValueError:
            shapes = ", ".join(shown(column.shape) for column in columns)
            raise ValueError(f"{', '.join(named)}: found shapes {shapes}; expected one shape") from None
        if columns[0].ndim > 1:
            raise ValueError(f"fwhm: found shape {shown(columns[0].shape)}; expected one number, or (n,)")
        if beta is None:
            columns.append(np.full(columns[0].shape, np.nan))
        self._rows = np.ascontiguousarray(np.atleast_2d(np.stack(columns, axis=-1)))

    @classmethod
    def _of_rows(cls, rows: NDArray[np.float64]) -> FunctionalPsf:
        psf = cls.__new__(cls)
        psf._rows = rows
        return psf

    @property
    def fwhm(self) -> NDArray[np.float64]:
        """Full widths at half maximum in pixels."""
        return self._rows[:, 0]

    @property
    def e1(self) -> NDArray[np.float64]:
        """First components of the shear-type ellipticity."""
        return self._rows[:, 1]

    @property
    def e2(self) -> NDArray[np.float64]:
        """Second components."""
        return self._rows[:, 2]

    @property
    def beta(self) -> NDArray[np.float64]:
        """Exponents of Moffat profiles; NaN for Kolmogorov profiles."""
        return self._rows[:, 3]

    def _part(self, start: int, end: int) -> FunctionalPsf:
        """The PSFs of galaxies from ``start`` to before ``end``; one for all stays one."""
        return self if len(self) == 1 else FunctionalPsf._of_rows(self._rows[start:end])

    def __len__(self) -> int:
        return len(self._rows)

    def __repr__(self) -> str:
        return f"<shearq.FunctionalPsf of {len(self)}>"


def measure(
    stamps: StampsLike | None = None,
    psf: PsfLike | None = None,
    *,
    epochs: Sequence[Mapping[str, Any]] | None = None,
    noise: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    x: ArrayLike | None = None,
    y: ArrayLike | None = None,
    ids: ArrayLike | None = None,
    wcs: WcsLike | None = None,
    properties: Mapping[str, ArrayLike] | None = None,
    pixel: PixelOfPsf | None = None,
    psf_oversampling: int | None = None,
    submission: SubmissionLike = "48/linear/star",
    threads: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> Catalogue:
    """Measure the shapes of galaxies and their response to shear.

    Parameters
    ----------
    stamps : array of shape (n, ny, nx)
        Square postage stamps in any unit, of even or odd size, at least as large as the configuration requires (48
        pixels by default). Each has its galaxy near the middle. The sky must be subtracted. float32 and float64 are
        read without a copy, memory maps included; other types are converted in pieces. Lists of 2-D arrays or GalSim
        images are accepted, and a FITS file (a path, ``FILE[SCI,2]`` for one of its images) or an image HDU of astropy, whose header
        then states the WCS as for `gather`. Pixels that are masked, not finite or −1e30 are missing: the network flags such a galaxy, the
        linear method flags it if many are missing.
    psf : array of shape (py, px) or (n, py, px), FunctionalPsf, or GalSim image or profile
        One PSF for all galaxies or one per galaxy, centred like the stamps, of even or odd size, and at least as large
        as the configuration requires (32 pixels by default). It is cut and normalised. Profiles of GalSim are drawn
        on the pixels of ``wcs``, or of GalSim stamps. A model is drawn at each galaxy's ``x`` and ``y``, in the model's convention (the
        first pixel is 1 for Piff and PSFEx): a ``piff.PSF``, a PSFEx file as ``galsim.des.DES_PSFEx``, a PSF of Rubin
        (``computeKernelImage``), or a function of (x, y) that returns an image or a profile of GalSim.
    epochs : sequence of mappings, optional
        Instead of `stamps` and `psf`: several stamps of each galaxy, which a linear configuration combines in each Fourier mode
        with inverse-variance weights before it measures the shape. Each epoch has ``stamps`` and ``psf``, and perhaps
        ``noise``, ``mask``, ``wcs``, ``x`` and ``y`` (for a WCS or PSF that varies), ``properties``, ``pixel``, ``psf_oversampling``, ``offsets`` of shape (n, 2): the
        galaxies from the centres of their stamps along x and y in pixels, ``psf_offsets`` of shape (2,) or (n, 2): the PSFs from the
        centres of theirs, for PSFs drawn at the phases of the galaxies as in MEDS, and ``flux``: that of the galaxies in relation to the other
        epochs, a number or (n,), for bands. Galaxy k is on stamp k of each epoch; stamps of NaN are absent. The noise of an
        epoch is taken as white. Each band counts with flux/noise², so that the fluxes are weights: they may be those of a
        typical galaxy, and should not be measured on the noise of the galaxy itself.
    noise : float or array of shape (n,) or (n, ny, nx), optional
        Standard deviation of white noise per pixel in the unit of the stamps, for all or per stamp. Maps state it for each pixel
        (inf for bad ones), as ``gather --variance`` takes them: a stamp has the median beyond a quarter of its side from its centre, and
        the correlation of the noise is measured. By default it is measured. A linear configuration assumes one image, and measures noise, its correlation and the galaxy size on
        all stamps together. A network measures the noise on the border of each stamp.
    mask : array of shape (n, ny, nx) or (ny, nx), optional
        True for missing pixels, as in masked arrays of numpy. With a mask, the stamps are copied.
    x, y : array of shape (n,), optional
        Positions in pixels, which become columns.
    ids : array of shape (n,), optional
        Whole numbers or words, which become the column ``id``.
    wcs : array of shape (2, 2) or (n, 2, 2), or WCS of GalSim or astropy, optional
        With it, shapes and responses are in the frame of the sky, as in GalSim and TreeCorr: e1 > 0 is elongation
        east–west, e2 > 0 along north-west. Rotated, mirrored and sheared pixels are measured exactly. Arrays are
        Jacobians ((du/dx, du/dy), (dv/dx, dv/dy)) in arcsec per pixel, u to the west and v to the north, for all stamps
        or per stamp; lists have a GalSim WCS per stamp. A WCS that varies over the image needs ``x`` and ``y`` in its own
        convention (the first pixel is 1 for GalSim, 0 for astropy), unless it is that of an image of the stamps' size. PSFs are on the pixels of their stamps: images,
        or formulas whose shapes refer to the pixel axes. Without a WCS, the frame is that of the pixels.
    properties : mapping, optional
        What else the model of the PSF depends on, such as ``{"chipnum": 4, "ri_color": colours}``: a value for all galaxies or
        one for each.
    pixel : {'included', 'convolve'}, optional
        Whether profiles of GalSim contain the pixel, as those interpolated from images of stars do. By default they are convolved
        with it, with a warning for such profiles.
    psf_oversampling : int, optional
        Pixels of the PSF images along a pixel of the galaxies, of undersampled images; by default OVERSAMP, PSF_SAMP or SAMPLING of the header of a path
        or HDU, or 1. The PSFs are integrated over their fine
        pixels, as GalSim and STPSF draw them, and are integrated over the galaxies' pixels here, without aliases.
    submission : str, path, mapping or Configuration
        The configuration: see :func:`submission`.
    threads : int, optional
        Worker threads; see :func:`set_threads` for the default. Results do not depend on it.
    progress : callable, optional
        Called from the calling thread with the number of galaxies done since the last call:
        ``tqdm(total=len(stamps)).update``. An exception ends the measurement.

    Returns
    -------
    Catalogue
        Of shape (n,), with the same bits as a catalogue of the command line. ``attrs['frame']`` is 'pixel' or 'sky'.
        Sizes are in pixels; with a WCS, in sides of a square of a pixel's area.

    Raises
    ------
    ValueError, TypeError
        If an argument does not fit. The message names it, with the shape found and the shape expected.
    ValueError
        If all galaxies are flagged. The message names the most frequent reason.
    KeyError
        If there is no such configuration.

    Warns
    -----
    DataWarning
        If stamps bias shears or are likely a mistake, for example if they contain sky.

    Notes
    -----
    e1 and e2 are not divided by the response to shear, which the columns R11, R22, R12 and R21 contain. :func:`mean_shear` and :func:`bias` divide by the mean response of the galaxies that
    they average; :meth:`Catalogue.shear` gives a shear per galaxy. Combine several calls by :func:`mean_shear` or
    :func:`concatenate`. The mean response of some thousand galaxies has an error of about a per cent.

    Other Python threads run meanwhile; they must not change the arrays.

    Examples
    --------
    >>> import shearq
    >>> image = shearq.simulate(set=8, grid=20)[0]
    >>> cat = shearq.measure(image.stamps, image.psf)
    >>> cat
    <shearq.Catalogue of 400 galaxies, 0 flagged: e1, e2, ...>
    >>> print(cat.mean_shear())
    g1 = ... ± ..., g2 = ... ± ... (400 galaxies, 0 flagged, pixel frame)
    >>> cat.write("shapes.parquet", overwrite=True)
    """
    settings, count, done = resolve(submission), thread_count(threads), callback(progress)
    if epochs is None:
        for name, value in (("stamps", stamps), ("psf", psf)):
            if value is None:
                raise TypeError(f"{name}: found none; expected stamps and their PSF, or epochs")
        stamps, psf, wcs, detector = _pixels(stamps, psf, wcs, x, y, properties, pixel, psf_oversampling)
        _doubt_mask(mask)
        return _measure([_image(stamps, psf, noise, mask, wcs, x, y, detector)], (ids, x, y), settings, count, done)
    given = {"stamps": stamps, "psf": psf, "noise": noise, "mask": mask, "wcs": wcs, "properties": properties, "pixel": pixel}
    if psf_oversampling not in (None, 1):
        given["psf_oversampling"] = psf_oversampling
    for name, value in given.items():
        if value is not None:
            raise TypeError(f"{name}: found with epochs; expected in each epoch")
    return _measure([_epoch(k, epoch) for k, epoch in enumerate(epochs)], (ids, x, y), settings, count, done)


def measure_blocks(
    stamps: Any,
    psf: PsfLike,
    *,
    block: int = 10_000,
    noise: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    x: ArrayLike | None = None,
    y: ArrayLike | None = None,
    ids: ArrayLike | None = None,
    wcs: WcsLike | None = None,
    properties: Mapping[str, ArrayLike] | None = None,
    pixel: PixelOfPsf | None = None,
    psf_oversampling: int | None = None,
    submission: SubmissionLike = "48/linear/star",
    threads: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> Iterator[Catalogue]:
    """Measure stamps block by block, each like one image, in the memory of one block.

    Parameters
    ----------
    stamps : array, or anything with a shape (n, ny, nx) and slices
        Memory maps, and arrays of h5py, zarr or dask: each block is read when it is measured.
    psf, noise, mask, x, y, ids, wcs, properties, pixel, psf_oversampling, submission, threads, progress
        As for :func:`measure`.
    block : int
        Most stamps of a block. Blocks are as equal as possible. The noise and the galaxy size are measured on each: it
        needs some hundred galaxies.

    Yields
    ------
    Catalogue
        Of the next block.

    Raises
    ------
    ValueError, TypeError, KeyError
        As :func:`measure`, when the block is measured.

    Examples
    --------
    >>> import shearq
    >>> image = shearq.simulate(set=8, grid=20)[0]
    >>> blocks = shearq.measure_blocks(image.stamps, image.psf, block=200)
    >>> print(shearq.mean_shear(blocks))
    g1 = ... ± ..., g2 = ... ± ... (400 galaxies, 0 flagged, pixel frame)
    """
    stamps, psf, wcs, detector = _pixels(stamps, psf, wcs, x, y, properties, pixel, psf_oversampling)
    most = whole("block", block, 1, 1 << 40)
    if isinstance(stamps, (list, tuple)):
        stamps = numeric("stamps", stamps)
    shape = tuple(getattr(stamps, "shape", ()))
    if len(shape) != 3:
        raise ValueError(f"stamps: found an array of shape {shown(shape)}; expected (n, ny, nx)")
    each: dict[str, Any] = {"psf": psf, "noise": noise, "mask": mask, "ids": ids, "x": x, "y": y}
    if wcs is not None:
        wcs = jacobians(wcs, shape[0], x, y, shape[2])
    per_galaxy = {"psf": 3, "noise": 1, "mask": 3, "ids": 1, "x": 1, "y": 1}
    for name, value in each.items():
        if value is not None and not isinstance(value, FunctionalPsf) and not hasattr(value, "shape"):
            each[name] = np.asarray(value)
        if np.ndim(each[name]) == per_galaxy[name] and len(each[name]) != shape[0]:
            raise ValueError(f"{name}: found {len(each[name])} rows; expected {shape[0]}, one for each stamp")
    settings, count, done = resolve(submission), thread_count(threads), callback(progress)
    blocks = -(-shape[0] // most)

    def part(name: str, start: int, end: int) -> Any:
        value = each[name]
        if isinstance(value, FunctionalPsf):
            return value._part(start, end)
        return value[start:end] if value is not None and np.ndim(value) == per_galaxy[name] else value

    def measured() -> Iterator[Catalogue]:
        for k in range(blocks):
            start, end = k * shape[0] // blocks, (k + 1) * shape[0] // blocks
            one, level, missing, *columns = (part(name, start, end) for name in each)
            pixels = stamps[start:end]
            pixels = pixels if isinstance(pixels, np.ndarray) else np.asarray(pixels)
            local = None if wcs is None else wcs[0] if len(wcs) == 1 else wcs[start:end]
            try:
                image = _image(pixels, one, level, missing, local, columns[1], columns[2], detector)
                yield _measure([image], tuple(columns), settings, count, done)
            except ValueError as error:
                raise ValueError(f"{error} (stamps {start} to {end - 1})") from None

    return measured()


_EPOCH = ("stamps", "psf", "noise", "mask", "wcs", "x", "y", "properties", "pixel", "psf_oversampling", "offsets", "psf_offsets", "flux")


_PSF_BLOCK = 64


def _on_galaxy_pixels(psf: Any, oversampling: int | None) -> Any:
    """PSF images of finer pixels on the pixels of the galaxies."""
    factor = whole("psf_oversampling", 1 if oversampling is None else oversampling, 1, 32)
    if factor == 1:
        return psf
    if isinstance(psf, FunctionalPsf):
        raise ValueError("psf_oversampling: found with formulas, which have no pixels; expected images of PSFs")
    images = numeric("psf", psf)
    sides = sorted({side for side in images.shape[-2:] if side % factor})
    if sides:
        nearest = sides[0] // factor * factor
        raise ValueError(
            f"psf: found an oversampled PSF of shape {shown(images.shape[-2:])} with psf_oversampling={factor}; expected multiples of {factor}."
            f" Try: draw the PSF on {nearest} × {nearest} or {nearest + factor} × {nearest + factor} pixels, centred in their middle"
        )
    if images.ndim == 2:
        return _shearq.psfs_from_oversampled(double("psf", images[np.newaxis]), factor)[0]
    # In blocks, because the finer images of many galaxies in double precision are large.
    blocks = (double("psf", images[first : first + _PSF_BLOCK]) for first in range(0, len(images), _PSF_BLOCK))
    return np.concatenate([_shearq.psfs_from_oversampled(block, factor) for block in blocks])


def _pixels(
    stamps: Any, psf: Any, wcs: Any, x: Any, y: Any, properties: Any, pixel: PixelOfPsf | None, oversampling: int | None
) -> tuple[Any, Any, Any, _images.Detector]:
    """Stamps and PSFs of all kinds as arrays, or PSFs as formulas, and the WCS and detector, which files may state."""
    stamps, psf, wcs, oversampling, detector = _images.opened(stamps, psf, wcs, oversampling)
    fine = oversampling not in (None, 1)
    psf = _psf_models.at_galaxies(psf, stamps, x, y, wcs, properties, pixel, fine)
    if fine and _galsim._many(psf, _galsim._is_profile) is not None:
        raise ValueError(_psf_models.FINE_PROFILE)
    images = _galsim._many(stamps, _galsim._is_image) if fine and wcs is None else None
    if images is not None:
        _galsim._common("stamps", images)
    # Models have drawn their PSFs with the pixel.
    of_profiles = None if isinstance(psf, _psf_models.PsfsOfModel) else pixel
    stamps, psf = _galsim.unpacked(stamps, psf, check=wcs is None and not fine, pixel=of_profiles, wcs=wcs, x=x, y=y)
    return stamps, _on_galaxy_pixels(psf, oversampling), wcs, detector


# Share of pixels from which a mask is likely the one of good pixels. Chosen by hand: usual masks mark some per cent.
MAX_MASKED = 0.5


def _doubt_mask(mask: Any) -> None:
    """Refuses a mask of all pixels, and warns of one of most."""
    given = np.asarray(mask)
    share = float(given.mean()) if given.dtype == bool else 0.0
    if share > MAX_MASKED:
        message = f"mask: found {share:.0%} of the pixels marked; expected True for missing pixels. Try: mask=~mask, if it marks good ones"
        if share == 1.0:
            raise ValueError(message)
        warn(message, DataWarning)


def _epoch(k: int, epoch: Mapping[str, Any]) -> dict[str, Any]:
    """The arrays of an epoch, in units of the flux that all epochs have."""
    try:
        unknown = [name for name in epoch if name not in _EPOCH]
        if unknown or "stamps" not in epoch or "psf" not in epoch:
            raise ValueError(f"found {', '.join(epoch)}; expected stamps, psf and perhaps {', '.join(_EPOCH[2:])}")
        own = {name: epoch.get(name) for name in _EPOCH}
        stamps, psf, wcs, _ = _pixels(*(own[name] for name in ("stamps", "psf", "wcs", "x", "y", "properties", "pixel", "psf_oversampling")))
        noise = own["noise"]
        if own["flux"] is not None:
            flux = np.asarray(own["flux"], dtype=np.float64)
            if not (np.isfinite(flux).all() and (flux > 0).all()):
                raise ValueError("flux: found a number that is not positive; expected fluxes in any unit. Try: without the band")
            stamps = numeric("stamps", stamps)
            if flux.shape not in ((), (len(stamps),)):
                raise ValueError(f"flux: found shape {shown(flux.shape)}; expected a number, or ({len(stamps)},)")
            if noise is None and flux.ndim:
                raise ValueError("noise: found none with a flux for each galaxy; expected a level")
            stamps = stamps / flux.reshape(-1, 1, 1)
            if noise is not None:
                noise = np.asarray(noise) / (flux.reshape(-1, 1, 1) if np.ndim(noise) == 3 else flux)
        image = _image(stamps, psf, noise, own["mask"], wcs, own["x"], own["y"])
        count = len(image["stamps"])
        if own["offsets"] is not None:
            image["offsets"] = offsets = double("offsets", own["offsets"])
            if offsets.shape != (count, 2):
                raise ValueError(f"offsets: found shape {shown(offsets.shape)}; expected ({count}, 2)")
        if own["psf_offsets"] is not None:
            of_psfs = double("psf_offsets", own["psf_offsets"])
            if of_psfs.shape not in ((2,), (count, 2)):
                raise ValueError(f"psf_offsets: found shape {shown(of_psfs.shape)}; expected (2,), or ({count}, 2)")
            # Deconvolution moves a galaxy by the place of its PSF.
            offsets = np.zeros((count, 2)) if image["offsets"] is None else image["offsets"]
            image["offsets"] = np.ascontiguousarray(offsets - of_psfs)
        return image
    except (ValueError, TypeError) as error:
        raise type(error)(f"epochs: epoch {k}: {error}") from None


# As in crates/pipeline/src/gather/maps.rs: variance in units of the median of a stamp from which it marks a bad pixel.
MIN_BAD_RATIO = 1e5


def _levels(stamps: NDArray[Any], sigmas: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Stamps without the pixels of infinite noise, and the level of each from maps of the noise, as `gather` takes it from maps of variances."""
    if sigmas.shape != stamps.shape:
        raise ValueError(f"noise: found maps of shape {shown(sigmas.shape)}; expected {shown(stamps.shape)}, that of the stamps")
    side = stamps.shape[1]
    rows, columns = np.indices((side, side)) - (side - 1) / 2
    outside = np.hypot(rows, columns) > side / 4
    stamps = stamps.copy()
    levels = np.empty(len(stamps))
    for k, (stamp, own) in enumerate(zip(stamps, sigmas)):
        good = np.isfinite(own)
        positive = np.sort(own[good & (own > 0)])
        if len(positive):
            good &= own < np.sqrt(MIN_BAD_RATIO) * positive[len(positive) // 2]
        stamp[~good] = np.nan
        seen = np.isfinite(stamp)
        if (own[seen] <= 0).any():
            raise ValueError(f"noise: found {own[seen].min():g} on stamp {k}; expected positive standard deviations, or inf for bad pixels")
        chosen = np.sort(own[seen & outside] if (seen & outside).any() else own[seen])
        levels[k] = chosen[len(chosen) // 2] if len(chosen) else np.nan
    # A stamp without pixels has no level. Any positive one will do, because its galaxy is flagged.
    known = np.sort(levels[np.isfinite(levels)])
    return stamps, np.where(np.isnan(levels), known[len(known) // 2] if len(known) else 0.0, levels)


def _image(
    stamps: Any, psf: Any, noise: Any, mask: Any, wcs: Any, x: Any, y: Any, detector: _images.Detector = _images.NO_DETECTOR
) -> dict[str, Any]:
    """The arrays of an image as the extension module takes them."""
    stamps = with_missing("stamps", stamps, mask)
    stamps = shaped("stamps", stamps, "(n, ny, nx), of one stamp stamps[np.newaxis]", axes=3)
    stamps = without_sentinels(stamps)
    count, rows, sides = stamps.shape
    if rows != sides:
        raise ValueError(f"stamps: found an array of shape {shown(stamps.shape)}; expected squares, ny = nx")
    image: dict[str, Any] = dict.fromkeys(("star", "stars", "formulas", "noise", "noises", "offsets"))
    image["stated"] = False
    image["detector"] = detector
    image["stamps"] = stamps
    image["jacobians"] = None if wcs is None else jacobians(wcs, count, x, y, sides)
    if isinstance(psf, FunctionalPsf):
        image["formulas"] = psf._rows
    else:
        psf = numeric("psf", psf)
        psf = without_sentinels(psf) if psf.ndim in (2, 3) else psf
        if psf.ndim == 2:
            image["star"] = double("psf", psf)
        elif psf.ndim == 3 and len(psf) == count:
            image["stars"] = psf
        else:
            raise ValueError(
                f"psf: found an array of shape {shown(psf.shape)}; expected (py, px) or ({count}, py, px), one for each stamp"
            )
    if noise is not None and np.ndim(noise) == 0:
        image["noise"] = real("noise", noise, "a finite number of image units, not negative", least=0.0)
    elif noise is not None and np.ndim(noise) == 3:
        image["stamps"], image["noises"] = _levels(stamps, numeric("noise", noise))
        image["stated"] = True
    elif noise is not None:
        image["noises"] = sigmas = double("noise", noise)
        if sigmas.shape != (count,):
            raise ValueError(
                f"noise: found an array of shape {shown(sigmas.shape)}; expected one number, or ({count},), one for each stamp"
            )
    return image


def _measure(
    images: list[dict[str, Any]],
    columns: tuple[Any, ...],
    settings: Configuration,
    threads: int,
    progress: Callable[[int], object] | None,
) -> Catalogue:
    """Measure the arrays of an image, or of several with epochs."""
    if not images:
        raise ValueError("epochs: found none; expected one or more")
    count = len(images[0]["stamps"])
    for k, image in enumerate(images):
        if len(image["stamps"]) != count:
            raise ValueError(f"epochs: epoch {k} has {len(image['stamps'])} stamps; expected {count}, one for each galaxy")
    own = _own_columns(columns, count)
    # The noise of several stars is not that of one.
    star = images[0]["star"] if len(images) == 1 else None
    found, doubts, failure, frame = _shearq.measure(images, settings._resolved, threads, progress)
    for doubt in doubts:
        warn(doubt, DataWarning)
    if failure is not None:
        raise ValueError(failure)
    if "psf_m" in found:
        number = 0.0 if star is None else _schema.star_number(star.tobytes())
        found["psf_id"] = np.where(found["psf_m"] > 0, number, 0.0)
    found = {**own, **found}
    catalogue = np.empty(count, dtype=[(name, column.dtype) for name, column in found.items()]).view(Catalogue)
    for name, column in found.items():
        catalogue[name] = column
    catalogue.attrs = {
        "submission": settings.name,
        "ellipticity": settings.ellipticity,
        "frame": frame,
        "settings": settings.toml,
        "version": _shearq.__version__,
    }
    if np.isfinite(catalogue["R11"]).any():
        catalogue.attrs["response"] = _schema.NOT_APPLIED
    return catalogue


def _own_columns(columns: tuple[Any, ...], count: int) -> dict[str, NDArray[Any]]:
    """The columns id, x and y that are given."""
    found: dict[str, NDArray[Any]] = {}
    for name, argument, value in zip(("id", "x", "y"), ("ids", "x", "y"), columns):
        if value is None:
            continue
        array = np.asarray(value) if name == "id" else double(argument, value)
        if array.shape != (count,):
            raise ValueError(f"{argument}: found an array of shape {shown(array.shape)}; expected ({count},), one for each stamp")
        if name == "id":
            if array.dtype.kind in "iu":
                array = array.astype(np.int64)
            elif array.dtype.kind != "U":
                raise TypeError(f"ids: found values of type {array.dtype}; expected whole numbers or words")
        found[name] = array
    return found
