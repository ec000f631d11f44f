"""Catalogues as tables of other packages and in files. The class of catalogues imports this module, and is passed to it."""

from __future__ import annotations

import collections
import importlib
import math
import os
import pathlib
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from . import _hdf5, _schema, _shearq
from ._arrays import MAX_VECTOR

if TYPE_CHECKING:
    import astropy.table
    import pandas
    import polars


# Largest whole number up to which a double has all of them.
_EXACT = 2**53
_FORMATS = {".parquet": "parquet", ".pq": "parquet", ".fits": "fits", ".fit": "fits", ".ecsv": "ecsv", ".npy": "npy"}


def library(name: str, task: str) -> Any:
    """The module of a package, or an ImportError that says what needs it and how to get it."""
    package = name.partition(".")[0]
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != package:
            raise
        raise ModuleNotFoundError(f"{task} needs {package}. Try: pip install {package}", name=package) from None


def _columns(catalogue: Any) -> dict[str, Any]:
    """Columns by name, each in memory of its own."""
    return {name: np.ascontiguousarray(catalogue[name]) for name in catalogue.dtype.names or ()}


def to_astropy(catalogue: Any) -> astropy.table.Table:
    meta = {key: _schema.in_header(value) for key, value in _schema.to_keys(catalogue.attrs).items()}
    table: astropy.table.Table = library("astropy.table", "to_astropy").Table(_columns(catalogue), meta=meta)
    units = dict(_schema.UNITS)
    # The linear method has a standard deviation there, and the network a sum of moments.
    if "snr" in table.colnames or "iterations" in table.colnames:
        units["size"] = "pix" if "snr" in table.colnames else "pix2"
    for name, unit in units.items():
        if name in table.colnames:
            table[name].unit = unit
    return table


def to_pandas(catalogue: Any) -> pandas.DataFrame:
    frame: pandas.DataFrame = library("pandas", "to_pandas").DataFrame(_columns(catalogue))
    frame.attrs.update(catalogue.attrs)
    return frame


def to_polars(catalogue: Any) -> polars.DataFrame:
    frame: polars.DataFrame = library("polars", "to_polars").DataFrame(_columns(catalogue))
    return frame


def named_columns(table: Any) -> list[tuple[str, Any]]:
    """The columns of a table of any package by name, and ``g[0]`` and ``g[1]`` of a vector ``g``.

    Raises TypeError for anything that is no table.
    """
    found: list[tuple[Any, Any]] = []
    table = _plain_table(narrowed(table)[0])
    if isinstance(table, np.ndarray):
        if table.dtype.names is None:
            raise TypeError("table: found an array without fields; expected a structured array")
        found = [(name, table[name]) for name in table.dtype.names]
    elif isinstance(table, Mapping):
        found = _of_one_length(table)
    elif hasattr(table, "num_columns") and hasattr(table, "schema"):
        # Tables and record batches of Arrow.
        found = [(name, table.column(name)) for name in table.schema.names]
    else:
        # pandas and polars have `columns`, and astropy has `colnames`.
        names = getattr(table, "colnames", getattr(table, "columns", None))
        if names is None:
            raise TypeError(f"table: found {type(table).__name__}; expected a table with columns")
        _check_names(names)
        if getattr(names, "nlevels", 1) > 1:
            raise TypeError(
                f"table: found columns of {names.nlevels} levels, such as {names[0]}; expected names."
                " Try: frame.columns = ['_'.join(map(str, name)) for name in frame.columns]"
            )
        # An index of pandas with a name is a column, such as the identifier of the galaxy.
        index: Any = getattr(table, "index", None)
        own = [name for name in getattr(index, "names", ()) if name is not None and name not in names]
        found = [(name, index.get_level_values(name)) for name in own]
        found += [(name, table[name]) for name in names]
    return [part for name, column in found for part in _components(str(name), _in_memory(column))]


