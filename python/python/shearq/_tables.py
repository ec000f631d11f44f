"""Catalogues as tables of other packages and in files. The class of catalogues imports this module, and is passed to it."""

from __future__ import annotations

import os
import pathlib
import tempfile
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from . import _schema, _shearq

if TYPE_CHECKING:
    import astropy.table  # type: ignore[import-untyped, unused-ignore]
    import pandas
    import polars


# Largest whole number up to which a double has all of them.
_EXACT = 2**53
_FORMATS = {".parquet": "parquet", ".pq": "parquet", ".fits": "fits", ".fit": "fits", ".ecsv": "ecsv", ".npy": "npy"}


def _columns(catalogue: Any) -> dict[str, Any]:
    """Columns by name, each in memory of its own."""
    return {name: np.ascontiguousarray(catalogue[name]) for name in catalogue.dtype.names or ()}


def to_astropy(catalogue: Any) -> astropy.table.Table:
    from astropy.table import Table

    meta = {key: _schema.in_header(value) for key, value in _schema.to_keys(catalogue.attrs).items()}
    table = Table(_columns(catalogue), meta=meta)
    units = dict(_schema.UNITS)
    # The linear method has a standard deviation there, and the network a sum of moments.
    if "snr" in table.colnames or "iterations" in table.colnames:
        units["size"] = "pix" if "snr" in table.colnames else "pix2"
    for name, unit in units.items():
        if name in table.colnames:
            table[name].unit = unit
    return table


def to_pandas(catalogue: Any) -> pandas.DataFrame:
    import pandas

    frame = pandas.DataFrame(_columns(catalogue))
    frame.attrs.update(catalogue.attrs)
    return frame


def to_polars(catalogue: Any) -> polars.DataFrame:
    import polars

    return polars.DataFrame(_columns(catalogue))


def _plain(name: str, column: Any) -> np.ndarray[Any, Any]:
    """A column as an array; missing reals are NaN."""
    if isinstance(column, np.ma.MaskedArray):
        if not np.ma.is_masked(column):
            return np.asarray(column.data)
        if column.dtype.kind != "f":
            raise ValueError(f"table: values of {name} are missing; expected all")
        return np.asarray(column.filled(np.nan))
    array = column.to_numpy() if hasattr(column, "to_numpy") else np.asarray(column)
    if array.dtype.kind == "O":
        # Words.
        array = np.array([str(value) for value in array], dtype=np.str_)
    return np.asarray(array)


def from_table(cls: Any, table: Any, columns: Mapping[str, str] | None = None) -> Any:
    if isinstance(table, cls) and not columns:
        return table.copy()
    if isinstance(table, np.ndarray):
        if table.dtype.names is None:
            raise TypeError("table: found an array without fields; expected a structured array")
        names = list(table.dtype.names)
    else:
        # pandas and polars have `columns`, and astropy has `colnames`.
        names = list(getattr(table, "colnames", getattr(table, "columns", table)))
    metadata = getattr(table, "attrs", getattr(table, "meta", {}))
    absent = [name for name in (columns or {}).values() if name not in names]
    if absent:
        raise ValueError(f"columns: no {', '.join(absent)} in the table; expected some of {', '.join(map(str, names))}")
    # The names of the catalogue for those of the table.
    given = {found: own for own, found in (columns or {}).items()}
    taken = set(given)
    found = {
        given.get(name, str(name)): _plain(str(name), table[name])
        for name in names
        if name in taken or str(name) not in given.values()
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
    responses, divisors = [[f"{kind}{k}" in found for k in end] for kind, end in (("R", ("11", "22")), ("divisor", "12"))]
    if any(responses) != any(divisors) or any(responses) != all(responses) or any(divisors) != all(divisors):
        raise ValueError(
            "table: found only some of R11, R22, divisor1 and divisor2; expected all or none. Set divisor1 and divisor2"
            " to the numbers by which e1 and e2 were divided: 1 if they are not calibrated"
        )
    if not any(responses):
        found.update({name: np.full(rows, np.nan) for name in ("R11", "R22", "divisor1", "divisor2")})
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
