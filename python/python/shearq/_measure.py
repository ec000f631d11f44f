"""Stamps and PSFs into catalogues of calibrated ellipticities."""

from __future__ import annotations

import enum
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from . import _shearq
from ._arrays import callback, double, numeric, real, shaped, shown, thread_count
from ._submissions import SubmissionLike, submission as resolve

Flag = enum.IntFlag("Flag", {name: bit for name, bit, _ in _shearq.flags()}, module=__name__)
Flag.__doc__ = "Why a galaxy could not be measured: the bits of a catalogue's ``flags``.\n\n" + "\n".join(
    f"* ``{name}``: {meaning}." for name, _, meaning in _shearq.flags()
)

# Columns as AnaCal calls them.
_ANACAL = {"e1": "e1", "e2": "e2", "R11": "de1_dg1", "R22": "de2_dg2"}


class DataWarning(UserWarning):
    """Stamps or PSFs that are measured, although they bias shears or are likely a mistake."""


class FunctionalPsf:
    """PSFs given by a formula: round profiles made elliptical by a shear, drawn without noise.

    Parameters
    ----------
    fwhm : float or array of shape (n,)
        Full width at half maximum of the round profile, in pixels.
    e1, e2 : float or array of shape (n,)
        Shear-type ellipticity (1 − q)/(1 + q); e1 > 0 along +x, e2 > 0 along x = y.
    beta : float or array of shape (n,), optional
        Exponent of a Moffat profile, above 1. A Kolmogorov profile where it is None.
    """

    __slots__ = ("_rows",)

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
    def _of_rows(cls, rows: np.ndarray) -> FunctionalPsf:
        psf = cls.__new__(cls)
        psf._rows = rows
        return psf

    fwhm = property(lambda self: self._rows[:, 0])
    e1 = property(lambda self: self._rows[:, 1])
    e2 = property(lambda self: self._rows[:, 2])
    beta = property(lambda self: self._rows[:, 3], doc="Not a number for Kolmogorov profiles.")

    def __len__(self) -> int:
        return len(self._rows)

    def __repr__(self) -> str:
        return f"<shearq.FunctionalPsf of {len(self)}>"


@dataclass(frozen=True)
class MeanShear:
    """The mean shear of galaxies.

    Attributes
    ----------
    g1, g2 : float
        Components of the mean shear; g1 > 0 along +x, g2 > 0 along x = y.
    g1_error, g2_error : float
        Their standard errors, from the scatter of the galaxies: shapes, noise and responses.
    response : tuple of float or None
        Mean responses that were divided by; None where the submission measures none, so that the mean
        ellipticity is taken as it is.
    galaxies : int
        Galaxies that count: those without a flag, of positive weight.
    """

    g1: float
    g2: float
    g1_error: float
    g2_error: float
    response: tuple[float, float] | None
    galaxies: int

    def __iter__(self):
        return iter((self.g1, self.g2))


