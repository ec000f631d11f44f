"""Catalogues between the processes of dask.distributed, whose serialiser of arrays would drop their type."""

from __future__ import annotations

import pickle
import sys
from typing import Any

_MODULE = "distributed.protocol"
_registered = False


def register(catalogue: type) -> None:
    """Registers the serialisers if distributed is imported. Called for each catalogue, because distributed may be imported after
    this package, and asks nobody."""
    global _registered
    module: Any = sys.modules.get(_MODULE)
    if _registered or not hasattr(module, "dask_deserialize"):
        return
    _registered = True
    module.dask_serialize.register(catalogue)(_serialize)
    module.dask_deserialize.register(catalogue)(_deserialize)


def _serialize(value: Any) -> tuple[dict[str, Any], list[Any]]:
    frames: list[Any] = []
    body = pickle.dumps(value, protocol=5, buffer_callback=frames.append)
    return {}, [body, *(frame.raw() for frame in frames)]


def _deserialize(_: dict[str, Any], frames: list[Any]) -> Any:
    return pickle.loads(frames[0], buffers=frames[1:])
