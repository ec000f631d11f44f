"""Catalogues of galaxies, and mean shears of their rows."""

from __future__ import annotations

import enum
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Literal, cast, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _display, _distributed, _schema, _shearq, _tables
from ._arrays import double, shown
from ._bias import bias_sums, one_table
from ._results import Result, origin

if TYPE_CHECKING:
    import astropy.table
    import pandas
    import polars


class Flag(enum.IntFlag):
    """Why a galaxy could not be measured: the bits of a catalogue's ``flags``."""

    NotFinite = _schema.NOT_FINITE
    """Pixels are missing."""
    BadPsf = 2
    """The PSF cannot be used."""
    NoScale = 4
    """Nothing to scale the brightness by."""
    NoLight = 8
    """Nothing left after deconvolution."""
    NoExtent = 16
    """Moments without extent."""
    NoShear = 32
    """Distortion above 1."""


@dataclass(frozen=True, repr=False)
class MeanShear(Result):
    """The mean shear of galaxies. It prints as ``g1 = +0.0201 ± 0.0009, …``.

    Attributes
    ----------
    g1, g2 : float
        Components of the mean shear; g1 > 0 along +x, g2 > 0 along x = y of the frame.
    g1_error, g2_error : float
        Standard errors. They include the errors of the mean responses.
    covariance : tuple of tuple of float
        Covariance of g1 and g2; NaN between them for tables of other programs.
    response : tuple of float or None
        Mean responses R11 and R22; None if the configuration is not calibrated by them.
    galaxies : int
        Galaxies without a flag and with a positive weight.
    flagged : int
        Galaxies with a flag and a positive weight.
    frame : {'pixel', 'sky'} or None
        Axes of g1 and g2: those of the pixels, or of the sky (g1 > 0 along east–west); None if the catalogues do not state it.
    made_by : dict
        Version with commit and function; of tables also settings that are no defaults, columns by role, and fingerprints of files.
    """

    g1: float
    g2: float
    g1_error: float
    g2_error: float
    covariance: tuple[tuple[float, float], tuple[float, float]]
    response: tuple[float, float] | None
    galaxies: int
    flagged: int
    # No part of the value: rows of .npy files have lost it.
    frame: str | None = field(default=None, compare=False)
    made_by: dict[str, Any] = field(default_factory=lambda: origin("shearq.mean_shear", {}), compare=False)

    def __iter__(self) -> Iterator[float]:
        return iter((self.g1, self.g2))

    def _object(self) -> dict[str, Any]:
        return asdict(self)

    def _table(self) -> tuple[str, list[str], list[list[str]], list[str]]:
        rows = [[name, f"{value:+.6f}", f"{error:.6f}"] for name, value, error in (("g1", self.g1, self.g1_error), ("g2", self.g2, self.g2_error))]
        return f"Mean shear of {self.galaxies} galaxies, {self.flagged} flagged", ["component", "shear", "error"], rows, []

    def __str__(self) -> str:
        pairs = (("g1", self.g1, self.g1_error), ("g2", self.g2, self.g2_error))
        means = ", ".join(f"{name} = {with_error(value, error)}" for name, value, error in pairs)
        frame = f", {self.frame} frame" if self.frame else ""
        return f"{means} ({self.galaxies} galaxies, {self.flagged} flagged{frame})"

    def __repr__(self) -> str:
        return f"<shearq.MeanShear {self}>"


def with_error(value: float, error: float) -> str:
    """A value and its error, to the first digit of the error, or to its second if the first is 1."""
    if not (np.isfinite(error) and error > 0):
        return f"{value:+.4g} ± {error:.1g}"
    first = int(np.floor(np.log10(error)))
    decimals = max(0, -first + (error < 2 * 10.0**first))
    return f"{value:+.{decimals}f} ± {error:.{decimals}f}"


_Whole = Literal["flags", "iterations", "stop", "updated"]