def narrowed(table: Any, needed: Callable[[Sequence[str]], Sequence[str]] = list) -> tuple[Any, list[str]]:
    """A table in memory without the columns of numbers that are not `needed`, and their names, if columns can be read one by
    one: frames of polars, datasets, tables and streams of Arrow, and groups of HDF5 files."""
    if hasattr(type(table), "__dask_graph__"):
        raise TypeError(_of_dask(table))
    choose: Callable[[list[str]], Any]
    if isinstance(table, _hdf5.Hdf5Table):
        names, numbers, choose = list(table), table.numbers(), table.select
    elif hasattr(table, "collect_schema"):
        (names, numbers), choose = _schema_of(table.collect_schema().items()), lambda own: table.lazy().select(own).collect()
    elif hasattr(table, "scanner"):
        (names, numbers), choose = _schema_of(zip(table.schema.names, table.schema.types)), lambda own: table.to_table(columns=own)
    elif hasattr(table, "num_columns") and hasattr(table, "schema"):
        (names, numbers), choose = _schema_of(zip(table.schema.names, table.schema.types)), table.select
    elif hasattr(table, "__arrow_c_stream__") and not hasattr(type(table), "__array__"):
        pyarrow = library("pyarrow", "this table")
        stream = pyarrow.RecordBatchReader.from_stream(table)
        # Batch by batch: of a relation of duckdb with 66 columns and 2 million rows, 1.1 GB instead of 3.0 GB.
        (names, numbers), choose = _schema_of(zip(stream.schema.names, stream.schema.types)), partial(_selected, stream)
    else:
        return table, []
    # The numbers of a vector, such as the four of R, have names of their own, and vectors and texts are kept.
    known = names + [f"{name}[{place}]" for name in names if name not in numbers for place in range(4)]
    kept = set(needed(known))
    unread = [name for name in numbers if name not in kept]
    return choose([name for name in names if name not in unread]), unread


def _schema_of(columns: Iterable[tuple[str, Any]]) -> tuple[list[str], list[str]]:
    """The names of columns with types of Arrow or polars, and of those of numbers."""
    types = list(columns)
    names = [name for name, _ in types]
    _check_names(names)
    return names, [name for name, kind in types if str(kind).lower().startswith(("int", "uint", "float", "double", "halffloat", "bool"))]


def _check_names(names: Iterable[Any]) -> None:
    repeated = [name for name, count in collections.Counter(map(str, names)).items() if count > 1]
    if repeated:
        raise ValueError(f"table: column {repeated[0]} is there several times; expected every name once")


def _selected(stream: Any, names: Sequence[str]) -> Any:
    import pyarrow

    schema = pyarrow.schema([stream.schema.field(name) for name in names])
    # Copied, because the columns of an imported batch are released together.
    copied = ([pyarrow.concat_arrays([batch.column(name)]) for name in names] for batch in stream)
    return pyarrow.Table.from_batches([pyarrow.record_batch(columns, schema=schema) for columns in copied], schema)


def _plain_table(table: Any) -> Any:
    """A table whose columns can be asked for by name, for objects that have or make one."""
    if isinstance(table, list) and table and all(hasattr(one, "header") and hasattr(one, "data") for one in table):
        # An HDUList of astropy.
        table = [one for one in table if getattr(one, "columns", None) is not None]
        if len(table) != 1:
            raise TypeError(f"table: found an HDUList with {len(table)} tables; expected one. Try: hdus['NAME'].data")
        table = table[0]
    if hasattr(table, "header") and hasattr(table, "data") and hasattr(table, "columns"):
        return np.asarray(table.data)
    if hasattr(table, "makeData") or (hasattr(table, "names") and hasattr(table, "nobjects")):
        # GalSim's OutputCatalog and Catalog.
        return table.makeData() if hasattr(table, "makeData") else _of_galsim(table)
    if hasattr(table, "ntot") and hasattr(table, "g1"):
        return _of_treecorr(table)
    return table


def _of_dask(table: Any) -> str:
    kind = type(table).__name__
    if not hasattr(type(table), "npartitions"):
        return f"table: found a {kind} of dask; expected a table in memory. Try: table.compute()"
    return (
        f"table: found a {kind} of dask in {table.npartitions} partitions; expected one in memory."
        " Try: parts = [dask.delayed(shearq.bias_sums)(part) for part in frame.to_delayed()], then shearq.BiasSums.merge"
    )


def _of_galsim(catalogue: Any) -> dict[str, Any]:
    rows = range(catalogue.nobjects)
    return {str(name): np.array([catalogue.get(row, name) for row in rows]) for name in catalogue.names}


def _of_treecorr(catalogue: Any) -> dict[str, Any]:
    """Of a catalogue of TreeCorr, whose g1 and g2 are measured."""
    names = {"e1": "g1", "e2": "g2", "w": "w", "x": "x", "y": "y", "ra": "ra", "dec": "dec"}
    if catalogue.g1 is None:
        raise TypeError("table: found a Catalog of TreeCorr without g1 and g2; expected shears")
    found = {own: getattr(catalogue, name, None) for own, name in names.items()}
    return {own: np.asarray(values) for own, values in found.items() if values is not None}


def _in_memory(column: Any) -> Any:
    """A masked array or an array; of integers with missing ones an array of objects, because numpy would make floats,
    which merge identifiers above 2^53."""
    if isinstance(column, np.ma.MaskedArray):
        return column
    kind = str(getattr(column, "type", getattr(column, "dtype", ""))).lower()
    if kind.startswith(("int", "uint")) and _has_missing(column):
        values = column.to_pylist() if hasattr(column, "to_pylist") else column.to_list()
        return np.array([None, *values], dtype=object)[1:]
    if hasattr(column, "num_chunks") or hasattr(column, "to_pylist"):
        return column.to_numpy(zero_copy_only=False)
    return np.asarray(column)


