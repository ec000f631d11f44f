"""Tests of a survey whose true shear is unknown, by TreeCorr."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from . import _shearq
from ._tables import file_format

_DEGREES = {"ra_units": "deg", "dec_units": "deg"}
_PSF = ("psf_e1", "psf_e2")
# In least separations: of a constant ξ₊, for which T₊(0) = 12/5, the missing separations are 0.6/5² = 2 %.
_MIN_APERTURE_PER_SEPARATION = 5


def null_tests(
    shears: Any, *, points: Any = None, stars: Any = None, against: tuple[str, ...] | None = None, bins: int = 5, **separations: Any
) -> dict[str, dict[str, Any]]:
    """Tests of additive errors of shears in the frame of the sky. Needs TreeCorr.

    The true shear of a survey is unknown, but its B modes, its mean, and the tangential shear about points without mass are
    zero, and residuals of the PSF should not correlate. m cannot be tested so.

    Parameters
    ----------
    shears : table or mapping of columns, or path of a Parquet or FITS file
        ``ra``, ``dec`` in degrees, ``g1``, ``g2`` and perhaps ``w``, ``psf_e1`` and ``psf_e2``, as ``shearq shear`` writes them.
        Galaxies without a shear are left out.
    points : as shears, optional
        ``ra``, ``dec`` of points without mass, such as stars or random places.
    stars : as shears, optional
        ``ra``, ``dec``, ellipticities ``e1``, ``e2`` and size ``T`` of stars, and those of the PSF model at their places,
        ``model_e1``, ``model_e2`` and ``model_T``, in the frame of the sky. The most telling stars are those that the model was not fitted to.
    against : tuple of str, optional
        Columns of shears against which the mean shear is tested, such as positions on the exposure. By default the shape
        and size of the PSF, ``psf_e1``, ``psf_e2`` and ``psf_sigma``, if they are there.
    bins : int, optional
        Bins of equally many galaxies of each of these.
    **separations
        Of TreeCorr: ``min_sep``, ``max_sep``, ``nbins``, ``sep_units``. By default 10 bins from 1 to 100 arcmin.

    Returns
    -------
    dict
        Arrays by name of each test:
        ``'modes'``: ``r``, ``xip``, ``xim`` and their ``error``, and ⟨M_ap²⟩ of E and B modes (``map2``, ``mx2``,
        ``map2_error``) for apertures r (Schneider et al. 2002, A&A 396, 1). ⟨M_ap²⟩ is NaN for apertures below five times
        the least separation, and above half the largest of the galaxies: without ξ at the
        missing separations, E modes appear as B modes.
        ``'points'``: ``r``, ``gt``, ``gx``, ``error``.
        Separations without pairs are NaN.
        ``'rho'``: ``r`` and ``rho1`` to ``rho5`` (Rowe 2010, MNRAS 404, 350; Jarvis et al. 2016, MNRAS 460, 2245), each
        with ``rho1_error`` and so on.
        ``'leakage'``, with ``psf_e1`` and ``psf_e2``: ``alpha`` and its ``error`` for each component of g = α e_PSF + c, by
        least squares.
        One test per column of ``against``: the mean ``at`` of the column, ``g1``, ``g2``, ``g1_error`` and ``g2_error``.

    Raises
    ------
    ValueError
        If columns are missing.
    """
    try:
        import treecorr
    except ImportError as error:
        raise ImportError("null_tests needs TreeCorr. Try: pip install treecorr") from error
    shears, points, stars = (_read(name, table) for name, table in (("shears", shears), ("points", points), ("stars", stars)))
    separations = {"min_sep": 1.0, "max_sep": 100.0, "nbins": 10, "sep_units": "arcmin", **separations}
    names = _names(shears)
    if against is None:
        against = tuple(name for name in (*_PSF, "psf_sigma") if name in names)
    galaxies = _columns("shears", shears, ("ra", "dec", "g1", "g2", *against))
    weight = _columns("shears", shears, ("w",))["w"] if "w" in names else np.ones(len(galaxies["ra"]))
    good = (weight > 0) & np.isfinite(galaxies["g1"]) & np.isfinite(galaxies["g2"])
    galaxies, weight = {name: column[good] for name, column in galaxies.items()}, weight[good]
    if len(weight) < (least := max(2, bins)):
        raise ValueError(f"shears: found {len(weight)} galaxies with a shear; expected {least} or more")

    def catalogue(table: Mapping[str, Any], **values: Any) -> Any:
        return treecorr.Catalog(ra=table["ra"], dec=table["dec"], **_DEGREES, **values)

    sources = catalogue(galaxies, g1=galaxies["g1"], g2=galaxies["g2"], w=weight)
    modes = treecorr.GGCorrelation(**separations)
    modes.process(sources)
    map2, _, mx2, _, variance = modes.calculateMapSq()
    has_pairs = modes.npairs > 0
    # Only with ξ from (nearly) zero to twice the aperture.
    largest = modes.right_edges[has_pairs].max(initial=0)
    is_complete = (modes.rnom >= _MIN_APERTURE_PER_SEPARATION * modes.left_edges[0]) & (2 * modes.rnom <= largest)
    found: dict[str, dict[str, Any]] = {
        "modes": _where(has_pairs, r=modes.meanr, xip=modes.xip, xim=modes.xim, error=np.sqrt(modes.varxip))
        | _where(is_complete, map2=map2, mx2=mx2, map2_error=np.sqrt(variance))
    }
    if points is not None:
        about = treecorr.NGCorrelation(**separations)
        about.process(catalogue(_columns("points", points, ("ra", "dec"))), sources)
        found["points"] = _where(about.npairs > 0, r=about.meanr, gt=about.xi, gx=about.xi_im, error=np.sqrt(about.varxi))
    if stars is not None:
        found["rho"] = _rho(treecorr, catalogue, stars, separations)
    if all(name in against for name in _PSF):
        found["leakage"] = _leakage(galaxies, weight)
    for name in against:
        found[name] = _means(galaxies, weight, name, bins)
    return found


def _rho(treecorr: Any, catalogue: Any, stars: Any, separations: dict[str, Any]) -> dict[str, Any]:
    names = ("ra", "dec", "e1", "e2", "T", "model_e1", "model_e2", "model_T")
    table = _columns("stars", stars, names)
    size = (table["T"] - table["model_T"]) / table["T"]
    # Spin-2 fields: the PSF's shape, its residual, and the shape times the residual of the size.
    shape = [table["e1"], table["e2"]]
    residual = [table["e1"] - table["model_e1"], table["e2"] - table["model_e2"]]
    fields = [catalogue(table, g1=g1, g2=g2) for g1, g2 in (shape, residual, [e * size for e in shape])]
    found: dict[str, Any] = {}
    for number, (first, second) in enumerate([(1, 1), (1, 0), (2, 2), (1, 2), (0, 2)], 1):
        pairs = treecorr.GGCorrelation(**separations)
        pairs.process(fields[first], None if first == second else fields[second])
        found |= _where(pairs.npairs > 0, **{"r": pairs.meanr, f"rho{number}": pairs.xip, f"rho{number}_error": np.sqrt(pairs.varxip)})
    return found


def _where(is_known: Any, **columns: Any) -> dict[str, Any]:
    return {name: np.where(is_known, values, np.nan) for name, values in columns.items()}


def _leakage(galaxies: Mapping[str, Any], weight: Any) -> dict[str, Any]:
    found: dict[str, list[float]] = {"alpha": [], "error": []}
    for component, name in zip(("g1", "g2"), _PSF):
        g, e = (values - np.average(values, weights=weight) for values in (galaxies[component], galaxies[name]))
        power = np.sum(weight * e * e)
        # With one PSF for all galaxies, whose mean is rounded, α cannot be told from c.
        if power <= 1e-12 * np.sum(weight * galaxies[name] ** 2):
            power = np.nan
        alpha = np.sum(weight * e * g) / power
        found["alpha"].append(alpha)
        # From the scatter of the residuals, so that galaxies may have any weights.
        found["error"].append(np.sqrt(np.sum((weight * e * (g - alpha * e)) ** 2)) / power)
    return {key: np.array(values) for key, values in found.items()}


def _means(galaxies: Mapping[str, Any], weight: Any, name: str, bins: int) -> dict[str, Any]:
    rows: dict[str, list[float]] = {key: [] for key in ("at", "g1", "g2", "g1_error", "g2_error")}
    for chosen in np.array_split(np.argsort(galaxies[name], kind="stable"), bins):
        w = weight[chosen]
        rows["at"].append(np.average(galaxies[name][chosen], weights=w))
        for key in ("g1", "g2"):
            mean = np.average(galaxies[key][chosen], weights=w)
            rows[key].append(mean)
            rows[f"{key}_error"].append(np.sqrt(np.sum((w * (galaxies[key][chosen] - mean)) ** 2)) / np.sum(w))
    return {key: np.array(values) for key, values in rows.items()}


def _read(name: str, table: Any) -> Any:
    """A table, which a path may name."""
    if not isinstance(table, (str, os.PathLike)):
        return table
    file = pathlib.Path(table)
    if file.suffix.lower() not in (".parquet", ".pq", ".fits", ".fit"):
        raise ValueError(f"{name}: found the path {file}; expected a Parquet or FITS file, or a table. Try: pandas.read_csv, or astropy.table.Table.read")
    if not file.exists():
        raise FileNotFoundError(f"{name}: there is no file {file}")
    return _shearq.read_table(str(file), file_format(file), [])[0]


def _names(table: Any) -> list[str]:
    names = getattr(getattr(table, "dtype", None), "names", None) or getattr(table, "columns", None)
    return list(table if names is None else names)


def _columns(name: str, table: Any, wanted: tuple[str, ...]) -> dict[str, Any]:
    absent = [column for column in wanted if column not in _names(table)]
    if absent:
        raise ValueError(f"{name}: no column {', '.join(absent)} (expected {', '.join(wanted)})")
    return {column: np.asarray(table[column], float) for column in wanted}
