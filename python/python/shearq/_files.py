"""Reading catalogues, the same as those of the command line."""

from __future__ import annotations

import os
import pathlib
from typing import Any

import numpy as np

from . import _schema, _shearq, _tables
from ._catalogue import Catalogue


def read(path: str | os.PathLike[str]) -> Catalogue:
    """Read a catalogue that :meth:`Catalogue.write` or the command line wrote.

    Parameters
    ----------
    path : str or path
        A file that ends in ``.parquet``, ``.fits``, ``.ecsv`` (needs astropy) or ``.npy``. For tables of other
        programs see :meth:`Catalogue.from_table`. Columns of words are read from ``.ecsv`` and ``.npy`` only.

    Returns
    -------
    Catalogue

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no such file, its ending is another, or it lacks a column.
    """
    file = pathlib.Path(path)
    format = _tables.file_format(file)
    if not file.exists():
        raise FileNotFoundError(f"path: there is no file {file}")
    catalogue: Catalogue
    if format == "npy":
        catalogue = _tables.from_table(Catalogue, np.load(file))
        return catalogue
    if format == "ecsv":
        table = _tables.library("astropy.table", f"{file}: a file of ECSV").Table.read(file, format="ascii.ecsv")
        catalogue = _tables.from_table(Catalogue, table)
        return catalogue
    keys = [*_schema.KEYS, *_schema.OTHER_KEYS, _schema.STAR_KEY, _schema.PSF_KEY]
    columns, metadata = _shearq.read_table(str(file), format, keys)
    found = {name: np.asarray(column) for name, column in columns.items()}
    if "snr" in found and not any(name in found for name in _schema.STAR):
        found.update(_star(file, dict(metadata), len(found["snr"])))
    try:
        catalogue = _tables.build(Catalogue, found, _schema.to_attrs(metadata))
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    return catalogue


def _star(file: pathlib.Path, metadata: dict[str, str], count: int) -> dict[str, Any]:
    """The columns of the noise of a star, which the command line states once."""
    stated = metadata.get(_schema.STAR_KEY)
    most = 10.0
    try:
        m, c = [float(word) for word in (stated or "0 0").split(" ")]
        if not (0 <= m <= most and 0 <= c <= most):
            raise ValueError
    except ValueError:
        raise ValueError(f"{file}: the metadata {_schema.STAR_KEY} are {stated!r}; expected two numbers from 0 to {most:.0f}") from None
    # Without a fingerprint, the star is that of this file alone.
    name = metadata.get(_schema.PSF_KEY, str(file))
    star = _schema.star_number(name.encode()) if stated else 0.0
    return {name: np.full(count, value) for name, value in zip(_schema.STAR, (star, m, c))}


def read_all(folder: str | os.PathLike[str], sets: int | list[int] | None = None) -> list[Catalogue]:
    """Read the catalogues of a results folder of the command line, in the order of their sets and images.

    Parameters
    ----------
    folder : str or path
        What ``shearq measure --out`` wrote: ``set01/catalogue-001.parquet`` and so on.
    sets : int or list of int, optional
        Numbers of the sets; all by default.

    Returns
    -------
    list of Catalogue
        ``attrs`` contain the numbers ``set`` and ``image``.

    Raises
    ------
    FileNotFoundError
        If there is no catalogue.
    """
    numbers = None if sets is None else {sets} if isinstance(sets, int) else set(sets)
    found = []
    for path in sorted(pathlib.Path(folder).glob("set*/catalogue-*")):
        number = path.parent.name.removeprefix("set")
        if path.suffix in (".parquet", ".fits") and number.isdecimal():
            if numbers is None or int(number) in numbers:
                found.append(path)
    if not found:
        raise FileNotFoundError(f"folder: there is no set*/catalogue-* in {os.fspath(folder)}; expected results of `shearq measure`")
    return [read(path) for path in found]
