"""Tables in HDF5 files, whose columns are the datasets of a group. Needs h5py."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ._arrays import MAX_VECTOR, shown

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
# The column by which metadetect itself names the step of a row.
_STEP = "mdet_step"
# Names of the groups of metadetect's artificial shears, and what metadetect calls them.
_STEPS = {
    "noshear": ("noshear", "ns", "00", "unsheared"),
    "1p": ("1p", "sheared_1p"),
    "1m": ("1m", "sheared_1m"),
    "2p": ("2p", "sheared_2p"),
    "2m": ("2m", "sheared_2m"),
}


def is_hdf5(path: str) -> bool:
    """Whether a file, or FILE of FILE:GROUP, is one of HDF5, whatever its name."""
    try:
        with open(_parts(path)[0], "rb") as file:
            return file.read(len(_SIGNATURE)) == _SIGNATURE
    except OSError:
        return False


def is_group(value: Any) -> bool:
    """Whether an object is a group of h5py, or a dataset of rows with fields, without importing it."""
    return hasattr(type(value), "attrs") and (hasattr(type(value), "visititems") or hasattr(type(value), "fields"))


def _parts(path: str) -> tuple[str, str]:
    """The file and the group of FILE or FILE:GROUP."""
    if os.path.exists(path) or ":" not in path:
        return path, ""
    file, group = path.rsplit(":", 1)
    return file, group


class Hdf5Table(Mapping[str, Any]):
    """The columns of a group, each read when it is asked for."""

    def __init__(self, group: Any, name: str) -> None:
        self.name = name
        self._steps = _steps(group)
        tables = list(self._steps.values()) if self._steps else [group]
        columns = [_datasets(table, any_shape=True) for table in tables]
        # The names of the groups state the steps, also where each group repeats its own in a column.
        shared = [key for key in columns[0] if all(key in other and _is_column(other[key]) for other in columns) and not (self._steps and key == _STEP)]
        #: What there is of other datasets: `flags` of the unsheared group alone were dropped without a word.
        self.partial = {key: self._part(key, columns) for own in columns for key in own if key not in shared and key != _STEP}
        self._columns = {key: [column[key] for column in columns] for key in shared}
        lengths = {key: tuple(len(part) for part in parts) for key, parts in self._columns.items()}
        first = next(iter(lengths.values()), None)
        if first is None:
            raise ValueError(f"{name}: has no datasets; expected columns of a table{_listing(group)}")
        others = [key for key, length in lengths.items() if length != first]
        if others:
            raise ValueError(f"{name}: {others[0]} has {sum(lengths[others[0]])} rows and {shared[0]} {sum(first)}; expected one length")
        self._rows = first

    def _part(self, key: str, columns: Sequence[Mapping[str, Any]]) -> str:
        absent = [step for step, own in zip(self._steps, columns) if key not in own]
        if absent:
            return f"is not in the group{'s' * (len(absent) > 1)} of {', '.join(absent)}"
        shape = next(own[key].shape for own in columns if not _is_column(own[key]))
        return f"has the shape {shown(shape)}" if shape else "is a single value"

    def __getitem__(self, key: str) -> Any:
        if self._steps and key == _STEP:
            return np.repeat(np.array(list(self._steps)), self._rows)
        return np.concatenate([_native(part[:]) for part in self._columns[key]])

    def numbers(self) -> list[str]:
        """The columns of numbers."""
        return [key for key, parts in self._columns.items() if all(part.dtype.kind in "iufb" and part.ndim == 1 for part in parts)]

    def select(self, names: Sequence[str]) -> Hdf5Table:
        """The same table with these columns."""
        chosen = copy.copy(self)
        chosen._columns = {key: parts for key, parts in self._columns.items() if key in names}
        return chosen

    def __iter__(self) -> Any:
        return iter([*self._columns, *([_STEP] if self._steps else [])])

    def __len__(self) -> int:
        return len(self._columns) + bool(self._steps)


class _Field:
    """A field of a dataset of rows, read when it is asked for."""

    def __init__(self, rows: Any, name: str) -> None:
        self._rows, self._name = rows, name
        self.dtype, shape = rows.dtype[name].subdtype or (rows.dtype[name], ())
        self.shape = (*rows.shape, *shape)
        self.ndim = len(self.shape)

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, rows: slice) -> Any:
        return self._rows.fields(self._name)[rows]


def _is_column(dataset: Any) -> bool:
    """Whether a dataset has a few numbers or a text in each row."""
    return bool(dataset.ndim > 0 and math.prod(dataset.shape[1:]) <= MAX_VECTOR)


def _has_fields(value: Any) -> bool:
    return getattr(getattr(value, "dtype", None), "names", None) is not None


def _datasets(group: Any, any_shape: bool = False) -> dict[str, Any]:
    """The columns of a group, or of a dataset of rows with fields, as astropy and PyTables write them. Of `any_shape`, also single
    values and arrays in each row."""
    if _has_fields(group):
        return {name: _Field(group, name) for name in group.dtype.names}
    columns = {key: value for key, value in group.items() if hasattr(value, "dtype") and (any_shape or value.ndim in (1, 2))}
    # Units and formats of astropy are no column.
    return {key: value for key, value in columns.items() if not _has_fields(value) and not key.endswith(".__table_column_meta__")}


def _is_table(value: Any) -> bool:
    return _has_fields(value) or (hasattr(value, "keys") and bool(_datasets(value) or _steps(value)))


def _native(values: Any) -> Any:
    # Datasets of bytes are texts.
    return np.char.decode(values, "utf-8") if values.dtype.kind == "S" else values


def _steps(group: Any) -> dict[str, Any]:
    """The groups of metadetect's artificial shears; none for the group of one table."""
    found: dict[str, Any] = {}
    if not hasattr(group, "keys"):
        return found
    for step, names in _STEPS.items():
        for name in names:
            if name in group and (hasattr(group[name], "keys") or _has_fields(group[name])):
                found[step] = group[name]
                break
    return found if len(found) >= 3 else {}


