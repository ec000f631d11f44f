"""Multiplicative and additive bias of any shear catalogue."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, Union

import numpy as np

from . import _display, _hdf5, _shearq
from ._arrays import shown
from ._results import Result, origin, write
from ._tables import _EXACT, is_missing, library, named_columns, narrowed

Design = Literal["single", "pairs", "shears", "fields", "galaxies", "rotated"]
Bins = Union[str, tuple[str, Union[int, Sequence[float]]]]


class Bias(Result):
    """Multiplicative and additive bias with errors, of all galaxies and of bins.

    Attributes
    ----------
    rows : list of dict
        All galaxies first, then each bin: ``bin``, ``n``, ``m1``, ``m1_error``, ``c1`` and so on, as the command line's
        JSON has them. None is a quantity that the data do not determine.
    notes : list of str
        Design, units of the errors, rows that do not count, and requirements that are met or not.
    binned : str
        The binned column or expression; empty without bins.

    made_by : dict
        Version with commit, settings that are no defaults, columns by role, and fingerprints of files.

    ``bias["m1"]`` is the value of all galaxies. With ``against``, rows are those of both catalogues and of the difference.
    """

    __slots__ = ("_against", "_sums", "_text", "binned", "made_by", "notes", "rows")

    rows: list[dict[str, Any]]
    notes: list[str]
    binned: str
    made_by: dict[str, Any]

    def __init__(self, sums: BiasSums, against: BiasSums | None = None) -> None:
        self._sums, self._against = sums, against
        text, self._text = sums._sums.result(None if against is None else against._sums)
        found = json.loads(text)
        self.rows, self.notes, self.binned = found["rows"], found["notes"], found["binned"]
        self.made_by = sums._made_by

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return Bias, (self._sums, self._against)

    def __getitem__(self, key: str) -> float:
        value = self.rows[0][key]
        return float("nan") if value is None else float(value)

    def _ipython_key_completions_(self) -> list[str]:
        return [key for key, value in self.rows[0].items() if isinstance(value, (int, float))]

    def __str__(self) -> str:
        return self._text

    def __repr__(self) -> str:
        known = [key for key in ("m1", "m2", "c1", "c2") if self[key] == self[key]]
        shown = [f"{key} = {self[key]:+.4f} ± {self[key + '_error']:.4f}" for key in known]
        return f"<shearq.Bias {', '.join(shown)}, n = {self['n']:.0f}>"

    def _object(self) -> dict[str, Any]:
        return {"title": "Shear bias", "rows": self.rows, "notes": self.notes, "binned": self.binned, "made_by": self.made_by}

    def _table(self) -> tuple[str, list[str], list[list[str]], list[str]]:
        keys = ("m1", "m2", "c1", "c2")

        def cell(row: dict[str, Any], key: str) -> str:
            value, error = row.get(key), row.get(f"{key}_error")
            return "" if value is None or error is None else f"{value:+.4f} ± {error:.4f}"

        # Rows of two catalogues say of which they are.
        names = [name for name in ("of", "catalogues", "bin") if name in self.rows[0]]
        rows = [[*(str(row[name]) for name in names), "" if row["n"] is None else f"{row['n']:.0f}", *(cell(row, key) for key in keys)] for row in self.rows]
        return "Shear bias", [*names, "galaxies", *keys], rows, self.notes

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the result as JSON (.json), as the command line's page (.html) or plot (.pdf, .png, .svg), or as a table with all
        columns (.csv, .md, .tex, .txt). A file of this name is replaced.

        Raises
        ------
        ValueError
            If the name has another ending.
        """
        if os.fspath(path).lower().endswith(".json"):
            write(path, {".json": lambda: self.to_json() + "\n"})
            return
        made_by = [(name.capitalize(), value if isinstance(value, str) else json.dumps(value)) for name, value in self.made_by.items()]
        self._sums._sums.save(os.fspath(path), None if self._against is None else self._against._sums, made_by)

    def to_frame(self) -> Any:
        """The rows as a pandas frame."""
        return library("pandas", "to_frame").DataFrame(self.rows)

    def plot(self, quantity: Literal["m", "c"] = "m", limit: float | None = None, ax: Any = None) -> Any:
        """Plots m or c of both components in bins with error bars, and a band of ±limit. Needs matplotlib.

        limit is 0.002 for m and 0.0002 for c unless given, the tightest requirements that are published. ``save("bias.svg")``
        writes the plot of the command line, which needs no matplotlib.
        """
        return _display.plot_bias(self, quantity, limit, ax)


