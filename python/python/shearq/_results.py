"""What all results share: JSON, files, and tables in notebooks."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from . import _display, _hdf5, _shearq


def plain(value: Any) -> Any:
    """A value as JSON has it: missing and infinite numbers are null, and other objects their text."""
    if isinstance(value, (str, bool, int)) or value is None:
        return value
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, (np.integer, np.bool_)):
        return value.item()
    if isinstance(value, Mapping):
        return {str(key): plain(own) for key, own in value.items()}
    if isinstance(value, np.ndarray) and value.dtype.names:
        return {name: plain(value[name]) for name in value.dtype.names}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(own) for own in value]
    return os.fspath(value) if isinstance(value, os.PathLike) else f"<{type(value).__name__}>"


def origin(function: str, settings: Mapping[str, Any], paths: Any = (), columns: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Version with commit, function, settings that are no defaults, columns by role, and fingerprints of files, as the command line's
    JSON has them."""
    given = {name: plain(value) for name, value in settings.items() if value is not None and value is not False}
    inputs = {path: print for path in paths if (print := _shearq.fingerprint(_hdf5._parts(path)[0])) is not None}
    return {"version": _shearq.version_and_commit, "function": function, "settings": given, "columns": dict(columns or {}), "inputs": inputs}


class Result:
    """A result that becomes JSON, a file, or a table in a notebook."""

    __slots__ = ()

    def _object(self) -> dict[str, Any]:
        """The names and values of the JSON."""
        raise NotImplementedError

    def _table(self) -> tuple[str, list[str], list[list[str]], list[str]]:
        """Caption, headings, rows and notes of the table."""
        raise NotImplementedError

    def to_json(self) -> str:
        """The result as JSON; missing numbers are null."""
        return json.dumps(plain(self._object()), indent=2, ensure_ascii=False)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the result as JSON (.json), CSV (.csv) or as a page (.html). A file of this name is replaced.

        Raises
        ------
        ValueError
            If the name has another ending.
        """
        _, headings, rows, _ = self._table()
        texts = {
            ".json": lambda: self.to_json() + "\n",
            ".csv": lambda: _csv([headings, *rows]),
            ".html": lambda: f'<!doctype html><meta charset="utf-8">{self._repr_html_()}\n',
        }
        write(path, texts)

    def _repr_html_(self) -> str:
        return _display.table_html(*self._table())


def _csv(rows: list[list[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def write(path: str | os.PathLike[str], texts: Mapping[str, Any]) -> None:
    """Writes the text for the ending of a name: completely or not at all."""
    file = pathlib.Path(path)
    try:
        text = texts[file.suffix.lower()]()
    except KeyError:
        raise ValueError(f"path: found {file.name!r}; expected a name that ends in {', '.join(texts)}") from None
    part = file.with_name(f".{file.name}.part")
    part.write_text(text, encoding="utf-8")
    part.replace(file)