class Catalogue(np.ndarray[tuple[int], np.dtype[np.void]]):
    """A structured array with one row per galaxy, as :func:`measure` returns it.

    Each row contains its ellipticity and its response to shear, by which the ellipticity is not divided: the mean shear of any
    rows is ⟨e⟩/⟨R⟩. So rows of any catalogues can be chosen by position, sorted, joined, saved and read.

    Fields
    ------
    id : int64 or str
        If given.
    x, y : float64
        Position in pixels, if given.
    e1, e2 : float64
        Ellipticity; NaN if flagged. With a response, it is about R times a shear: :meth:`Catalogue.shear` divides.
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
        Sum of the deconvolved stamp in image units. For the linear method, flux in a Gaussian aperture.
    radius, size : float64
        Radius of the autocorrelation that is used in pixels, and its Qxx + Qyy in px². For the linear method, ``size`` is
        the standard deviation per axis, in pixels, of a Gaussian galaxy with the same moments.
    R11, R22, R12, R21 : float64
        Response of e1 and e2 to shear: R12 is the response of e1 to the second component. Only means over many galaxies are
        unbiased. NaN for networks, which have none.
    psf_e1, psf_e2, psf_sigma : float64
        The PSF in the frame of e1 and e2, by adaptive moments as of GalSim's ``FindAdaptiveMom``: ellipticity
        (1 − q)/(1 + q), and σ in pixels. :func:`bias` and :func:`null_tests` measure leakage by them.
    snr, flux_error : float64
        Flux over its error, and the error in image units. For linear configurations.
    neighbour : float64
        Light in a ring of 12 px around the galaxy over its flux. For linear configurations.
    flux_g1, …, t_rr : float64
        How flux, size and the light of the ring change with shear and noise; :meth:`Catalogue.select` uses them. For linear configurations.
    psf_id, psf_m, psf_c : float64
        A number for the star that all galaxies of the image share, and the standard deviations of m and c by its noise;
        0 without such a star. :meth:`Catalogue.mean_shear` adds them to its errors. For linear configurations.

    Attributes
    ----------
    attrs : dict
        ``submission``: name of the configuration; ``settings``: all settings as TOML; ``ellipticity``: 'shear' or
        'distortion'; ``frame``: 'pixel' or 'sky', the axes of e1 and e2; ``response``: 'not applied' if e1 and e2 are to be
        divided by the mean response; ``version``: of shearq. Nothing is computed from them.
    """

    attrs: dict[str, Any]

    def __array_finalize__(self, parent: Any) -> None:
        self.attrs = dict(getattr(parent, "attrs", {}))
        _distributed.register(type(self))

    def __array_function__(
        self, func: Any, types: Iterable[type], args: Any, kwargs: Any
    ) -> Any:
        # numpy would make a plain array of catalogues.
        plain = all(name in ("axis", "casting") or value is None for name, value in kwargs.items())
        if func is np.concatenate and args and plain:
            parts = list(args[0])
            if parts and all(isinstance(part, Catalogue) and part.dtype.names for part in parts):
                return concatenate(parts)
        return super().__array_function__(func, types, args, kwargs)

    # numpy's own overloads know no columns, and a name of whole numbers is a name.
    @overload  # type: ignore[override, unused-ignore]
    def __getitem__(self, key: _Whole) -> NDArray[np.int32]: ...  # type: ignore[overload-overlap]
    @overload
    def __getitem__(self, key: str) -> NDArray[np.float64]: ...
    @overload
    def __getitem__(self, key: int | np.integer[Any]) -> np.void: ...
    @overload
    def __getitem__(self, key: slice | list[str] | list[int] | NDArray[Any]) -> Catalogue: ...
    def __getitem__(self, key: Any) -> Any:
        found = super().__getitem__(key)
        if isinstance(found, Catalogue) and found.dtype.names is None:
            return found.view(np.ndarray)
        return found

    def __reduce__(self) -> Any:
        make, arguments, state = cast(Any, super().__reduce__())
        return make, arguments, (state, self.attrs)

    def __setstate__(self, state: Any) -> None:
        plain, self.attrs = state
        super().__setstate__(plain)

    def __repr__(self) -> str:
        names = self.dtype.names
        if names is None or self.ndim != 1:
            return super().__repr__()
        flagged = f", {int((self['flags'] != 0).sum())} flagged" if "flags" in names else ""
        return f"<shearq.Catalogue of {len(self)} galaxies{flagged}: {', '.join(names)}>"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        return _display.html(self)

    def _ipython_key_completions_(self) -> list[str]:
        return list(self.dtype.names or ())

    @property
    def good(self) -> NDArray[np.bool_]:
        """Rows without a flag: booleans of shape (n,)."""
        return np.asarray(self["flags"] == 0)

    def select(self, where: str | None = None, weight: str | None = None) -> Catalogue:
        """The galaxies of a selection, with ellipticities and responses that keep the mean shear unbiased.

        Ellipticities are multiplied by the weights. Responses contain how shear and noise change the weights. Rows with a
        flag or without weight are left out. Without a column ``id``, the result gets one: the number of the row, from 0, by which
        ``bias`` finds the same galaxies under other shears. Do not combine the result with rows of other selections.

        Parameters
        ----------
        where : str, optional
            Cuts by ``snr``, ``flux`` (image units) and ``size`` (px), such as ``"step(snr, 10) and step(size, 2.5, 0.5)"``.
            A step is a weight of 1/2 at the threshold. The third number is the distance at which it is 0 or 1: 1.5 for
            ``snr``, 1.5 errors for ``flux`` and 0.3 px for ``size`` by default. ``1 - step(size, 6)`` keeps small galaxies.
        weight : str, optional
            Smooth weight as a formula of ``snr``, ``flux`` and ``size``, such as ``"snr^2/(snr^2 + 100)"``.

        Returns
        -------
        Catalogue

        Raises
        ------
        ValueError
            If a condition cannot be read, the response of a quantity to shear is not known, the catalogue is not from a
            linear configuration, or no galaxy is left.

        Examples
        --------
        >>> image = shearq.simulate(set=2, grid=12, seed=1)[0]
        >>> catalogue = shearq.measure(image.stamps, image.psf)
        >>> bright = catalogue.select(where="step(snr, 10)").mean_shear()
        """
        missing = [name for name in _schema.SELECTED if name not in (self.dtype.names or ())]
        if missing:
            raise ValueError(
                f"catalogue: no columns {', '.join(missing[:4])}; expected the columns of a linear configuration such as 48/linear/star"
            )
        rows = np.atleast_1d(self).view(Catalogue)
        columns = {name: np.ascontiguousarray(rows[name], dtype=np.float64) for name in _schema.SELECTED}
        e1, e2, r11, r22, r12, r21, weights = _shearq.select(columns, where, weight)
        kept = weights > 0
        if not kept.any():
            raise ValueError(f"where: no galaxy is left of {int(rows.good.sum())} without a flag; expected one or more")
        chosen = rows[kept].copy()
        for k, e, response in (("1", e1, r11), ("2", e2, r22)):
            mean = float(response[kept].mean())
            if not mean > 0:
                raise ValueError(f"where: the mean response R{k}{k} of the selection is {mean:.3g}; expected a positive number")
            chosen[f"e{k}"], chosen[f"R{k}{k}"] = e[kept], response[kept]
        chosen["R12"], chosen["R21"] = r12[kept], r21[kept]
        # A second selection would need responses that the rows do not have.
        left = [name for name in chosen.dtype.names or () if name not in _schema.OBSERVED]
        found = concatenate([chosen[left]])
        return found if "id" in left else _with_ids(found, np.flatnonzero(kept))

    def mean_shear(
        self, weights: ArrayLike | None = None, *, where: str | None = None, weight: str | None = None
    ) -> MeanShear:
        """The mean shear of the good galaxies: g = (ΣwR)⁻¹ Σwe, with the ellipticities e and the 2 × 2 responses R.

        The error is that of this ratio to first order: the covariance (ΣwR)⁻¹ [Σw²(e − Rg)(e − Rg)ᵀ n/(n − 1)] (ΣwR)⁻ᵀ.
        Catalogues without R12 and R21 have a diagonal R. It assumes independent
        galaxies. If the columns ``psf_id``, ``psf_m`` and ``psf_c`` are there, the noise of stars adds to it: m·g and c
        in quadrature, times the share of the galaxies behind each star.

        Parameters
        ----------
        weights : array of shape (n,), optional
            Weight of each row, not negative, or a mask of rows. Weights must not depend on the measured shape, which
            biases the mean. Equal weights by default.
        where, weight : str, optional
            Cuts and a weight by S/N, flux and size, as for :meth:`select`. The mean stays unbiased.

        Returns
        -------
        MeanShear

        Raises
        ------
        ValueError
            If weights have another shape, no good galaxy has a positive weight, or a mean response is not positive.
        """
        if where is None and weight is None:
            return mean_shear(self, weights)
        if weights is not None:
            raise ValueError("weights: cannot be combined with where or weight; expected one of them")
        return mean_shear(self.select(where, weight))

    def shear(self, response: ArrayLike | None = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """A shear for each galaxy: g = ⟨R⟩⁻¹ e, with one mean 2 × 2 response.

        The response of one galaxy is too noisy to divide by, and that of few galaxies biases g: by 0.2 % for 40 galaxies at
        S/N 10. Join the catalogues of a survey by :func:`concatenate`, or pass the response of all.

        Parameters
        ----------
        response : array of shape (2, 2), optional
            ((R11, R12), (R21, R22)). By default the mean of the good galaxies; the unit matrix without a response.

        Returns
        -------
        g1, g2 : array of shape (n,)
            NaN if flagged.

        Raises
        ------
        ValueError
            If no galaxy is good, or the response has no positive determinant.
        """
        rows = np.atleast_1d(self).view(Catalogue)
        e, (r11, r22) = raw(rows)
        if response is None:
            if not rows.good.any():
                raise ValueError(f"catalogue: each of the {len(rows)} galaxies has a flag; expected one without")
            r12, r21 = _cross(rows)
            response = np.array([[column[rows.good].mean() for column in pair] for pair in ((r11, r12), (r21, r22))])
        matrix = double("response", response)
        if matrix.shape != (2, 2) or not np.linalg.det(matrix) > 0:
            raise ValueError(f"response: found {matrix.tolist()}; expected a 2 × 2 matrix with a positive determinant")
        g1, g2 = np.linalg.inv(matrix) @ np.stack(e)
        return g1, g2

    def columns(self, names: Literal["shearq", "anacal", "ngmix"] = "shearq") -> dict[str, NDArray[Any]]:
        """Columns by the names that a program uses.

        Parameters
        ----------
        names : {'shearq', 'anacal', 'ngmix'}
            ``'anacal'``: ``e1``, ``e2``, responses ``de1_dg1``, ``de2_dg2``, ``de1_dg2``, ``de2_dg1`` and ``flags``;
            ``'ngmix'``: ``g`` of shape (n, 2), ``R11``, ``R22``, ``R12``, ``R21`` and ``flags``. The shear is the inverse of the summed 2 × 2 responses times the summed
            ellipticities. ``'shearq'``: all columns of the catalogue.

        Returns
        -------
        dict of str to array
        """
        if names == "shearq":
            return {name: self[name] for name in self.dtype.names or ()}
        (e1, e2), (r11, r22) = raw(self)
        known = all(name in (self.dtype.names or ()) for name in ("R12", "R21"))
        cross = _cross(self) if known else []
        if names == "anacal":
            responses = {"de1_dg1": r11, "de2_dg2": r22, **dict(zip(("de1_dg2", "de2_dg1"), cross))}
            return {"e1": e1, "e2": e2, **responses, "flags": self["flags"]}
        if names == "ngmix":
            responses = {"R11": r11, "R22": r22, **dict(zip(("R12", "R21"), cross))}
            return {"g": np.stack([e1, e2], axis=-1), **responses, "flags": self["flags"]}
        raise ValueError(f"names: found {names!r}; expected 'shearq', 'anacal' or 'ngmix'")

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write a file that :func:`read` and the command line read.

        Parameters
        ----------
        path : str or path
            The ending is the format: ``.parquet``, ``.fits``, ``.ecsv`` (needs astropy) or ``.npy`` (without
            ``attrs``). Columns of words need ``.ecsv`` or ``.npy``.
        overwrite : bool
            Whether to replace a file.

        Raises
        ------
        FileExistsError
            If there is a file and ``overwrite`` is false.
        ValueError
            If the name ends otherwise.
        """
        _tables.write(self, path, overwrite)

    def to_astropy(self) -> astropy.table.Table:
        """An ``astropy.table.Table`` with units, and with ``attrs`` as ``meta`` by the keys of files."""
        return _tables.to_astropy(self)

    def to_pandas(self) -> pandas.DataFrame:
        """A ``pandas.DataFrame`` with ``attrs``."""
        return _tables.to_pandas(self)

    def to_polars(self) -> polars.DataFrame:
        """A ``polars.DataFrame``. It has no ``attrs``."""
        return _tables.to_polars(self)

    @classmethod
    def from_table(cls, table: Any, columns: Mapping[str, str] | None = None) -> Catalogue:
        """The catalogue of a table.

        Parameters
        ----------
        table : astropy, pandas, polars or Arrow table, structured array, or mapping of names to arrays
            With at least e1 and e2. Without ``flags``, rows whose ellipticity is not finite are flagged. Without
            ``R11`` and ``R22``, the ellipticities are treated as shears. Other columns are kept, and an index of pandas
            with a name. A vector ``g`` of two becomes the columns ``g[0]`` and ``g[1]``.
        columns : mapping of str to str, optional
            Names in the table of columns of the catalogue: ``{"e1": "g1_meas"}``.

        Returns
        -------
        Catalogue

        Raises
        ------
        ValueError
            If a column is absent, columns have several lengths, an earlier version divided the ellipticities by ``divisor1``
            and ``divisor2``, or an ellipticity
            without ``flags`` stands for a failed measurement (−10, −99, 1e30).
        """
        found: Catalogue = _tables.from_table(Catalogue, table, columns)
        return found

    def plot(self, kind: Literal["histogram", "map"] = "histogram", ax: Any = None) -> Any:
        """Plot the good galaxies with matplotlib.

        Parameters
        ----------
        kind : {'histogram', 'map'}
            Histograms of e1 and e2 with their mean shear, or the mean shear in cells of the field (needs x and y).
        ax : matplotlib.axes.Axes, optional
            Where to plot; a new figure by default.

        Returns
        -------
        matplotlib.axes.Axes
        """
        return _display.plot_catalogue(self, kind, ax)


def _with_ids(catalogue: Catalogue, ids: NDArray[np.intp]) -> Catalogue:
    """The catalogue with a first column ``id``."""
    kinds = [("id", np.int64), *((name, catalogue.dtype[name]) for name in catalogue.dtype.names or ())]
    found = np.empty(len(catalogue), dtype=kinds).view(Catalogue)
    found["id"] = ids
    for name in catalogue.dtype.names or ():
        found[name] = catalogue[name]
    found.attrs = dict(catalogue.attrs)
    return found


def concatenate(catalogues: Iterable[Catalogue]) -> Catalogue:
    """Join catalogues, one after the other. ``np.concatenate`` does the same.

    Parameters
    ----------
    catalogues : iterable of Catalogue
        With the same columns.

    Returns
    -------
    Catalogue
        Its ``attrs`` are those on which all agree.

    Raises
    ------
    ValueError
        If there is none, the columns differ, or one has shears and another one distortions, or another frame.
    """
    parts = list(catalogues)
    if not parts:
        raise ValueError("catalogues: found none; expected one or more")
    for k, part in enumerate(parts):
        if not isinstance(part, Catalogue):
            raise TypeError(f"catalogues: number {k} is of type {type(part).__name__}; expected Catalogue")
        differing = set(part.dtype.names or ()) ^ set(parts[0].dtype.names or ())
        if differing:
            raise ValueError(
                f"catalogues: number 0 and number {k} do not share the columns {', '.join(sorted(differing))};"
                " expected the same columns. Try: choose them by catalogue[[names]]"
            )
    kinds = {part.attrs["ellipticity"] for part in parts if "ellipticity" in part.attrs}
    if len(kinds) > 1:
        raise ValueError("catalogues: found shears and distortions; expected ellipticities of one type")
    if len({part.attrs["frame"] for part in parts if "frame" in part.attrs}) > 1:
        raise ValueError("catalogues: found ellipticities in the frames of pixels and of the sky; expected one frame")
    names = list(parts[0].dtype.names or ())
    plain = [np.atleast_1d(part.view(np.ndarray))[names] for part in parts]
    joined = np.concatenate(plain).view(Catalogue)
    first = parts[0].attrs
    joined.attrs = {
        name: value for name, value in first.items() if all(part.attrs.get(name) == value for part in parts)
    }
    return joined


def raw(rows: Catalogue) -> tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]]:
    """Ellipticities, and their responses R11 and R22; 1 in rows without a response."""
    e = [np.ascontiguousarray(rows[f"e{k}"], dtype=np.float64) for k in "12"]
    return e, [np.where(_plain(rows), 1.0, np.asarray(rows[f"R{k}{k}"], dtype=np.float64)) for k in "12"]


def _plain(rows: Catalogue) -> NDArray[np.bool_]:
    """Good rows without a response: their ellipticities are taken as shears."""
    return np.asarray(np.isnan(rows["R11"]) & np.isnan(rows["R22"]) & (rows["flags"] == 0))


def _cross(rows: Catalogue) -> list[NDArray[np.float64]]:
    """R12 and R21; 0 without the columns, and in rows without a response."""
    if not all(name in (rows.dtype.names or ()) for name in ("R12", "R21")):
        return [np.zeros(len(rows)), np.zeros(len(rows))]
    return [np.where(_plain(rows), 0.0, np.asarray(rows[name], dtype=np.float64)) for name in ("R12", "R21")]


def mean_shear(
    catalogues: Any,
    weights: ArrayLike | None = None,
    *,
    columns: Mapping[str, str] | None = None,
    where: str | None = None,
    units: str | None = None,
    drop_missing: bool = False,
    step: float = 0.01,
) -> MeanShear:
    """The mean shear of the good galaxies of one or more catalogues; see :meth:`Catalogue.mean_shear`.

    Tables of other programs are read as :func:`bias` reads them, with responses of columns or of the sheared catalogues of metacal
    and metadetect: g = ⟨R⟩⁻¹⟨e⟩, with errors from a jackknife over units.

    Parameters
    ----------
    catalogues : Catalogue or iterable of Catalogue, or tables and paths as for :func:`bias`
        Catalogues one by one, so that not all need to be in memory: :func:`measure_blocks` will do.
    weights : array of shape (n,), optional
        Weight of each row of all catalogues, one after the other. Tables have theirs in a column.
    columns, where, units, drop_missing, step
        Of tables, as for :func:`bias`.

    Returns
    -------
    MeanShear

    Raises
    ------
    ValueError
        As :meth:`Catalogue.mean_shear` or :func:`bias`; or if there is no catalogue.

    Examples
    --------
    >>> table = {"e1": [0.03, 0.05], "e2": [0.0, 0.02], "R11": [0.8, 0.8], "R22": [0.8, 0.8]}
    >>> round(shearq.mean_shear(table).g1, 6)
    0.05
    """
    if _is_of_tables(catalogues):
        if weights is not None:
            raise ValueError("weights: found for a table; expected them in a column. Try: columns={'w': NAME}")
        return _of_tables(catalogues, dict(columns=columns, where=where, units=units, drop_missing=drop_missing, step=step))
    if columns or where or units or drop_missing:
        raise ValueError("columns, where, units, drop_missing: found for catalogues of shearq; expected tables. Try: Catalogue.mean_shear")
    parts: list[list[NDArray[np.float64]]] = []
    stars: list[tuple[list[list[float]], NDArray[np.int64]]] = []
    goods: list[NDArray[np.bool_]] = []
    calibrated = False
    frames: set[str] = set()
    several: Iterable[Catalogue] = [catalogues] if isinstance(catalogues, Catalogue) else catalogues
    for rows in several:
        missing = [name for name in _schema.NEEDED if name not in (rows.dtype.names or ())]
        if missing:
            raise ValueError(f"catalogue: no columns {', '.join(missing)}; expected {', '.join(_schema.NEEDED)}")
        rows = np.atleast_1d(rows).view(Catalogue)
        e, responses = raw(rows)
        parts.append([*e, *responses, *_cross(rows)])
        stars.append(_stars(rows))
        goods.append(rows.good)
        calibrated = calibrated or bool(np.isfinite(rows["R11"]).any())
        frames.update(rows.attrs[name] for name in ("frame",) if name in rows.attrs)
        if len(frames) > 1:
            raise ValueError("catalogues: found ellipticities in the frames of pixels and of the sky; expected one frame")
    if not parts:
        raise ValueError("catalogues: found none; expected one or more")
    good = np.concatenate(goods)
    weight = _weights(weights, len(good))
    counted = good & (weight > 0)
    if len(good) == 0:
        raise ValueError("catalogue: found no galaxies; expected one or more")
    if not counted.any():
        name = "catalogue" if weights is None else "weights"
        reason = "has a flag" if weights is None else "has a flag or a weight of zero"
        raise ValueError(f"{name}: each of the {len(good)} galaxies {reason}; expected one without")
    e1, e2, *matrix = (np.ascontiguousarray(np.concatenate([part[k] for part in parts])[counted]) for k in range(6))
    if not all(np.isfinite(column).all() for column in (e1, e2, *matrix)):
        raise ValueError("catalogue: an ellipticity or response without a flag is not finite; expected flags")
    # A common factor changes nothing, but squares of weights could overflow.
    factor = weight[counted] / weight[counted].max()
    firsts = np.cumsum([0, *(len(each) for each, _ in stars)])
    places = np.concatenate([first + place for first, (_, place) in zip(firsts, stars)])[counted]
    each = [star for of_part, _ in stars for star in of_part]
    (g1, g2), (first, second), response, _, galaxies = _shearq.mean_shear(e1, e2, matrix, factor, each, places)
    errors = [float(np.sqrt(value)) for value in (first[0], second[1])]
    return MeanShear(
        g1,
        g2,
        errors[0],
        errors[1],
        ((first[0], first[1]), (second[0], second[1])),
        (response[0], response[1]) if calibrated else None,
        galaxies,
        int((weight[~good] > 0).sum()),
        next(iter(frames), None),
    )


def _is_of_tables(catalogues: Any) -> bool:
    """Whether catalogues are tables of any program or paths, or a list of them."""
    if isinstance(catalogues, (list, tuple)):
        return bool(catalogues) and not isinstance(catalogues[0], Catalogue)
    return not isinstance(catalogues, (Catalogue, Iterator)) and one_table(catalogues)


def _of_tables(catalogues: Any, settings: dict[str, Any]) -> MeanShear:
    """The mean shear is c of tables without a true shear, and without the ellipticity of the PSF, to which c would be corrected."""
    declined = dict.fromkeys(("g1", "g2", "psf_e1", "psf_e2", "psf_size"), "none")
    sums = bias_sums(catalogues, **{**settings, "columns": {**(settings["columns"] or {}), **declined}})
    found = sums.result()
    flagged, frame = sums._sums.flagged_and_frame()
    e1, e2 = found["c1_error"], found["c2_error"]
    response = (found["r1"], found["r2"]) if "r1" in found.rows[0] else None
    covariance = ((e1 * e1, float("nan")), (float("nan"), e2 * e2))
    made_by = {**found.made_by, "function": "shearq.mean_shear"}
    return MeanShear(found["c1"], found["c2"], e1, e2, covariance, response, int(found["n"]), flagged, frame, made_by)


def _stars(rows: Catalogue) -> tuple[list[list[float]], NDArray[np.int64]]:
    """Stars of a catalogue, each a number with its effects on m and c, and the place of each row's star among them."""
    if not all(name in (rows.dtype.names or ()) for name in _schema.STAR):
        return [[0.0, 0.0, 0.0]], np.zeros(len(rows), dtype=np.int64)
    _, first, place = np.unique(rows["psf_id"], return_index=True, return_inverse=True)
    stars = np.nan_to_num(np.stack([rows[name][first] for name in _schema.STAR], axis=1))
    return stars.tolist(), place.reshape(-1).astype(np.int64)


def _weights(weights: ArrayLike | None, count: int) -> NDArray[np.float64]:
    """Weights of the rows."""
    if weights is None:
        return np.ones(count)
    given = np.asarray(weights)
    weight = given.astype(np.float64) if given.dtype == bool else double("weights", given)
    if weight.shape != (count,):
        raise ValueError(
            f"weights: found an array of shape {shown(weight.shape)}; expected {shown((count,))}, one for each row"
        )
    if not (np.isfinite(weight).all() and (weight >= 0).all()):
        raise ValueError("weights: found one that is negative or not finite; expected finite ones, not negative")
    return weight


_distributed.register(Catalogue)