class BiasSums:
    """Sums of catalogues that add up: ``a + b`` has the catalogues of b after those of a.

    Sums are small (megabytes for any number of rows) and can be pickled, so each worker of a cluster may sum its own
    catalogues.
    """

    __slots__ = ("_made_by", "_sums")

    def __init__(self, sums: _shearq.BiasSums, made_by: dict[str, Any]) -> None:
        self._sums, self._made_by = sums, made_by

    def __add__(self, other: BiasSums) -> BiasSums:
        return BiasSums.merge([self, other])

    @staticmethod
    def merge(parts: Iterable[BiasSums]) -> BiasSums:
        """The sums of all parts, in their order."""
        given = list(parts)
        if not given:
            raise ValueError("parts: found none; expected the sums of one or more catalogues")
        first, *others = given
        inputs = {path: print for part in (first, *others) for path, print in part._made_by["inputs"].items()}
        return BiasSums(first._sums.append([part._sums for part in others]), {**first._made_by, "inputs": inputs})

    def __radd__(self, other: int) -> BiasSums:
        # sum() begins with 0.
        return self if other == 0 else NotImplemented

    def __reduce__(self) -> tuple[Any, tuple[str, dict[str, Any]]]:
        return _restored, (self._sums.to_json(), self._made_by)

    def result(self) -> Bias:
        """The bias, with errors from a jackknife over units."""
        return Bias(self)


def _restored(text: str, made_by: dict[str, Any]) -> BiasSums:
    return BiasSums(_shearq.BiasSums.from_json(text), made_by)