def _has_missing(column: Any) -> bool:
    if hasattr(column, "isna"):
        return bool(column.isna().any())
    # An attribute in Arrow, and a method in polars.
    count = getattr(column, "null_count", 0)
    return bool(count() if callable(count) else count)


def _components(name: str, array: Any) -> list[tuple[str, Any]]:
    """The columns ``g[0]`` and ``g[1]`` of a vector ``g``, the numbers of vectors of one, or the column itself."""
    if array.ndim == 1 and array.dtype.kind == "O":
        # Lists of Arrow, pandas and polars.
        first = next((value for value in array if not is_missing(value)), "")
        if not isinstance(first, (str, bytes)) and np.ndim(first) == 1:
            rows = [np.full(len(first), np.nan) if is_missing(value) else np.asarray(value) for value in array]
            if all(row.shape == rows[0].shape for row in rows):
                array = np.stack(rows)
    if array.ndim > 1 and 1 <= (numbers := math.prod(array.shape[1:])) <= MAX_VECTOR:
        # A matrix row by row, as in FITS files.
        flat = array.reshape(len(array), numbers)
        return [(f"{name}[{k}]" if numbers > 1 else name, flat[:, k]) for k in range(numbers)]
    return [(name, array)]


def _of_one_length(table: Mapping[Any, Any]) -> list[tuple[Any, Any]]:
    """The columns of a mapping, in which a single number or text is that of all rows, as in pandas, and None is no column."""
    if isinstance(table, _hdf5.Hdf5Table):
        return list(table.items())
    found = [(name, column) for name, column in table.items() if column is not None]
    rows = next((len(column) for _, column in found if np.ndim(column) > 0), None)

    def is_single(value: Any) -> bool:
        return np.ndim(value) == 0 and isinstance(value, (str, bool, int, float, np.bool_, np.number))

    return [(name, np.full(rows, column) if rows is not None and is_single(column) else column) for name, column in found]


def is_missing(value: Any) -> bool:
    """Whether an object stands for a missing value: None, NaN, and those of numpy and pandas."""
    return (
        value is None
        or value is np.ma.masked
        or type(value).__name__ in ("NAType", "NaTType")
        or (isinstance(value, (float, np.floating)) and bool(np.isnan(value)))
    )


def _plain(name: str, column: Any) -> np.ndarray[Any, Any]:
    """A column as an array; missing reals are NaN."""
    if isinstance(column, np.ma.MaskedArray):
        if not np.ma.is_masked(column):
            return np.asarray(column.data)
        if column.dtype.kind != "f":
            raise ValueError(f"table: values of {name} are missing; expected all")
        return np.asarray(column.filled(np.nan))
    array = np.asarray(column)
    if array.dtype.kind == "O" and array.ndim == 1:
        missing = [is_missing(value) for value in array]
        if any(missing):
            # Reals with missing ones, of pandas' own types.
            try:
                return np.array([np.nan if gone else value for gone, value in zip(missing, array)], dtype=np.float64)
            except (TypeError, ValueError):
                raise ValueError(f"table: values of {name} are missing; expected all") from None
        whole = all(isinstance(value, (int, np.integer)) for value in array)
        # Words, or whole numbers of pandas' own types.
        return np.array(array.tolist()) if whole else np.array([str(value) for value in array], dtype=np.str_)
    return array


def from_table(cls: Any, table: Any, columns: Mapping[str, str] | None = None) -> Any:
    if isinstance(table, cls) and not columns:
        return table.copy()
    all_columns = dict(named_columns(table))
    metadata = getattr(table, "attrs", getattr(table, "meta", {}))
    absent = [name for name in (columns or {}).values() if name not in all_columns]
    if absent:
        raise ValueError(f"columns: no {', '.join(absent)} in the table; expected some of {', '.join(all_columns)}")
    # The names of the catalogue for those of the table.
    given = {found: own for own, found in (columns or {}).items()}
    taken = set(given)
    found = {
        given.get(name, name): _plain(name, column)
        for name, column in all_columns.items()
        if name in taken or name not in given.values()
    }
    return build(cls, found, _schema.to_attrs(metadata))


