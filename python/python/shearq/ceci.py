"""Stages of DESC's ceci pipelines: ``modules: shearq.ceci`` in the pipeline's YAML. Needs ceci and h5py."""

from __future__ import annotations

import difflib
import inspect
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

try:
    import h5py  # type: ignore[import-untyped, unused-ignore]
    import yaml  # type: ignore[import-untyped, unused-ignore]
    from ceci import PipelineStage as PipelineStage  # type: ignore[import-untyped, unused-ignore]
    from ceci.config import StageParameter  # type: ignore[import-untyped, unused-ignore]
    from ceci.file_types import DataFile, FitsFile, HDFFile  # type: ignore[import-untyped, unused-ignore]
except ImportError as error:
    raise ImportError(f"shearq.ceci: {error} (expected ceci and h5py). Try: pip install ceci h5py") from error

from . import bias, measure

# Arguments that are inputs of the stages, or objects of Python.
_NOT_OPTIONS = ("catalogues", "stamps", "psf", "epochs", "progress")
# What ceci's `make_stage` passes besides options.
_OF_CECI = ("config", "name", "aliases", "comm", "inputs", "outputs")


class JsonFile(DataFile):  # type: ignore[misc, unused-ignore]
    """A JSON document."""

    suffix = "json"

    @classmethod
    def open(cls, path: str, mode: str, **_: Any) -> Any:
        return open(path, mode)


def _options(function: Callable[..., Any]) -> dict[str, Any]:
    """The arguments of a function as options of a stage."""
    return {
        name: argument.default if isinstance(argument.default, bool) else _optional(argument.default)
        for name, argument in inspect.signature(function).parameters.items()
        if name not in _NOT_OPTIONS
    }


def _optional(default: Any = None) -> Any:
    # Of any type, because ceci would make a list of each letter of a text, and refuse a number for a list.
    return StageParameter(dtype=None, default=default, required=False)


class _Arguments:
    """What the stages share: options that are the arguments of a function, and no others."""

    config: Any
    config_options: Mapping[str, Any]
    function: Callable[..., Any]

    def read_config(self, args: Mapping[str, Any]) -> None:
        super().read_config(args)  # type: ignore[misc]
        # The section `global` is for all stages, so that it may have other keys, and ceci tests arguments of the command line itself.
        given = [*self._section(), *(() if "stage_name" in args else args)]
        known = [*self.config_options, *self.input_tags(), *self.output_tags(), *_OF_CECI]  # type: ignore[attr-defined]
        for key in given:
            if key not in known:
                near = difflib.get_close_matches(key, self.config_options, 1)
                hint = f". Try: {near[0]}" if near else ""
                raise ValueError(f"found the key {key}; expected some of {', '.join(sorted(self.config_options))}{hint}")

    def _section(self) -> list[str]:
        config = self.get_input("config")  # type: ignore[attr-defined]
        if isinstance(config, str):
            try:
                from ceci.pipeline.templates import read_and_apply_template  # type: ignore[import-untyped, unused-ignore]
            except ImportError:
                # Older versions of ceci have no templates.
                with open(config) as file:
                    text = file.read()
            else:
                text = read_and_apply_template(config)
            config = yaml.safe_load(text)
        return list((config or {}).get(self.instance_name) or {})  # type: ignore[attr-defined]

    def _given(self) -> dict[str, Any]:
        """The arguments that are set: empty texts and lists are not."""
        found = {}
        for name, argument in inspect.signature(type(self).function).parameters.items():
            if name in _NOT_OPTIONS:
                continue
            value = self.config[name]
            if value is None or isinstance(value, (str, list, Mapping)) and not value:
                continue
            is_number = name != "ids" and re.search(r"\b(float|int|ArrayLike)\b", str(argument.annotation))
            found[name] = _number(value) if is_number else value
        return found


def _number(value: Any) -> Any:
    """Numbers as YAML and the command line have them: YAML reads 1e-3 as a text, and the command line has lists with commas."""
    if isinstance(value, str) and "," in value:
        value = _texts(value)
    if isinstance(value, list):
        return [_number(own) for own in value]
    for kind in (int, float):
        try:
            return kind(value) if isinstance(value, str) else value
        except ValueError:
            pass
    return value


def _texts(value: Any) -> list[str]:
    return [part.strip() for part in value.split(",")] if isinstance(value, str) else list(value or [])


class ShearBias(_Arguments, PipelineStage):  # type: ignore[misc, unused-ignore]
    """m and c of shear catalogues, as :func:`shearq.bias` estimates them, whose arguments are the options.

    The input is an HDF5 file whose group ``group`` is a table; the option ``catalogues`` lists further ones, such as those under the
    opposite shear, from which the same group is read. ``g1`` and ``g2`` are the true shears of all, where no column has them. The output is the JSON of
    :meth:`shearq.Bias.to_json`.
    """

    name = "ShearBias"
    inputs = [("shear_catalog", HDFFile)]
    outputs = [("shear_bias", JsonFile)]
    parallel = False
    config_options = {"group": "shear", "catalogues": _optional(), **_options(bias)}
    function = bias

    def run(self) -> None:
        config, arguments = self.config, self._given()
        group = f":{config['group']}" if config["group"] else ""
        paths = [f"{path}{group}" for path in [self.get_input("shear_catalog"), *_texts(config["catalogues"])]]
        for name in ("g1", "g2"):
            values = arguments.get(name)
            if isinstance(values, list) and len(values) == 1:
                arguments[name] = values[0]
        columns = arguments.get("columns")
        if columns and not isinstance(columns, Mapping):
            pairs = _texts(columns)
            for pair in pairs:
                if "=" not in pair:
                    raise ValueError(f"columns: found {pair!r}; expected ROLE=COLUMN")
            arguments["columns"] = dict(pair.split("=", 1) for pair in pairs)
        if isinstance(arguments.get("bins"), list):
            # Pairs of several quantities are tuples for `bias`, which YAML has not.
            arguments["bins"] = [tuple(own) if isinstance(own, list) and isinstance(own[0], str) else own for own in arguments["bins"]]
        found = bias(paths, **arguments)
        with self.open_output("shear_bias") as file:
            file.write(found.to_json() + "\n")
        print(found)


class ShearMeasure(_Arguments, PipelineStage):  # type: ignore[misc, unused-ignore]
    """Shapes and responses of stamps, as :func:`shearq.measure` has them, in the group ``shear`` of an HDF5 file.

    The inputs are FITS images: stamps of shape (n, ny, nx), and one PSF or one for each stamp. Their headers state the WCS. The
    options are the other arguments of :func:`shearq.measure`.
    """

    name = "ShearMeasure"
    inputs = [("stamps", FitsFile), ("psf", FitsFile)]
    outputs = [("shear_catalog", HDFFile)]
    parallel = False
    config_options = _options(measure)
    function = measure

    def run(self) -> None:
        found = measure(self.get_input("stamps"), self.get_input("psf"), **self._given())
        with self.open_output("shear_catalog") as file:
            group = file.create_group("shear")
            for name in found.dtype.names or ():
                column = np.asarray(found[name])
                group.create_dataset(name, data=column if column.dtype.kind in "iuf" else column.astype(h5py.string_dtype()))
            for name, value in found.attrs.items():
                group.attrs[name] = value


if __name__ == "__main__":
    PipelineStage.main()