class Catalogue(np.ndarray):
    """A structured array with one row per galaxy, as :func:`measure` returns it.

    Fields
    ------
    e1, e2 : float64
        Ellipticity, divided by the mean response of all galaxies that were measured together; NaN where flagged.
    R11, R22 : float64
        The galaxy's own response of e1 to the first component of shear, and of e2 to the second, before that
        division; fit for means over many galaxies.
    flags : int32
        Why it could not be measured, bits of :class:`Flag`; 0 for a good one.
    noise : float64
        Noise level used: standard deviation per pixel, in image units.
    flux : float64
        Sum of the deconvolved stamp, of the stamp itself under the linear method, in image units.
    radius, size : float64
        Radius of the piece of the autocorrelation used in pixels, and its Qxx + Qyy in px².
    iterations, stop, updated : int32
        How the network ended: its iterations, why it stopped (0 stable, 1 energy rise, 2 most iterations,
        -1 not run), and neurons above their threshold at the end.
    first_energy, energy : float64
        The network's energy at its start and end, in squared image units.

    Attributes
    ----------
    attrs : dict
        ``response``: mean responses that e1 and e2 were divided by, or None; ``submission``: its name;
        ``settings``: all settings as TOML; ``ellipticity``: 'shear' or 'distortion'; ``version``: of shearq.

    Notes
    -----
    Indexing by a field's name gives a plain array, slices and masks of rows a catalogue. Tables of pandas, polars
    and astropy are made from it as from any structured array; :func:`shearq.adapters.to_astropy` keeps ``attrs``.
    """

    attrs: dict[str, Any]

    def __array_finalize__(self, parent: Any) -> None:
        self.attrs = dict(getattr(parent, "attrs", {}))

    def __getitem__(self, key: Any) -> Any:
        found = super().__getitem__(key)
        if isinstance(found, Catalogue) and found.dtype.names is None:
            return found.view(np.ndarray)
        return found

    def __reduce__(self) -> tuple[Any, ...]:
        make, arguments, state = super().__reduce__()
        return make, arguments, (state, self.attrs)

    def __setstate__(self, state: Any) -> None:
        plain, self.attrs = state
        super().__setstate__(plain)

    @property
    def good(self) -> np.ndarray:
        """Rows without a flag: booleans of shape (n,)."""
        return self["flags"] == 0

    def mean_shear(self, weights: ArrayLike | None = None) -> MeanShear:
        """The mean shear of the good galaxies.

        The mean ellipticity over the mean response of the rows at hand, both with the same weights. What noise does
        to the response is in the response already.

        Parameters
        ----------
        weights : array of shape (n,), optional
            Weight of each row, not negative, or whether it counts. One that depends on the measured shape biases the mean: take weights
            from the flux or the noise. All the same by default.

        Returns
        -------
        MeanShear

        Raises
        ------
        ValueError
            Where weights do not fit, no good galaxy has any, or the mean response is not positive.
        """
        rows = np.atleast_1d(self)
        if weights is None:
            weight = np.ones(len(rows))
        else:
            chosen = np.asarray(weights).dtype == bool
            weight = np.asarray(weights, dtype=np.float64) if chosen else double("weights", weights)
        if weight.shape != rows.shape:
            raise ValueError(f"weights: found an array of shape {shown(weight.shape)}; expected {shown(rows.shape)}, one for each row")
        if not (np.isfinite(weight).all() and (weight >= 0).all()):
            raise ValueError("weights: found one that is negative or not finite; expected finite ones, not negative")
        rows, weight = rows[rows.good], weight[rows.good]
        counted = int((weight > 0).sum())
        if counted == 0:
            raise ValueError("weights: no galaxy without a flag has a positive one; expected one or more")
        weight = weight / weight.max()
        divided = self.attrs.get("response")
        means, errors, responses = [], [], []
        for name, own, k in (("e1", "R11", 0), ("e2", "R22", 1)):
            if divided is None:
                e, response = rows[name], np.ones(len(rows))
            else:
                # As it was before it was divided by the mean of all.
                e, response = rows[name] * divided[k], rows[own]
            total = (weight * response).sum()
            if not total > 0:
                raise ValueError(f"{own}: the mean response is {total / weight.sum()}; expected a positive one")
            mean = (weight * e).sum() / total
            scatter = (weight**2 * (e - mean * response) ** 2).sum()
            means.append(float(mean))
            errors.append(float(np.sqrt(scatter * counted / (counted - 1)) / total) if counted > 1 else float("nan"))
            responses.append(float(total / weight.sum()))
        return MeanShear(*means, *errors, None if divided is None else tuple(responses), counted)

    def columns(self, names: str = "shearq") -> dict[str, np.ndarray]:
        """Ellipticities, responses and flags by the names that a program uses.

        Parameters
        ----------
        names : {'shearq', 'anacal'}
            ``'anacal'``: ``e1``, ``de1_dg1``, ``e2``, ``de2_dg2`` and ``flags``, with e1 and e2 as they were before
            they were divided by the mean response, so that the sum of ellipticities over the sum of responses is
            the shear. ``'shearq'``: all fields as they are.

        Returns
        -------
        dict of str to array of shape (n,)
        """
        if names == "shearq":
            return {name: self[name] for name in self.dtype.names}
        if names != "anacal":
            raise ValueError(f"names: found {names!r}; expected 'shearq' or 'anacal'")
        found = {anacal: self[own] for own, anacal in _ANACAL.items()}
        for k, name in enumerate(("e1", "e2")):
            if self.attrs.get("response") is not None:
                found[name] = found[name] * self.attrs["response"][k]
        return {**found, "flags": self["flags"]}


