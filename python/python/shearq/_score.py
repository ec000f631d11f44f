"""Ellipticities on a grid into spectra and metrics."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _display, _shearq
from ._bias import _catalogue, _paths, _several
from ._arrays import degrees, double, flat, real, shown, whole
from ._catalogue import Catalogue, raw
from ._results import Result, origin
from ._submissions import submissions
from ._tables import library
from ._warn import warn

# Pixels a side of a cell where no positions tell otherwise; it then changes no metric.
_CELL = 48.0

METRICS: dict[str, str] = {name: meaning for name, _, meaning in _shearq.metrics()}


Definition = Literal["leaderboard", "corrected"]
Frame = Literal["pandas", "polars", "list"] | None


class Score(Result):
    """Figures of merit of ellipticities against their true shear.

    ``score["q"]`` is a metric, ``score.errors["q"]`` its standard error, NaN where unknown. ``docs/scoring.md``
    derives them all.

    Attributes
    ----------
    metrics, errors : dict of str to float
        ``q``: quality factor; ``q_dn``: without the noise's power;
        ``q_calibrated``: after dividing by the measured response squared; ``m_half``: M/2;
        ``sqrt_a``: √A in 10⁻⁴ (C_ℓ in steradian); ``galaxy_noise``: noise of a calibrated ellipticity; ``m_cross``: multiplicative bias by cross-correlation; ``m1``, ``m2``, ``c1``, ``c2``: biases of
        the components; ``b_power``, ``eb_power``: mean C_ℓ of B and EB in 10⁻⁹ steradian;
        ``sigma_sys_1e4``: what Q is made of, 5·10⁻³/Q, in 10⁻⁴.
    spectrum : structured array of shape (20,)
        Per bin: ``l`` in rad⁻¹, ``dln_l``, ``modes``, ``scored``, bandpowers ℓ²C_ℓ/2π ``ee`` (with ``ee_error``), ``bb``, ``eb``,
        ``true_ee``, ``true_bb``, ``noise`` (NaN where unknown), and ``to_c_l``, by which they become C_ℓ in steradian.
    images : int
        Images averaged over.
    dropped : int
        Rows with a number that stands for a failed measurement, which drop_missing left out.
    noise_variance : float or None
        Variance of the ellipticities' noise per component, galaxy and image.
    convention : int
        The one of the challenge's eight that the metrics are in; 5 is e1 along +x, e2 along x = y.
    q_leaderboard : float
        The highest Q of all eight, as the challenge's leaderboard took it.
    truth_sign : {'standard', 'challenge'}
        The sign of truth_g2 that was used.
    correlation : float
        Of the E modes with the true ones over the scored bins.
    mean : dict or None
        Where the true shear is the same everywhere: mean ``e``, its ``error`` and the ``truth``, two components each.
    replicates : array of shape (groups, 11)
        Metrics with each group of images left out, in the order of ``metrics``; empty with one image.
    notes : list of str
        Warnings about the rows.
    made_by : dict
        Version with commit, function and settings that are no defaults.
    """

    def __init__(self, found: dict[str, Any], dropped: int, settings: dict[str, Any]) -> None:
        self.made_by = origin("shearq.score", settings)
        self.metrics: dict[str, float] = found["metrics"]
        self.errors: dict[str, float] = found["errors"]
        self.spectrum: NDArray[np.void] = _table(found["spectrum"])
        self.images: int = found["images"]
        self.dropped = dropped
        self.noise_variance: float | None = found["noise_variance"]
        self.convention: int = found["convention"]
        self.q_leaderboard: float = found["q_leaderboard"]
        self.correlation: float = found["correlation"]
        self.replicates: NDArray[np.float64] = found["replicates"]
        self.notes: list[str] = list(found["warnings"])
        constant = found["constant"]
        self.truth_sign: Literal["standard", "challenge"] = found["truth_sign"]
        self.mean: dict[str, tuple[float, float]] | None = None if constant is None else dict(zip(("e", "error", "truth"), map(tuple, constant)))
        matched, meaning = found["matched"]
        if found["matched_clearly"] and matched != self.convention:
            self.notes.append(
                f"warning: the ellipticities match the truth in convention {matched} ({meaning}), and are scored in"
                f" {self.convention}: mind the signs of e1 and e2 and the order of the axes."
            )

    def __getitem__(self, name: str) -> float:
        try:
            return self.metrics[name]
        except KeyError:
            raise KeyError(f"there is no metric {name!r}; known metrics: {', '.join(self.metrics)}") from None

    def to_dict(self) -> dict[str, float]:
        """Figures, and their errors with ``_error`` after their names."""
        errors = {f"{name}_error": error for name, error in self.errors.items()}
        return {**self.metrics, **errors}

    def _object(self) -> dict[str, Any]:
        names = ("images", "dropped", "noise_variance", "convention", "q_leaderboard", "truth_sign", "correlation", "mean", "notes")
        own = {name: getattr(self, name) for name in names}
        return {"metrics": self.metrics, "errors": self.errors, **own, "spectrum": self.spectrum, "made_by": self.made_by}

    def _table(self) -> tuple[str, list[str], list[list[str]], list[str]]:
        rows = [[name, f"{value:.5g}", f"{self.errors[name]:.2g}", METRICS[name]] for name, value in self.metrics.items()]
        return f"Score of {self.images} image{'s' * (self.images != 1)}", ["metric", "value", "error", "meaning"], rows, self.notes

    def to_frame(self, frame: Frame = None) -> Any:
        """A table of the metrics.

        Parameters
        ----------
        frame : {'pandas', 'polars', 'list'}, optional
            What to return. By default pandas, or polars if only that is installed, or else a list of dict.

        Returns
        -------
        pandas.DataFrame, polars.DataFrame or list of dict
            A row per metric: ``metric``, ``value``, ``error`` and ``meaning``.
        """
        rows = [
            {"metric": name, "value": value, "error": self.errors[name], "meaning": METRICS[name]}
            for name, value in self.metrics.items()
        ]
        return _frame(frame)(rows)

    def plot(self, ax: Any = None) -> Any:
        """Plot the EE and BB bandpowers and the true ones with matplotlib.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Where to plot; a new figure by default.

        Returns
        -------
        matplotlib.axes.Axes
        """
        return _display.plot_score(self, ax)

    def __repr__(self) -> str:
        shown = ", ".join(f"{name} = {self[name]:.4g} ± {self.errors[name]:.2g}" for name in ("q", "m_cross"))
        return f"<shearq.Score of {self.images} image{'s' * (self.images != 1)}: {shown}>"


def score(
    e1: ArrayLike,
    e2: ArrayLike,
    truth_g1: ArrayLike,
    truth_g2: ArrayLike,
    *,
    images: int | ArrayLike | None = None,
    positions: tuple[ArrayLike, ArrayLike] | None = None,
    weights: ArrayLike | None = None,
    stamp: float | None = None,
    field_degrees: float = 10.0,
    definition: Definition = "leaderboard",
    convention: int | Literal["matched", "best"] = 5,
    noise_variance: float | None = None,
    truth_sign: Literal["standard", "challenge"] | None = None,
    drop_missing: bool = False,
) -> Score:
    """Score ellipticities against the true shear.

    Parameters
    ----------
    e1, e2 : array of shape (n, n), (n²,), (images, n, n) or (images, n²); any with positions
        Ellipticities on the grid, indexed [y, x], or in that order; e1 > 0 along +x, e2 > 0 along x = y. Galaxies
        without one are NaN and count as missing.
    truth_g1, truth_g2 : array of shape (n, n) or (n²,)
        True shear on the grid, indexed [y, x].
    images : int or array, optional
        Number of images that e1 and e2 hold one after the other, or the number of its image for each value.
    positions : tuple of two arrays, optional
        x and y of each galaxy, of the shape of e1: FITS pixels, the first pixel's centre at 1. They fall into cells
        of `stamp` pixels. Arrays of two axes require `images`.
    weights : array, optional
        Weight of each galaxy, of the shape of e1, in any unit: they are divided by their mean over the galaxies with an
        ellipticity. A galaxy with a weight of zero or less counts as missing. :func:`galaxies` gives them for catalogues of
        any program.
    stamp : float, optional
        Pixels a side of a cell, with positions.
    field_degrees : float
        Side of the whole field in degrees, at most 360.
    definition : {'leaderboard', 'corrected'}
        Bandpowers and Q as the challenge's program has them, or true azimuthal averages.
    convention : int or {'matched', 'best'}
        Signs and axes of the ellipticities, 1 to 8; that which matches the truth; or that with the highest Q.
    noise_variance : float, optional
        Variance of the ellipticities' noise per component, galaxy and image, for q_dn. Measured from the scatter
        between images by default.
    truth_sign : {'standard', 'challenge'}, optional
        'challenge' if truth_g2 is minus the standard one, as in the challenge's files. The `truth.csv` that
        `simulate` writes has the standard sign. By default it is determined like on the command line: by the sign in
        which the shear is an E-mode field, or else by the sign with which e2 correlates by 5σ; required if both are
        unclear.
    drop_missing : bool
        Count galaxies with a number that stands for a failed measurement as missing: whole numbers beyond ±5, such as
        −10 or −99, and any beyond ±5000.

    Returns
    -------
    Score

    Raises
    ------
    ValueError, TypeError
        If shapes do not fit, the sign of truth_g2 is unclear, the truth is not finite or |g| ≥ 1, no galaxy has an
        ellipticity, or ellipticities are other quantities or stand for a failed measurement.

    Warns
    -----
    UserWarning
        Of missing and repeated galaxies, |e| > 1, copies of an image, constant ellipticities, a large |m|, and
        ellipticities that match the truth with other signs, swapped, shifted by a cell, or as distortions.
    """
    g1, g2 = flat("truth_g1", truth_g1), flat("truth_g2", truth_g2)
    if g1.shape != g2.shape:
        raise ValueError(f"truth_g2: found {g2.size} values; expected {g1.size}, as truth_g1 has")
    for name, truth in (("truth_g1", truth_g1), ("truth_g2", truth_g2)):
        shape = np.shape(truth)
        if len(shape) == 2 and shape[0] != shape[1]:
            raise ValueError(f"{name}: found an array of shape {shown(shape)}; expected (n, n) or (n²,)")
    n = _side("truth_g1", g1.size)
    cell, rows, where, lengths = _rows(e1, e2, n, images, positions, stamp)
    rows, dropped = _without_failures(rows) if drop_missing else (rows, 0)
    given = None if weights is None else flat("weights", weights)
    if given is not None and given.size == rows[0].size:
        if images is not None and np.ndim(images) > 0:
            # As the rows of images, which are brought together.
            given = given[np.argsort(np.asarray(images).reshape(-1), kind="stable")]
        rows, given = _weighted(rows, given)
    found = Score(
        _shearq.score(
            n,
            cell,
            degrees(field_degrees),
            (g1, g2),
            truth_sign,
            rows,
            where,
            given,
            lengths,
            _text("definition", definition),
            _text("convention", convention),
            None
            if noise_variance is None
            else real("noise_variance", noise_variance, "a finite number, zero or more", least=0.0),
        ),
        dropped,
        {
            "stamp": stamp, "field_degrees": field_degrees, "definition": definition, "convention": convention,
            "noise_variance": noise_variance, "truth_sign": truth_sign, "drop_missing": drop_missing,
        },
    )
    for note in found.notes:
        # A constant shear is no fault; the note is kept.
        if found.mean is None or not note.startswith("note: the true shear"):
            warn(note, UserWarning)
    if dropped:
        found.notes.append(f"note: {dropped} of {rows[0].size} rows stand for a failed measurement; they count as missing.")
    return found


def _weighted(rows: _Pair, weights: NDArray[np.float64]) -> tuple[_Pair, NDArray[np.float64]]:
    """Ellipticities that are NaN where the weight is zero or less, and weights with a mean of 1 over the others."""
    measured = np.isfinite(rows[0]) & np.isfinite(rows[1])
    if not np.isfinite(weights[measured]).all():
        raise ValueError("weights: found one that is not finite of a galaxy with an ellipticity; expected numbers. Try: 0 for a galaxy that does not count")
    counts = measured & (weights > 0)
    if not counts.any():
        return rows, weights
    e1, e2 = (np.where(counts, own, np.nan) for own in rows)
    mean = float(weights[counts].mean())
    # Without rounding of weights that have it already.
    scaled = weights if abs(mean - 1) < 1e-12 else weights / mean
    return (e1, e2), np.where(counts, scaled, 1.0)


class Galaxies(NamedTuple):
    """Galaxies of catalogues, an image each: shears, weights and positions, arrays with an element per galaxy."""

    e1: NDArray[np.float64]
    e2: NDArray[np.float64]
    weights: NDArray[np.float64]
    positions: tuple[NDArray[np.float64], NDArray[np.float64]]
    images: NDArray[np.int64]
    notes: list[str]


def galaxies(
    catalogues: Any,
    *,
    columns: Mapping[str, str] | None = None,
    preset: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | None = None,
    ellipticity: Literal["shear", "distortion", "responsivity"] | None = None,
    drop_missing: bool = False,
    step: float = 0.01,
) -> Galaxies:
    """Galaxies of catalogues of any program, recognised, converted and calibrated as :func:`bias` and ``shearq score`` do.

    Parameters
    ----------
    catalogues : table, path, or list of them
        As for :func:`bias`, one per image of a set, with columns of positions.
    columns, preset, ellipticity, drop_missing, step
        As for :func:`bias`.

    Returns
    -------
    Galaxies
        Arguments of :func:`score`: shears ``e1`` and ``e2`` (NaN for a galaxy that does not count), divided by the mean response of
        all; ``weights`` with a mean of 1; ``positions`` and ``images``. ``notes`` say which columns are used as what. A catalogue
        without rows is an image with one galaxy without an ellipticity, so that it counts as an image.

    Examples
    --------
    >>> table = {"x": [24.5, 72.5], "y": [24.5, 24.5], "e1": [0.04, -0.02], "e2": [0.0, 0.02], "R11": [0.5, 0.5], "R22": [0.4, 0.4]}
    >>> found = shearq.galaxies(table)
    >>> [round(float(e), 3) for e in found.e1]
    [0.08, -0.04]
    """
    given = [_catalogue(f"catalogue {number}", table) for number, table in enumerate(_several(catalogues), 1)]
    if not given:
        raise ValueError("catalogues: found none; expected at least one")
    names = [f"{role}={column}" for role, column in (columns or {}).items()]
    (x, y, e1, e2, weights), lengths, notes = _shearq.galaxies(given, names, _paths(preset), ellipticity, drop_missing, float(step))
    return Galaxies(e1, e2, weights, (x, y), np.repeat(np.arange(len(lengths)), lengths), notes)


def power_spectrum(
    e1: ArrayLike,
    e2: ArrayLike,
    *,
    field_degrees: float = 10.0,
    images: int | ArrayLike | None = None,
    positions: tuple[ArrayLike, ArrayLike] | None = None,
    stamp: float | None = None,
    cells: int | None = None,
    definition: Definition = "leaderboard",
    drop_missing: bool = False,
) -> NDArray[np.void]:
    """E, B and EB bandpowers of the mean of images.

    Parameters
    ----------
    e1, e2, field_degrees, images, positions, stamp, definition, drop_missing
        As for :func:`score`. Galaxies without an ellipticity count as zero.
    cells : int, optional
        Cells a side of the grid; required if the shapes of e1 and e2 do not contain it.

    Returns
    -------
    structured array of shape (20,)
        ``l`` in rad⁻¹, ``dln_l``, ``modes``, ``scored`` (bins 2 to 9, that Q is made of), bandpowers ℓ²C_ℓ/2π ``ee``,
        ``bb``, ``eb``, and ``to_c_l``, by which they become C_ℓ in steradian.
    """
    n = _cells(np.shape(e1), images, positions) if cells is None else whole("cells", cells, 1, 1 << 16)
    cell, rows, where, lengths = _rows(e1, e2, n, images, positions, stamp)
    rows = _without_failures(rows)[0] if drop_missing else rows
    return _table(_shearq.spectrum(n, cell, degrees(field_degrees), rows, where, lengths, _text("definition", definition)))


def aperture_mass(
    g1: ArrayLike,
    g2: ArrayLike,
    *,
    nodes: tuple[ArrayLike, ArrayLike] | None = None,
    weights: ArrayLike | None = None,
    side: int | None = None,
    field_degrees: float = 10.0,
) -> NDArray[np.void]:
    """⟨M_ap²⟩ and ξ± of galaxies on a square lattice, from exact sums over all pairs, in the 15 bins of GREAT3.

    Fourier transforms take the place of the pairs: 200,000 galaxies on the lattice of GREAT3 take a quarter of a second.

    Parameters
    ----------
    g1, g2 : array
        Shears, g2 > 0 along x = y; NaN for a galaxy that was not measured. Arrays of shape (side, side), x running
        fastest, or of any shape with ``nodes``.
    nodes : (x, y), optional
        Integer nodes of the galaxies, from 0. For the IDs of GREAT3: ``(ID // 1000 % 1000, ID % 1000)`` with side=700.
    weights : array, optional
        Weights of the galaxies, 1 unless given.
    side : int, optional
        Nodes a side of the lattice, at most 2000: required with ``nodes``.
    field_degrees : float
        Side of the field, ``side`` times the distance of neighbouring nodes.

    Returns
    -------
    structured array of shape (15,)
        Radius ``theta`` in degrees, ⟨M_ap²⟩ ``map_e``, ⟨M_×²⟩ ``map_b`` and their ``error`` by the scatter of shapes;
        ``pairs``, ``mean_r`` in degrees, ``xi_plus`` and ``xi_minus`` of the bins around the radii.

    Notes
    -----
    ⟨M_ap²⟩(R) = ∫ d ln r s²/2 (T₊(s) ξ₊ + T₋(s) ξ₋) with s = r/R (Crittenden et al. 2002, ApJ 568, 20).
    """
    rows = [flat("g1", g1), flat("g2", g2)]
    shape = np.shape(g1)
    if nodes is None:
        if len(shape) != 2 or shape[0] != shape[1]:
            raise ValueError(f"g1: found an array of shape {shown(shape)}; expected (side, side), or nodes=(x, y)")
        side = shape[0]
        where = [index.ravel() for index in np.indices(shape)[::-1]]
    else:
        if side is None:
            raise ValueError("side: expected the nodes a side of the lattice, such as 700 for GREAT3")
        where = [np.asarray(index).ravel() for index in nodes]
        if any(index.dtype.kind not in "iu" or (index < 0).any() for index in where):
            raise ValueError("nodes: expected integers from 0")
    given = np.ones(rows[0].size) if weights is None else flat("weights", weights)
    if len({values.size for values in (*rows, *where, given)}) != 1:
        raise ValueError("g1, g2, nodes, weights: lengths that differ")
    x, y = (np.ascontiguousarray(index, dtype=np.int64) for index in where)
    return _table(_shearq.aperture_mass((rows[0], rows[1]), (x, y), given, whole("side", side, 1, 2000), degrees(field_degrees)))


def compare(
    catalogues: Mapping[str, Any],
    truth: Any,
    *,
    frame: Frame = None,
    **options: Any,
) -> Any:
    """Score several catalogues of the same galaxies, side by side.

    Parameters
    ----------
    catalogues : mapping of str to Catalogue, or to a list of one per image
        What to compare; anything with ``["e1"]`` and ``["e2"]`` in the order of the grid will do. Catalogues are divided by
        the mean response of all images. The first is the one that others are held against.
    truth : tuple of two arrays, or a simulation
        True shear, as for :func:`score`, or what :func:`simulate` returned.
    frame : {'pandas', 'polars', 'list'}, optional
        What to return. By default pandas, or polars where that is there and pandas is not, or else a list.
    **options
        As for :func:`score`.

    Returns
    -------
    pandas.DataFrame, polars.DataFrame or list of dict
        A row each: ``submission``, metrics with their errors, ``q_difference`` to the first with its error, paired
        over the same images, and its significance ``sigma`` (both from eight images on), the same of calibrated Q
        (``q_calibrated_difference``, ``q_calibrated_sigma``), ``q_leaderboard``, and the metrics published for a
        submission of that name.
    """
    make = _frame(frame)
    if not isinstance(catalogues, Mapping):
        raise TypeError(f"catalogues: found {type(catalogues).__name__}; expected a mapping of names to catalogues")
    g1, g2 = (truth.g1, truth.g2) if hasattr(truth, "g1") and hasattr(truth, "g2") else _pair("truth", truth)
    published = {name: s.published for name, s in submissions().items()}
    scores: dict[str, Score] = {}
    for name, given in catalogues.items():
        parts = [given] if isinstance(given, (np.ndarray, Mapping)) or not isinstance(given, Sequence) else given
        try:
            e1, e2 = (np.stack([flat(f"catalogues[{name!r}]", part[column]) for part in parts]) for column in ("e1", "e2"))
            own = [part for part in parts if isinstance(part, Catalogue)]
            if len(own) == len(parts):
                # Of all images, component by component, as the command line divides a set.
                responses = np.concatenate([np.stack(raw(part)[1])[:, part.good] for part in own], axis=1)
                e1, e2 = e1 / responses[0].mean(), e2 / responses[1].mean()
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise ValueError(
                f"catalogues: {name!r} has no images of e1 and e2 of one length: {error}; expected catalogues"
            ) from None
        scores[name] = score(e1, e2, g1, g2, **options)
    rows = []
    first = next(iter(scores.values()), None)
    for name, scored in scores.items():
        paired: dict[str, float] = {}
        for metric, sigma in (("q", "sigma"), ("q_calibrated", "q_calibrated_sigma")):
            difference, uncertainty = _difference(metric, first, scored)
            paired[f"{metric}_difference"] = difference
            paired[f"{metric}_difference_error"] = uncertainty
            paired[sigma] = difference / uncertainty if uncertainty else math.nan
        metrics = {f"{key}_published": value for key, value in (published.get(name) or {}).items()}
        missing = {f"{key}_published": math.nan for key in ("q", "m_half", "sqrt_a")}
        rows.append(
            {
                "submission": name,
                **scored.to_dict(),
                **paired,
                "q_leaderboard": scored.q_leaderboard,
                **missing,
                **metrics,
            }
        )
    return make(rows)


def _difference(metric: str, first: Score | None, scored: Score) -> tuple[float, float]:
    """The paired difference in a metric from the first, and its error; NaN of the first itself."""
    if first is None or scored is first:
        return math.nan, math.nan
    column = list(scored.metrics).index(metric)
    paired = _shearq.difference(
        scored.images,
        first[metric],
        list(first.replicates[:, column]),
        scored[metric],
        list(scored.replicates[:, column]),
    )
    return (math.nan, math.nan) if paired is None else paired


def _frame(name: str | None) -> Any:
    if name not in (None, "pandas", "polars", "list"):
        raise ValueError(f"frame: found {name!r}; expected 'pandas', 'polars' or 'list'")
    for package in ("pandas", "polars") if name is None else (name,):
        if package == "list":
            break
        try:
            return library(package, f"frame={package!r}").DataFrame
        except ImportError:
            if name is not None:
                raise
    return list


def _table(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.void]:
    """A structured array of columns."""
    length = len(next(iter(columns.values())))
    table = np.empty(length, dtype=[(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column
    return table


def _text(name: str, value: Any) -> str:
    if isinstance(value, (str, int)) and not isinstance(value, bool):
        return str(value)
    raise TypeError(f"{name}: found {type(value).__name__}; expected a name or a number")


def _side(name: str, cells: int) -> int:
    side = math.isqrt(cells)
    if side * side != cells:
        raise ValueError(f"{name}: found {cells} values; expected those of a square grid, n²")
    return side


def _pair(name: str, value: Any) -> tuple[Any, Any]:
    try:
        first, second = value
    except (TypeError, ValueError):
        raise ValueError(f"{name}: found {type(value).__name__}; expected two arrays") from None
    return first, second


def _cells(shape: tuple[int, ...], images: Any, positions: Any) -> int:
    """Cells a side of the grid of an array of this shape."""
    if positions is not None or (images is not None and np.ndim(images) != 0):
        raise ValueError("cells: not given; expected the cells a side of the grid, which positions do not tell")
    if images is not None:
        number = whole("images", images, 1, 1 << 32)
        return _side("e1", math.prod(shape) // number)
    if len(shape) == 3 or (len(shape) == 2 and shape[0] == shape[1]):
        return shape[-1]
    return _side("e1", shape[-1] if shape else 1)


_Pair = tuple[NDArray[np.float64], NDArray[np.float64]]


def _without_failures(rows: _Pair) -> tuple[_Pair, int]:
    """The rows with NaN for those that stand for a failed measurement, and their number."""
    failed = _shearq.failed(rows[0]) | _shearq.failed(rows[1])
    return (np.where(failed, np.nan, rows[0]), np.where(failed, np.nan, rows[1])), int(failed.sum())


def _rows(
    e1: ArrayLike, e2: ArrayLike, n: int, images: Any, positions: Any, stamp: float | None
) -> tuple[float, _Pair, _Pair | None, list[int]]:
    """Pixels a side of a cell, the ellipticities and positions image by image, and how many each image has."""
    e1, e2 = double("e1", e1), double("e2", e2)
    if e1.shape != e2.shape:
        raise ValueError(f"e2: found an array of shape {shown(e2.shape)}; expected {shown(e1.shape)}, as e1 has")
    cells, cell, where = n * n, _CELL, None
    if positions is not None:
        x, y = (double("positions", each) for each in _pair("positions", positions))
        if x.shape != e1.shape or y.shape != e1.shape:
            raise ValueError(
                f"positions: found arrays of shapes {shown(x.shape)} and {shown(y.shape)}; expected {shown(e1.shape)}, as e1 has"
            )
        if stamp is None:
            raise ValueError("stamp: not given; expected the pixels a side of a cell, with positions")
        where = (x.reshape(-1), y.reshape(-1))
    if stamp is not None:
        cell = real("stamp", stamp, "a positive number of pixels")
    rows = (e1.reshape(-1), e2.reshape(-1))
    if images is not None and np.ndim(images) > 0:
        labels = np.asarray(images)
        if labels.dtype.kind not in "iu" or labels.shape != e1.shape:
            raise ValueError(
                f"images: found {labels.dtype} of shape {shown(labels.shape)}; expected one number, or whole numbers of shape {shown(e1.shape)}, as e1 has"
            )
        labels = labels.reshape(-1)
        order = np.argsort(labels, kind="stable")
        rows = (rows[0][order], rows[1][order])
        where = None if where is None else (where[0][order], where[1][order])
        lengths = np.unique(labels, return_counts=True)[1].tolist()
    elif images is not None:
        number = whole("images", images, 1, 1 << 32)
        if e1.size % number != 0:
            raise ValueError(f"images: found {number}; expected a divisor of the {e1.size} values of e1")
        lengths = [e1.size // number] * number
    elif where is not None:
        if e1.ndim != 1:
            raise ValueError(
                f"images: not given; expected the number of images in arrays of shape {shown(e1.shape)} with positions:"
                f" images=1 for one image, images={e1.shape[0] if e1.ndim else 1} for one per row"
            )
        lengths = [e1.size]
    elif e1.shape in ((n, n), (cells,)):
        lengths = [cells]
    else:
        lengths = [cells] * (e1.size // cells if cells else 0)
        if e1.shape not in ((len(lengths), cells), (len(lengths), n, n)):
            raise ValueError(
                f"e1: found an array of shape {shown(e1.shape)}; expected ({n}, {n}), ({cells},), or (images, {n}, {n}), (images, {cells}), as the grid has {n} × {n} cells"
            )
    if where is None and any(length != cells for length in lengths):
        raise ValueError(
            f"e1: found an image of {next(length for length in lengths if length != cells)} values; expected {cells}, as the grid has, or positions"
        )
    return cell, rows, where, lengths