def bias(
    catalogues: Any,
    *,
    against: Any = None,
    g1: float | Sequence[float] | None = None,
    g2: float | Sequence[float] | None = None,
    truth: str | os.PathLike[str] | None = None,
    columns: Mapping[str, str] | None = None,
    preset: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | None = None,
    ellipticity: Literal["shear", "distortion", "responsivity"] | None = None,
    truth_sign: Literal["standard", "challenge"] | None = None,
    bins: Bins | Sequence[Bins] | None = None,
    like: Any = None,
    tomography: str | None = None,
    where: str | None = None,
    unsheared: str | Sequence[str] | None = None,
    weight: str | None = None,
    design: Design | None = None,
    units: str | None = None,
    paired: bool = False,
    drop_missing: bool = False,
    step: float = 0.01,
) -> Bias:
    """Multiplicative and additive bias (m and c) of any program's catalogues, as ``shearq bias`` estimates it.

    Parameters
    ----------
    catalogues
        A table or a list of tables: mappings of columns, structured arrays, ``shearq.Catalogue``, astropy tables, pandas
        or polars frames, tables, datasets and streams of Arrow (duckdb), HDUs, catalogues of GalSim and TreeCorr, groups of h5py, or paths of files and of folders that ``measure``
        wrote. ``FILE:GROUP`` names a group of an HDF5 file whose datasets are columns, or a dataset of rows with fields; groups ``noshear`` (``ns``, ``00``), ``1p``,
        ``1m``, ``2p`` and ``2m`` in it are sheared catalogues. Columns are ``e1 e2``, optionally ``w R11 R22 flag id snr ...`` and the true shear ``g1 g2``. Columns of GalSim's HSM,
        ngmix metacal, metadetect and AnaCal are recognised.
    against : as catalogues, optional
        Catalogues of another method for the same galaxies: the result has their rows and the difference with its error, which is
        smaller than that of two results because both have the same shapes.
    g1, g2 : float or sequence of float
        True shear of all catalogues, or of each. By default it is in the columns g1 and g2.
    truth : path
        Table of true shears with the columns id, g1, g2 or x, y, g1, g2.
    columns : mapping
        Names of columns by role, such as ``{"e1": "g_1", "w": "weight"}``; ``"none"`` ignores a column, and ``"g[0]"`` is
        the first number of a vector. Formulas such as ``"Q1/P"`` or ``"flags & 4"`` make columns. No column may have two
        roles. Roles:

        * ``e1 e2`` ellipticity, ``w`` weight, ``flag`` (0 for good rows), ``id`` of the galaxy, ``unit`` of the errors;
        * ``R11 R22 R12 R21`` response, R12 that of e1 to g2; ``dw1 dw2`` derivatives of the weight;
        * ``rms_e sigma_e`` standard deviation of a distortion without noise, and its noise, for ``'responsivity'``;
          ``ksb_e1 ksb_e2`` shears of rows without a distortion;
        * ``g1 g2`` true shear, ``x y`` position (px), ``psf_e1 psf_e2 psf_size`` of the PSF;
        * ``version`` (noshear, 1p, 1m, 2p, 2m), or ``e1_1p e1_1m e2_2p e2_2m e1_2p e1_2m e2_1p e2_1m`` under artificial
          shears.
    preset : path, or several
        Files that describe surveys, whose columns are then recognised, as for ``shearq bias --preset``: TOML with a table
        ``[[survey]]`` of each, with ``name``, ``ellipticity`` ("shear" or "distortion"), ``required`` (columns that a
        catalogue of it has in addition to e1 and e2) and ``[survey.columns]``, a column, a formula or "none" by role. A
        catalogue of the survey must have all of these columns.
    ellipticity : {'shear', 'distortion', 'responsivity'}
        Type of e1 and e2; recognised by default. ``'distortion'`` converts each to a shear, ``'responsivity'`` divides the
        mean distortion by 2(1 − ⟨e_rms²⟩), with e_rms in ``rms_e``, or else e_rms² = ⟨χ²⟩/2 − ⟨σ²⟩ with σ in ``sigma_e``.
    truth_sign : {'standard', 'challenge'}, optional
        Sign of the true g2. By default, for a table with a shear per galaxy: as the file states, else (for x, y, g1, g2)
        the sign in which the shear is an E-mode field, else the sign with which e2 correlates at 5σ; required if these are unclear.
        Other shears are standard.
    bins : str, (str, int or sequence of float), or a list of up to three
        Also estimate in bins of a column or expression: ``("snr", 5)`` has five bins with equally many galaxies,
        ``("flux / flux_error", [5, 10, 20])`` has these edges (each bin contains its lower edge), and ``"TOMOBIN"`` a bin
        for each number or text. Several quantities are binned together. The response is that of each bin.
    like : table or path
        A survey with the binned columns: the simulated galaxies are weighted to its distribution in the bins, and the rows
        after the first are those of the survey.
    tomography : str
        Column of the survey's tomographic bins, for a row of each; by default a column such as TOMOBIN or zbin.
    where : str
        Use only galaxies for which this holds, such as ``"snr > 10 and size < 4"``. Catalogues of shearq's linear
        configurations can also be cut by steps, such as ``"step(snr, 10) and step(size, 2.5)"``, as for
        :meth:`Catalogue.select`: m contains no effect of this selection.
    unsheared : str, or several
        Columns of `where` and `bins` that shear does not change, because they were not measured on images of the galaxies, such
        as a redshift of another survey.
    weight : str
        A weight by S/N, flux and size of the same catalogues.
    design : str
        How catalogues belong together; recognised from the true shears.
    units : str
        Independent units of the errors: ``"rows"``, ``"catalogues"`` or a column.
    paired : bool
        Use only galaxies that count under all test shears. m then does not contain how shear changes which galaxies are
        selected.
    drop_missing : bool
        Leave out rows with missing numbers, with numbers that stand for a failed measurement (−10, −99, 1e30), or without
        a true shear. The notes count them.
    step : float
        Artificial shear of metacalibration.

    Raises
    ------
    ValueError
        If a column is absent or has two roles, a number is missing or stands for a failed measurement in a row without a
        flag, the ellipticities do not follow the true shear, the sign of g2 in the file of `truth` is unclear, or a mean
        response has less than five standard errors.
    """
    settings: dict[str, Any] = dict(
        g1=g1,
        g2=g2,
        truth=truth,
        columns=columns,
        preset=preset,
        ellipticity=ellipticity,
        truth_sign=truth_sign,
        bins=bins,
        like=like,
        tomography=tomography,
        where=where,
        unsheared=unsheared,
        weight=weight,
        design=design,
        units=units,
        paired=paired,
        drop_missing=drop_missing,
        step=step,
    )
    sums = bias_sums(catalogues, **settings)
    return Bias(sums, None if against is None else bias_sums(against, **settings))