def build(cls: Any, found: dict[str, Any], attrs: dict[str, Any]) -> Any:
    """The catalogue of columns, of which those of the schema get their types."""
    missing = [name for name in ("e1", "e2") if name not in found]
    if missing:
        raise ValueError(f"table: no columns {', '.join(missing)}; expected e1 and e2. Try: columns={{'e1': NAME}}")
    shapes = {name: np.shape(column) for name, column in found.items()}
    rows = shapes["e1"]
    for name, shape in shapes.items():
        if len(rows) != 1 or shape != rows:
            raise ValueError(f"table: {name} has the shape {shape} and e1 {rows}; expected columns of one length")
    if "divisor1" in found:
        raise ValueError(
            "table: found divisor1, by which an earlier version of shearq divided e1; expected ellipticities before the division."
            " Try: measure again, or multiply e1 by divisor1 and e2 by divisor2 and remove these columns"
        )
    responses = ["R11" in found, "R22" in found]
    if any(responses) and not all(responses):
        raise ValueError("table: found only one of R11 and R22; expected both or none")
    if not any(responses):
        found.update({name: np.full(rows, np.nan) for name in ("R11", "R22")})
    types = {name: np.dtype(np.int32) for name in _schema.WHOLE} | {name: np.dtype(np.float64) for name in _schema.REAL}
    arrays = {name: np.asarray(column) for name, column in found.items()}
    if "id" in arrays and arrays["id"].dtype.kind == "f":
        # Whole numbers of FITS files are read as reals.
        if not (np.abs(arrays["id"]) <= _EXACT).all():
            raise ValueError("table: a number of id is above 2^53 or missing; expected smaller ones. Try: a Parquet file")
        arrays["id"] = arrays["id"].astype(np.int64)
    try:
        arrays = {name: array.astype(types.get(name, array.dtype.newbyteorder("="))) for name, array in arrays.items()}
    except (TypeError, ValueError) as error:
        raise ValueError(f"table: {error}; expected numbers") from None
    if "flags" not in arrays:
        for name in ("e1", "e2"):
            failed = _shearq.failed(np.ascontiguousarray(arrays[name]))
            if failed.any():
                row = int(failed.argmax())
                raise ValueError(
                    f"table: row {row} (from 0) has {name} = {arrays[name][row]:g}, which stands for a failed measurement, as"
                    f" {int(failed.sum())} rows have; expected ellipticities. Try: NaN for them, or a column flags"
                )
        finite = np.isfinite(arrays["e1"]) & np.isfinite(arrays["e2"])
        arrays["flags"] = np.where(finite, 0, _schema.NOT_FINITE).astype(np.int32)
    catalogue = np.empty(rows, dtype=[(name, array.dtype) for name, array in arrays.items()]).view(cls)
    for name, array in arrays.items():
        catalogue[name] = array
    catalogue.attrs = attrs
    return catalogue


def file_format(path: pathlib.Path) -> str:
    try:
        return _FORMATS[path.suffix.lower()]
    except KeyError:
        raise ValueError(
            f"path: found {path.name!r}; expected a name that ends in .parquet, .fits, .ecsv or .npy"
        ) from None


def write(catalogue: Any, path: str | os.PathLike[str], overwrite: bool) -> None:
    file = pathlib.Path(path)
    format = file_format(file)
    if file.exists() and not overwrite:
        raise FileExistsError(f"path: there is a file {file}. Try: overwrite=True")
    if format in ("parquet", "fits"):
        columns: list[tuple[str, Any]] = []
        for name in catalogue.dtype.names or ():
            column = catalogue[name]
            if column.dtype.kind in "iub":
                columns.append((name, np.ascontiguousarray(column, dtype=np.int64)))
            elif column.dtype.kind == "f":
                columns.append((name, np.ascontiguousarray(column, dtype=np.float64)))
            else:
                raise ValueError(
                    f"path: {file.suffix} files have columns of numbers (found words in {name}). Try: a name that ends in .ecsv"
                )
        metadata = _schema.to_keys(catalogue.attrs)
        if "R11" in (catalogue.dtype.names or ()) and np.isfinite(catalogue["R11"]).any():
            # Rows of plain columns have no attrs, by which the command line would know.
            metadata.setdefault("response", _schema.NOT_APPLIED)
        stars = [np.unique(catalogue[name]) for name in _schema.STAR if name in (catalogue.dtype.names or ())]
        # As the command line states it, which does not read the columns.
        if len(stars) == 3 and all(len(star) == 1 and star[0] > 0 for star in stars):
            star, *effects = (float(values[0]) for values in stars)
            metadata[_schema.STAR_KEY] = " ".join(f"{effect:.2e}" for effect in effects)
            metadata[_schema.PSF_KEY] = f"{star:.0f}"
        _shearq.write_table(str(file), format, columns, metadata)
        return
    # Completely or not at all.
    with tempfile.TemporaryDirectory(dir=file.parent) as folder:
        part = pathlib.Path(folder) / file.name
        if format == "npy":
            np.save(part, catalogue.view(np.ndarray))
        else:
            to_astropy(catalogue).write(part, format="ascii.ecsv")
        os.replace(part, file)
