"""Stages of DESC's ceci pipelines: ``modules: shearq.ceci`` in the pipeline's YAML. Needs ceci and h5py."""

from __future__ import annotations

import json
from typing import Any

import h5py  # type: ignore[import-untyped, unused-ignore]
import numpy as np
from ceci import PipelineStage  # type: ignore[import-untyped, unused-ignore]
from ceci.file_types import DataFile, FitsFile, HDFFile  # type: ignore[import-untyped, unused-ignore]

from . import __version__, bias, measure


class JsonFile(DataFile):  # type: ignore[misc, unused-ignore]
    """A JSON document."""

    suffix = "json"

    @classmethod
    def open(cls, path: str, mode: str, **_: Any) -> Any:
        return open(path, mode)


def _given(config: Any, *names: str) -> dict[str, Any]:
    """The options that are set: empty texts and lists are not."""
    return {name: config[name] for name in names if config[name] not in ("", [], {}, None)}


class ShearBias(PipelineStage):  # type: ignore[misc, unused-ignore]
    """m and c of shear catalogues, as :func:`shearq.bias` estimates them.

    The input is an HDF5 file whose group ``group`` is a table; the option ``catalogues`` lists further ones, such as those under the
    opposite shear. ``g1`` and ``g2`` are the true shears of all, where no column has them. The output is JSON: rows, notes and the
    version.
    """

    name = "ShearBias"
    inputs = [("shear_catalog", HDFFile)]
    outputs = [("shear_bias", JsonFile)]
    parallel = False
    config_options = {
        "group": "shear",
        "catalogues": [str],
        "g1": [float],
        "g2": [float],
        "columns": [str],
        "ellipticity": "",
        "where": "",
        "weight": "",
        "units": "",
        "design": "",
        "drop_missing": False,
    }

    def run(self) -> None:
        config = self.config
        group = f":{config['group']}" if config["group"] else ""
        paths = [f"{path}{group}" for path in [self.get_input("shear_catalog"), *_of(str, config["catalogues"])]]
        arguments = _given(config, "ellipticity", "where", "weight", "units", "design")
        for name in ("g1", "g2"):
            values = _of(float, config[name])
            if values:
                arguments[name] = values if len(values) > 1 else values[0]
        columns = _of(str, config["columns"])
        if columns:
            arguments["columns"] = dict(pair.split("=", 1) for pair in columns)
        found = bias(paths, drop_missing=config["drop_missing"], **arguments)
        with self.open_output("shear_bias") as file:
            document = {"version": __version__, "rows": found.rows, "notes": found.notes, "binned": found.binned}
            json.dump(document, file, indent=1)
        print(found)


class ShearMeasure(PipelineStage):  # type: ignore[misc, unused-ignore]
    """Shapes and responses of stamps, as :func:`shearq.measure` has them, in the group ``shear`` of an HDF5 file.

    The inputs are FITS images: stamps of shape (n, ny, nx), and one PSF or one for each stamp.
    """

    name = "ShearMeasure"
    inputs = [("stamps", FitsFile), ("psf", FitsFile)]
    outputs = [("shear_catalog", HDFFile)]
    parallel = False
    config_options = {"submission": "48/linear/star", "threads": 0}

    def run(self) -> None:
        from astropy.io import fits  # type: ignore[import-untyped, unused-ignore]

        stamps, psf = (fits.getdata(self.get_input(name)) for name in ("stamps", "psf"))
        found = measure(stamps, psf, submission=self.config["submission"], threads=self.config["threads"] or None)
        with self.open_output("shear_catalog") as file:
            group = file.create_group("shear")
            for name in found.dtype.names or ():
                column = np.asarray(found[name])
                group.create_dataset(name, data=column if column.dtype.kind in "iuf" else column.astype(h5py.string_dtype()))
            for name, value in found.attrs.items():
                group.attrs[name] = value


def _of(kind: type, values: Any) -> list[Any]:
    """A list of an option, which is the type itself where it is not given."""
    return [] if values in ([kind], None) else list(values)


if __name__ == "__main__":
    PipelineStage.main()
