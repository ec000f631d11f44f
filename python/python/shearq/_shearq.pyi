"""What the package's modules call: use the functions of :mod:`shearq` instead."""

from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

_Doubles = NDArray[np.float64]
_Size = tuple[float | None, float | None, float | None, float | None]

__version__: str
version_and_commit: str

@final
class Configuration:
    @staticmethod
    def named(name: str) -> Configuration: ...
    @staticmethod
    def text(text: str) -> Configuration: ...
    @staticmethod
    def json(text: str) -> Configuration: ...
    @staticmethod
    def restored(
        parts: tuple[str, str | None, tuple[float, float, float] | None],
    ) -> Configuration: ...
    @property
    def parts(self) -> tuple[str, str | None, tuple[float, float, float] | None]: ...
    @property
    def toml(self) -> str: ...

def names() -> list[str]: ...
def run_command(arguments: Sequence[str]) -> int: ...
def read_table(path: str, format: str, keys: Sequence[str]) -> tuple[dict[str, Any], dict[str, str]]: ...
def write_table(path: str, format: str, columns: Sequence[tuple[str, Any]], metadata: dict[str, str]) -> None: ...
def fingerprint(path: str) -> str | None: ...
def flags() -> list[tuple[str, int, str]]: ...
def measure(
    images: Sequence[dict[str, Any]],
    submission: Configuration,
    threads_asked: int,
    progress: Callable[[int], object] | None,
) -> tuple[dict[str, NDArray[Any]], list[str], str | None, str]: ...
def mean_shear(
    e1: _Doubles,
    e2: _Doubles,
    responses: list[_Doubles],
    weights: _Doubles,
    stars: list[list[float]],
    places: NDArray[np.int64],
) -> tuple[list[float], list[list[float]], list[float], list[float], int]: ...
def select(
    columns: dict[str, _Doubles], condition: str | None, weight: str | None
) -> list[_Doubles]: ...
def failed(values: _Doubles) -> NDArray[np.bool_]: ...
def detect(
    image: NDArray[np.float32],
    psf: _Doubles | Callable[[list[tuple[float, float]]], _Doubles],
    noise: float,
    threshold: float,
    jacobian: list[list[float]] | None,
    threads_asked: int,
) -> tuple[dict[str, NDArray[Any]], list[str]]: ...
def detect_epochs(
    exposures: list[
        tuple[
            NDArray[np.float32],
            _Doubles | Callable[[list[tuple[float, float]]], _Doubles],
            float,
            Callable[[_Doubles], _Doubles],
        ]
    ],
    threshold: float,
    jacobian: list[list[float]] | None,
    threads_asked: int,
) -> tuple[dict[str, NDArray[Any]], list[str]]: ...
def metrics() -> list[tuple[str, str, str]]: ...
def galaxies(
    catalogues: Sequence[str | tuple[str, list[tuple[str, Any]], list[tuple[str, str]]]],
    columns: Sequence[str],
    preset: Sequence[str],
    ellipticity: str | None,
    drop_missing: bool,
    step: float,
) -> tuple[list[_Doubles], list[int], list[str]]: ...
def score(
    n: int,
    stamp: float,
    field_degrees: float,
    truth: tuple[_Doubles, _Doubles],
    truth_sign: str | None,
    e: tuple[_Doubles, _Doubles],
    positions: tuple[_Doubles, _Doubles] | None,
    weights: _Doubles | None,
    lengths: Sequence[int],
    definition: str,
    convention: str,
    noise_variance: float | None,
) -> dict[str, Any]: ...
def spectrum(
    n: int,
    stamp: float,
    field_degrees: float,
    e: tuple[_Doubles, _Doubles],
    positions: tuple[_Doubles, _Doubles] | None,
    lengths: Sequence[int],
    definition: str,
) -> dict[str, NDArray[Any]]: ...
def aperture_mass(
    g: tuple[_Doubles, _Doubles],
    nodes: tuple[NDArray[np.int64], NDArray[np.int64]],
    weights: _Doubles,
    side: int,
    field_degrees: float,
) -> dict[str, NDArray[Any]]: ...
def difference(
    images: int,
    first: float,
    first_replicates: Sequence[float],
    second: float,
    second_replicates: Sequence[float],
) -> tuple[float, float] | None: ...
def psfs_from_oversampled(fine: _Doubles, factor: int) -> _Doubles: ...
def read_images(path: str, psfs: bool) -> tuple[NDArray[np.float32], _Doubles | None, str | None, _Size, list[str]]: ...
def header_pixels(cards: dict[str, str], width: int, height: int, planes: int) -> tuple[list[list[float]] | None, str | None, _Size, list[str]]: ...
def stated_oversampling(psf: _Size, galaxies: _Size) -> tuple[int | None, str | None]: ...
def pixel_difference(psfs: _Doubles, stamps: _Doubles) -> str | None: ...
def are_aligned(jacobians: _Doubles) -> bool: ...
def simulate(
    set: int,
    images: Sequence[int],
    seed: int,
    grid: int,
    amplitude: float,
    tilt: float,
    intrinsic_sigma: float | None,
    psf_fields: bool,
    threads_asked: int,
    progress: Callable[[int], object] | None,
) -> dict[str, Any]: ...

@final
class BiasSums:
    @staticmethod
    def from_json(text: str) -> BiasSums: ...
    def to_json(self) -> str: ...
    def append(self, others: Sequence[BiasSums]) -> BiasSums: ...
    def columns(self) -> list[tuple[str, str]]: ...
    def flagged_and_frame(self) -> tuple[int, str | None]: ...
    def result(self, against: BiasSums | None) -> tuple[str, str]: ...
    def save(self, path: str, against: BiasSums | None, origin: Sequence[tuple[str, str]]) -> None: ...

def needed_columns(
    names: Sequence[str],
    columns: Sequence[str],
    preset: Sequence[str],
    bins: Sequence[str],
    condition: str | None,
    weight: str | None,
    units: str | None,
) -> list[str]: ...
def bias_sums(
    catalogues: Sequence[str | tuple[str, list[tuple[str, Any]], list[tuple[str, str]]]],
    columns: Sequence[str],
    preset: Sequence[str],
    truth: tuple[float, float] | Sequence[tuple[str, float, float]] | str | None,
    ellipticity: str | None,
    truth_sign: str | None,
    bins: Sequence[tuple[str, int | None, Sequence[float]]],
    like: str | tuple[str, list[tuple[str, Any]], list[tuple[str, str]]] | None,
    tomography: str | None,
    condition: str | None,
    unsheared: Sequence[str],
    weight: str | None,
    design: str | None,
    units: str | None,
    paired: bool,
    drop_missing: bool,
    step: float,
) -> BiasSums: ...