def measure(
    stamps: ArrayLike,
    psf: ArrayLike | FunctionalPsf,
    *,
    noise: ArrayLike | None = None,
    submission: SubmissionLike = "48/linear/star",
    threads: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> Catalogue:
    """Measure the shapes of galaxies and calibrate them by their mean response to shear.

    Parameters
    ----------
    stamps : array of shape (n, ny, nx)
        Postage stamps, square, at least as large as the submission needs, each with its galaxy near the middle
        and its sky subtracted, in any unit. Of any strides, order of bytes and real type: float32 and float64 are
        read where they lie, memory maps included; others are converted a few at a time. A list of 2-D arrays or of
        GalSim images will do. Pixels that are not finite are missing: the network flags
        such a galaxy, a linear submission one with many of them.
    psf : array of shape (py, px) or (n, py, px), or FunctionalPsf
        The PSF for all, or one each, centred like the stamps and at least as large as the submission uses. It is cut
        and normalised.
    noise : float or array of shape (n,), optional
        Standard deviation of white noise per pixel in the stamps' unit, for all or one each. Without it a linear
        submission takes the stamps for those of one image, and measures on their frames how large their noise is and how
        it is correlated, and on the galaxies how wide a window they need; a network measures it on each stamp's border.
    submission : str, path, mapping or Submission
        How to measure: see :func:`shearq.submission`.
    threads : int, optional
        Worker threads; one per core by default. Results do not depend on it, bit for bit.
    progress : callable, optional
        Called now and then, from the calling thread, with the number of galaxies done since the last call:
        ``tqdm(total=len(stamps)).update``. An exception of it ends the measurement.

    Returns
    -------
    Catalogue
        Of shape (n,). Its numbers are those of the command line's catalogue of the same stamps, bit for bit.

    Raises
    ------
    ValueError, TypeError
        Where an argument does not fit. It is named, with the shape found and the one expected.
    KeyError
        Where there is no such submission.

    Warns
    -----
    DataWarning
        If stamps bias shears or are likely a mistake, for example if they contain sky.

    Notes
    -----
    e1 and e2 are divided by the mean response of the good galaxies of this call: some thousands tell it to a per
    cent, a handful do not. Galaxies that are measured in several calls are put together by
    :meth:`Catalogue.mean_shear` of each, or by ``columns("anacal")``.

    Other Python threads run meanwhile; they must not change the arrays.

    Examples
    --------
    >>> cat = shearq.measure(stamps, psf, noise=sigma)
    >>> cat["e1"][cat.good].mean()
    >>> shear = cat.mean_shear()
    >>> print(f"g1 = {shear.g1:+.4f} ± {shear.g1_error:.4f}")
    """
    settings = resolve(submission)
    stamps = shaped("stamps", stamps, "(n, ny, nx), of one stamp stamps[np.newaxis]", axes=3)
    count, rows, columns = stamps.shape
    if rows != columns:
        raise ValueError(f"stamps: found an array of shape {shown(stamps.shape)}; expected squares, ny = nx")
    star = stars = formulas = None
    if isinstance(psf, FunctionalPsf):
        formulas = psf._rows
    else:
        psf = numeric("psf", psf)
        if psf.ndim == 2:
            star = double("psf", psf)
        elif psf.ndim == 3 and len(psf) == count:
            stars = psf
        else:
            raise ValueError(
                f"psf: found an array of shape {shown(psf.shape)}; expected (py, px) or ({count}, py, px), one for each stamp"
            )
    sigma = sigmas = None
    if noise is not None and np.ndim(noise) == 0:
        sigma = real("noise", noise, "a finite number of image units, not negative", least=0.0)
    elif noise is not None:
        sigmas = double("noise", noise)
        if sigmas.shape != (count,):
            raise ValueError(
                f"noise: found an array of shape {shown(sigmas.shape)}; expected one number, or ({count},), one for each stamp"
            )
    found, response, doubts = _shearq.measure(
        stamps,
        star,
        stars,
        formulas,
        sigma,
        sigmas,
        settings._resolved,
        thread_count(threads),
        callback(progress),
    )
    for doubt in doubts:
        warnings.warn(doubt, DataWarning, stacklevel=2)
    catalogue = np.empty(count, dtype=[(name, column.dtype) for name, column in found.items()]).view(Catalogue)
    for name, column in found.items():
        catalogue[name] = column
    catalogue.attrs = {
        "response": None if response is None else tuple(response),
        "submission": settings.name,
        "settings": settings.toml,
        "ellipticity": settings.ellipticity,
        "version": _shearq.__version__,
    }
    return catalogue