def bias_sums(
    catalogues: Any,
    *,
    g1: float | Sequence[float] | None = None,
    g2: float | Sequence[float] | None = None,
    truth: str | os.PathLike[str] | None = None,
    columns: Mapping[str, str] | None = None,
    preset: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | None = None,
    ellipticity: Literal["shear", "distortion", "responsivity"] | None = None,
    truth_sign: Literal["standard", "challenge"] | None = None,
    bins: Bins | Sequence[Bins] | None = None,
    like: Any = None,
    tomography: str | None = None,
    where: str | None = None,
    unsheared: str | Sequence[str] | None = None,
    weight: str | None = None,
    design: Design | None = None,
    units: str | None = None,
    paired: bool = False,
    drop_missing: bool = False,
    step: float = 0.01,
) -> BiasSums:
    """Sums of catalogues, to be added to those of other catalogues; the parameters are those of ``bias``.

    Bins need edges, because all sums must have the same bins. Sums of two catalogues, as two workers would return them:

    >>> plus = shearq.bias_sums({"e1": [0.03, 0.01, 0.02], "e2": [0.01, -0.01, 0.01]}, g1=0.02, g2=0.0)
    >>> minus = shearq.bias_sums({"e1": [-0.01, -0.03, -0.02], "e2": [0.01, -0.01, 0.01]}, g1=-0.02, g2=0.0)
    >>> round(abs(shearq.BiasSums.merge([plus, minus]).result()["m1"]), 6)
    0.0
    """
    if not (np.isfinite(step) and step > 0):
        raise ValueError(f"step: found {step!r}; expected a positive number")
    tables = list(_several(catalogues))
    # Of files, the extension module compares the metadata.
    stated = [attrs for table in tables if isinstance(attrs := getattr(table, "attrs", None), Mapping)]
    frames = sorted({attrs["frame"] for attrs in stated if "frame" in attrs})
    if len(frames) > 1:
        raise ValueError(f"catalogues: found ellipticities in the frames {' and '.join(frames)}; expected one frame")
    roles = [f"{role}={column}" for role, column in (columns or {}).items()]
    presets = _paths(preset)
    binned = _bins(bins)

    def needed(names: Sequence[str]) -> list[str]:
        return _shearq.needed_columns(names, roles, presets, [of for of, *_ in binned], where, weight, units)

    given = [_catalogue(f"catalogue {number}", table, needed) for number, table in enumerate(tables, 1)]
    if not given:
        raise ValueError("catalogues: found none; expected at least one")
    found = _shearq.bias_sums(
        given,
        roles,
        presets,
        _truth(g1, g2, truth, given),
        ellipticity,
        truth_sign,
        binned,
        None if like is None else _catalogue("like", like),
        tomography,
        where,
        [unsheared] if isinstance(unsheared, str) else list(unsheared or ()),
        weight,
        design,
        units,
        paired,
        drop_missing,
        float(step),
    )
    settings = {
        "g1": g1, "g2": g2, "truth": truth, "columns": columns, "preset": preset, "ellipticity": ellipticity, "truth_sign": truth_sign, "bins": bins,
        "like": like, "tomography": tomography, "where": where, "unsheared": unsheared, "weight": weight, "design": design, "units": units,
        "paired": paired, "drop_missing": drop_missing, "step": step,
    }
    paths = [own if isinstance(own, str) else own[0] for own in given] + presets + ([] if truth is None else [os.fspath(truth)])
    return BiasSums(found, origin("shearq.bias", settings, paths, dict(found.columns())))


