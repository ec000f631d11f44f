"""Measure stamps and PSFs into catalogues of calibrated ellipticities."""

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

# Names of columns in AnaCal.
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
        Exponent of a Moffat profile, above 1. None gives a Kolmogorov profile.
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
        Standard errors. They include the errors of the mean responses.
    covariance : tuple of tuple of float
        Covariance of g1 and g2.
    response : tuple of float or None
        Mean responses R11 and R22 by which the ellipticities were divided; None if the configuration measures none.
    galaxies : int
        Galaxies without a flag and with a positive weight.
    flagged : int
        Galaxies with a flag and a positive weight.
    """

    g1: float
    g2: float
    g1_error: float
    g2_error: float
    covariance: tuple[tuple[float, float], tuple[float, float]]
    response: tuple[float, float] | None
    galaxies: int
    flagged: int

    def __iter__(self):
        return iter((self.g1, self.g2))


class Catalogue(np.ndarray):
    """A structured array with one row per galaxy, as :func:`measure` returns it.

    Fields
    ------
    e1, e2 : float64
        Ellipticity, divided by the mean response of all galaxies that were measured together; NaN if flagged.
    flags : int32
        Reasons why the galaxy could not be measured, bits of :class:`Flag`; 0 for a good galaxy.
    iterations, stop, updated : int32
        Iterations of the network, why it stopped (0 stable, 1 energy rise, 2 most iterations, -1 not run), and neurons
        above their threshold at the end.
    first_energy, energy : float64
        Energy of the network at its start and end, in squared image units.
    noise : float64
        Noise level used: standard deviation per pixel, in image units.
    flux : float64
        Sum of the deconvolved stamp in image units; for the linear method, sum of the stamp.
    radius, size : float64
        Radius of the autocorrelation that is used in pixels, and its Qxx + Qyy in px².
    R11, R22, R12, R21 : float64
        Response of the galaxy to shear before that division: R12 is the response of e1 to the second component. Only
        means over many galaxies are unbiased.

    Attributes
    ----------
    attrs : dict
        ``response``: mean responses by which e1 and e2 were divided, or None; ``submission``: name of the configuration;
        ``settings``: all settings as TOML; ``ellipticity``: 'shear' or 'distortion'; ``version``: of shearq.

    Notes
    -----
    The index of a field gives a plain array. Slices and masks of rows give a catalogue. pandas, polars and astropy
    make tables from it as from any structured array; :func:`shearq.adapters.to_astropy` keeps ``attrs``.
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
        """The mean shear of the good galaxies: Σwe/ΣwR, with the ellipticities e before calibration.

        The error is the error of this ratio to first order, √(Σw²(e − gR)² n/(n − 1)) / ΣwR. It assumes independent
        galaxies.

        Parameters
        ----------
        weights : array of shape (n,), optional
            Weight of each row, not negative, or a mask of rows. Weights must not depend on the measured shape, which
            biases the mean; take them from the flux or the noise. Equal weights by default.

        Returns
        -------
        MeanShear

        Raises
        ------
        ValueError
            If weights have another shape, no good galaxy has a positive weight, or a mean response is not positive.
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
        flagged = int((weight[~rows.good] > 0).sum())
        rows, weight = rows[rows.good], weight[rows.good]
        # A common factor changes nothing, but squares of weights could overflow.
        weight = weight / weight.max(initial=np.finfo(float).tiny)
        divided = self.attrs.get("response")
        if divided is None:
            columns = [rows["e1"], rows["e2"], np.ones(len(rows)), np.ones(len(rows))]
        else:
            # Before calibration.
            columns = [rows["e1"] * divided[0], rows["e2"] * divided[1], rows["R11"], rows["R22"]]
        columns = [np.ascontiguousarray(column, dtype=np.float64) for column in columns]
        (g1, g2), covariance, response, galaxies = _shearq.mean_shear(*columns, weight)
        covariance = tuple(map(tuple, covariance))
        errors = [float(np.sqrt(covariance[k][k])) for k in (0, 1)]
        response = None if divided is None else tuple(response)
        return MeanShear(g1, g2, *errors, covariance, response, galaxies, flagged)

    def columns(self, names: str = "shearq") -> dict[str, np.ndarray]:
        """Ellipticities, responses and flags by the names that a program uses.

        Parameters
        ----------
        names : {'shearq', 'anacal'}
            ``'anacal'``: ``e1``, ``de1_dg1``, ``e2``, ``de2_dg2`` and ``flags``, with e1 and e2 before calibration.
            The sum of ellipticities over the sum of responses is the shear. ``'shearq'``: all fields.

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
        Square postage stamps in any unit, at least as large as the configuration requires. Each has its galaxy near
        the middle. The sky must be subtracted. float32 and float64 are read without a copy, memory maps included;
        other types are converted in pieces. Lists of 2-D arrays or GalSim images are accepted. Pixels that are not
        finite are missing: the network flags such a galaxy, the linear method flags it if many are missing.
    psf : array of shape (py, px) or (n, py, px), or FunctionalPsf
        One PSF for all galaxies or one per galaxy, centred like the stamps, and at least as large as the configuration
        requires. It is cut and normalised.
    noise : float or array of shape (n,), optional
        Standard deviation of white noise per pixel in the unit of the stamps, for all or per stamp. By default it is
        measured. A linear configuration assumes one image, and measures noise, its correlation and the galaxy size on
        all stamps together. A network measures the noise on the border of each stamp.
    submission : str, path, mapping or Configuration
        The configuration: see :func:`shearq.submission`.
    threads : int, optional
        Worker threads; one per core by default. Results do not depend on it.
    progress : callable, optional
        Called from the calling thread with the number of galaxies done since the last call:
        ``tqdm(total=len(stamps)).update``. An exception ends the measurement.

    Returns
    -------
    Catalogue
        Of shape (n,), with the same bits as a catalogue of the command line.

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
    e1 and e2 are divided by the mean response of the good galaxies of this call. Its error is about a per cent for
    some thousand galaxies. Combine several calls by :meth:`Catalogue.mean_shear` of each, or by ``columns("anacal")``.

    Other Python threads run meanwhile; they must not change the arrays.

    Examples
    --------
    >>> cat = shearq.measure(stamps, psf)
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
    found, response, doubts, failure = _shearq.measure(
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
    if failure is not None:
        raise ValueError(failure)
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
