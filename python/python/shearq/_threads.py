"""How many threads work."""

from __future__ import annotations

import multiprocessing
import os
import sys

from ._arrays import MAX_THREADS, whole

_VARIABLES = ("SHEARQ_NUM_THREADS", "RAYON_NUM_THREADS", "OMP_NUM_THREADS")
_chosen: int | None = None


def set_threads(threads: int | None) -> None:
    """Set the number of threads of later calls in this process that do not specify ``threads``.

    Parameters
    ----------
    threads : int or None
        Number of threads. None restores the default: the first of the environment variables SHEARQ_NUM_THREADS,
        RAYON_NUM_THREADS and OMP_NUM_THREADS that is set; otherwise one thread in worker processes of
        multiprocessing and in workers of dask, and one per core elsewhere.

    Raises
    ------
    ValueError, TypeError
        If the number is not a whole number from 1 to 1024.
    """
    global _chosen
    _chosen = None if threads is None else whole("threads", threads, 1, MAX_THREADS)


def get_threads() -> int:
    """The number of threads of calls that do not specify ``threads``; see :func:`set_threads`.

    Returns
    -------
    int

    Raises
    ------
    ValueError
        If SHEARQ_NUM_THREADS is not a whole number from 1 to 1024.
    """
    if _chosen is not None:
        return _chosen
    for name in _VARIABLES:
        # OpenMP has a list, one number for each level.
        text = os.environ.get(name, "").split(",")[0].strip()
        if text.isdecimal() and 1 <= int(text) <= MAX_THREADS:
            return int(text)
        if text and name == _VARIABLES[0]:
            raise ValueError(f"{name}: found {text!r}; expected a whole number from 1 to {MAX_THREADS}")
    if multiprocessing.parent_process() is not None or _in_dask_worker():
        return 1
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity is not None else os.cpu_count() or 1
    return min(cores, MAX_THREADS)


def thread_count(value: int | None) -> int:
    """The number of threads that ``threads=value`` asks for."""
    return get_threads() if value is None else whole("threads", value, 1, MAX_THREADS)


def _in_dask_worker() -> bool:
    """Whether this thread runs a task of dask.distributed, which starts a thread for each core itself."""
    distributed = sys.modules.get("distributed")
    if distributed is None:
        return False
    try:
        distributed.get_worker()
    except (ValueError, AttributeError):
        return False
    return True