def _listing(group: Any) -> str:
    tables: list[str] = []

    def visit(name: str, value: Any) -> None:
        if _is_table(value):
            tables.append(name)

    group.visititems(visit)
    return f". Try: FILE:GROUP with one of {', '.join(tables[:8])}" if tables else ""


def listing(source: Any) -> str:
    """The remedy that lists the tables in a group of h5py, or of FILE or FILE:GROUP."""
    if not isinstance(source, (str, os.PathLike)):
        return _listing(source)
    import h5py

    path, given = _parts(os.fspath(source))
    with h5py.File(path, "r") as file:
        return _listing(file[given or "/"])


def table(source: Any, name: str) -> Hdf5Table:
    """The table of a group of h5py, or of FILE or FILE:GROUP: the only group of the file with columns if none is named."""
    try:
        import h5py
    except ImportError:
        raise ImportError(f"{name}: is an HDF5 file, which h5py reads. Try: pip install h5py") from None
    if not isinstance(source, str):
        group, given = source, ""
    else:
        path, given = _parts(source)
        file = h5py.File(path, "r")
        try:
            group = file[given] if given else file
        except KeyError:
            raise ValueError(f"{path}: has no group {given}{_listing(file)}") from None
    if "pandas_type" in group.attrs:
        raise ValueError(f"{name}: is a table of pandas, whose columns are joined in blocks; expected a dataset for each column. Try: pandas.read_hdf")
    if hasattr(group, "dtype") and not _has_fields(group):
        raise ValueError(f"{name}: is one dataset without names of columns; expected a group of datasets, or rows with fields")
    if not given and not _datasets(group) and not _steps(group):
        candidates = [value for value in _members(group) if _is_table(value)]
        inner = [one for one in candidates if not any(one.name.startswith(f"{other.name}/") and _steps(other) for other in candidates)]
        if len(inner) != 1:
            raise ValueError(f"{name}: found {len(inner)} tables; expected one{_listing(group)}")
        group = inner[0]
    return Hdf5Table(group, name)


def _members(group: Any) -> list[Any]:
    found: list[Any] = []
    group.visititems(lambda _, value: found.append(value))
    return found
