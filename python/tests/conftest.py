"""What the tests share."""

import subprocess
import sys

import numpy as np
import pytest

import shearq

STAMP = 48
SHEAR = 0.02


@pytest.fixture(scope="session")
def command():
    """Runs the command line as ``python -m shearq`` and returns what it printed, or said on standard error."""

    def run(*arguments, status=0, stream="stdout"):
        done = subprocess.run(
            [sys.executable, "-m", "shearq", *map(str, arguments)], capture_output=True, text=True, check=False
        )
        assert done.returncode == status, done.stderr
        return getattr(done, stream)

    return run


@pytest.fixture(scope="session")
def image():
    """An image of 144 galaxies at S/N 40 with one PSF."""
    return shearq.simulate(set=8, seed=3, grid=12)[0]


def same_bits(a, b):
    """Whether two arrays hold the same bits; NaN are NaN whatever theirs."""
    a, b = np.asarray(a), np.asarray(b)
    if a.dtype.names:
        return all(same_bits(a[name], b[name]) for name in a.dtype.names)
    if a.dtype.kind != "f":
        return np.array_equal(a, b)
    nan = np.isnan(a)
    bits = f"u{a.dtype.itemsize}"
    return np.array_equal(nan, np.isnan(b)) and np.array_equal(a[~nan].view(bits), b[~nan].view(bits))