def _paths(given: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | None) -> list[str]:
    several = [given] if isinstance(given, (str, os.PathLike)) else list(given or [])
    return [os.fspath(path) for path in several]


def _several(catalogues: Any) -> Iterable[Any]:
    return [catalogues] if one_table(catalogues) else catalogues


def one_table(catalogues: Any) -> bool:
    """Whether this is one table or path, and no sequence of them."""
    if isinstance(catalogues, (str, os.PathLike, Mapping, np.ndarray)) or not isinstance(catalogues, Iterable):
        return True
    # Of the class, because a LazyFrame warns if it is asked for its columns.
    tables = ("columns", "colnames", "schema", "__arrow_c_stream__", "__dask_graph__", "header", "names", "fields")
    return any(hasattr(type(catalogues), name) for name in tables) or hasattr(catalogues, "writeto")


def _catalogue(
    name: str, table: Any, needed: Callable[[Sequence[str]], list[str]] | None = None
) -> str | tuple[str, list[tuple[str, Any]], list[tuple[str, str]]]:
    """A path, or a name with columns of float64 or of text, and the names of those that are not needed, or that have something else
    in each row, with what that is."""
    source = table
    if isinstance(table, (str, os.PathLike)):
        path = os.fspath(table)
        if not _hdf5.is_hdf5(path):
            return path
        name, table = path, _hdf5.table(path, path)
    elif _hdf5.is_group(table):
        table = _hdf5.table(table, name)
    unread: list[tuple[str, str]] = []
    try:
        if needed is not None:
            table, unneeded = narrowed(table, needed)
            unread = [(label, "") for label in unneeded]
        given = named_columns(table)
    except TypeError as error:
        if "Try: " in str(error):
            raise TypeError(f"{name}: {error}") from None
        given = []
    columns: list[tuple[str, Any]] = []
    for label, own in given:
        values = _values(own)
        if values is None:
            # Columns that were dropped without a word gave m = −0.055 for 0.050.
            unread.append((label, _described(own)))
        else:
            columns.append((label, values))
    if isinstance(table, _hdf5.Hdf5Table):
        unread += table.partial.items()
    if not columns:
        found, remedy = _no_table(source)
        raise ValueError(f"{name}: found {found} without columns of numbers; expected a table with e1 and e2{remedy}")
    return name, columns, unread


def _no_table(source: Any) -> tuple[str, str]:
    """What an object without columns is, and what makes a table of it."""
    kind = type(source).__name__
    if isinstance(source, (str, os.PathLike)) or _hdf5.is_group(source):
        return "an HDF5 group", _hdf5.listing(source)
    if isinstance(source, np.ndarray):
        columns = source.ndim == 2 and source.shape[1] > 1
        return f"an array of shape {shown(source.shape)}", ". Try: {'e1': array[:, 0], 'e2': array[:, 1]}" if columns else ""
    if isinstance(source, Mapping) and source and all(np.ndim(value) == 0 for value in source.values()):
        return f"a {kind} of one row", ". Try: pandas.DataFrame(rows)"
    if hasattr(source, "to_table"):
        return kind, ". Try: .to_table() of it"
    if hasattr(source, "read") and hasattr(source, "schema_arrow"):
        return kind, ". Try: .read() of it, or the path of the file"
    if hasattr(source, "fetchnumpy"):
        # Of duckdb.
        return kind, ". Try: connection.sql(QUERY), not execute"
    return kind, ""


