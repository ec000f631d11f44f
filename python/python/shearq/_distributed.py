"""Catalogues between the processes of dask.distributed, whose serialiser of arrays would drop their type."""

from __future__ import annotations

import importlib.abc
import importlib.util
import pickle
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_MODULE = "distributed.protocol"


def _register(catalogue: type, module: Any) -> None:
    def serialize(value: Any) -> tuple[dict[str, Any], list[Any]]:
        frames: list[Any] = []
        body = pickle.dumps(value, protocol=5, buffer_callback=frames.append)
        return {}, [body, *(frame.raw() for frame in frames)]

    def deserialize(_: dict[str, Any], frames: list[Any]) -> Any:
        return pickle.loads(frames[0], buffers=frames[1:])

    module.dask_serialize.register(catalogue)(serialize)
    module.dask_deserialize.register(catalogue)(deserialize)


class _WhenImported(importlib.abc.MetaPathFinder):
    """Registers the serialisers when distributed is imported after this package."""

    def __init__(self, catalogue: type) -> None:
        self.catalogue = catalogue

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != _MODULE:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is not None and spec.loader is not None:
            load, catalogue = spec.loader.exec_module, self.catalogue

            def exec_module(module: ModuleType) -> None:
                load(module)
                _register(catalogue, module)

            setattr(spec.loader, "exec_module", exec_module)
        return spec


def register(catalogue: type) -> None:
    """Registers the serialisers now if distributed is imported, or else when it is."""
    module = sys.modules.get(_MODULE)
    if module is not None:
        _register(catalogue, module)
    else:
        sys.meta_path.insert(0, _WhenImported(catalogue))