def _values(column: Any) -> Any:
    """A contiguous column of float64 with NaN for missing numbers, a list of text, or None for anything else. Integers
    that float64 does not contain, such as identifiers of Rubin and 64 bits of flags, stay integers, or become text if some
    are missing; missing texts are empty."""
    if column.ndim != 1:
        return None
    missing = np.zeros(len(column), dtype=bool)
    if isinstance(column, np.ma.MaskedArray):
        missing = np.ma.getmaskarray(column)
        column = column.data
    array = np.asarray(column)
    if array.dtype.kind == "O":
        missing = missing | np.array([is_missing(value) for value in array], dtype=bool)
        present = array[~missing]
        if all(isinstance(value, (int, np.integer)) for value in present):
            filled = [0 if gone else int(value) for gone, value in zip(missing, array)]
            array = np.array(filled, dtype=object if max(map(abs, filled), default=0) > _EXACT else np.float64)
        elif not all(isinstance(value, (str, bytes)) for value in present):
            try:
                array = np.array([np.nan if gone else value for gone, value in zip(missing, array)], dtype=np.float64)
            except (TypeError, ValueError):
                return None
    if array.dtype.kind in "iu" and array.size:
        known = array[~missing] if missing.any() else array
        if known.size and max(int(known.max()), -int(known.min())) > _EXACT:
            if not missing.any():
                return np.ascontiguousarray(array, dtype=np.uint64 if array.dtype.kind == "u" else np.int64)
            array = array.astype(object)
    if array.dtype.kind in "fiub":
        reals = np.ascontiguousarray(array, dtype=np.float64)
        return np.where(missing, np.nan, reals) if missing.any() else reals
    if array.dtype.kind in "USO":
        texts = (value.decode(errors="backslashreplace") if isinstance(value, bytes) else str(value) for value in array.tolist())
        return ["" if gone else text for gone, text in zip(missing, texts)]
    return None


def _described(column: Any) -> str:
    """What a column is that has no number or text in each row."""
    if column.ndim == 0:
        return f"is a single {type(column.item()).__name__}"
    if column.ndim > 1:
        return f"has the shape {shown(column.shape)}"
    if column.dtype.kind != "O":
        return f"has values of type {column.dtype}"
    kinds = sorted({type(value).__name__ for value in column if not is_missing(value)})
    return f"has values of type {', '.join(kinds)}" + (" of different shapes" if kinds in (["list"], ["ndarray"]) else "")


def _truth(g1: Any, g2: Any, truth: Any, given: list[Any]) -> Any:
    if (g1 is None) != (g2 is None):
        raise ValueError("g1, g2: found only one; expected both or none")
    if any(np.ma.is_masked(g) for g in (g1, g2)):
        raise ValueError("g1, g2: found masked values; expected a true shear for each catalogue")
    if truth is not None:
        if g1 is not None:
            raise ValueError("truth: found with g1 and g2; expected one of them")
        return os.fspath(truth)
    if g1 is None:
        return None
    if np.ndim(g1) == 0 and np.ndim(g2) == 0:
        if not np.hypot(float(g1), float(g2)) < 1:
            raise ValueError(f"g1, g2: found {g1!r} and {g2!r}; expected a shear with a modulus below 1")
        return (float(g1), float(g2))
    both = [np.broadcast_to(np.asarray(g, dtype=np.float64), (len(given),)) if np.ndim(g) == 0 else np.asarray(g) for g in (g1, g2)]
    for name, values in zip(("g1", "g2"), both):
        if values.shape != (len(given),):
            raise ValueError(
                f"{name}: found shape {values.shape}; expected a number, or one per catalogue ({len(given)})."
                " A true shear per galaxy belongs into the columns g1 and g2"
            )
    names = [each if isinstance(each, str) else each[0] for each in given]
    return [(name, float(a), float(b)) for name, a, b in zip(names, *both)]


def _bins(bins: Any) -> list[tuple[str, int | None, list[float]]]:
    """Each quantity with a number of bins or edges; without both, a bin for each value."""
    if bins is None:
        return []
    if isinstance(bins, str):
        return [(bins, None, [])]
    # A list of quantities, or one as a pair of a name and a number or edges.
    is_list = isinstance(bins, (list, tuple)) and all(
        isinstance(own, str) or isinstance(own, tuple) and own and isinstance(own[0], str) for own in bins
    )
    return [_axis(own) for own in (bins if is_list else [bins])]


def _axis(bins: Any) -> tuple[str, int | None, list[float]]:
    if isinstance(bins, str):
        return bins, None, []
    try:
        of, edges = bins
    except (TypeError, ValueError):
        raise ValueError(f"bins: found {bins!r}; expected (expression, number or edges)") from None
    if isinstance(edges, (int, np.integer)):
        return str(of), int(edges), []
    return str(of), None, [float(edge) for edge in edges]
