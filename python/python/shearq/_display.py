"""Catalogues and scores in notebooks and plots. Plots need matplotlib."""

from __future__ import annotations

import html as escape
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np

# Rows that are shown.
_SHOWN = 8
# Cells per side of a map, and the shear of an arrow of one cell.
_CELLS = 10


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, (float, np.floating)) else str(value)


def _table(caption: str, headings: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    def line(cells: Iterable[str], kind: str) -> str:
        return "<tr>" + "".join(f"<{kind}>{escape.escape(cell)}</{kind}>" for cell in cells) + "</tr>"

    body = "".join(line(row, "td") for row in rows)
    return f"<table><caption>{escape.escape(caption)}</caption>{line(headings, 'th')}{body}</table>"


def html(catalogue: Any) -> str:
    names = catalogue.dtype.names or ()
    if catalogue.ndim != 1:
        return f"<pre>{escape.escape(repr(catalogue))}</pre>"
    flagged = int((catalogue["flags"] != 0).sum()) if "flags" in names else 0
    more = f", the first {_SHOWN} shown" if len(catalogue) > _SHOWN else ""
    text = f"shearq.Catalogue of {len(catalogue)} galaxies, {flagged} flagged{more}"
    return _table(text, names, ([_number(row[name]) for name in names] for row in catalogue[:_SHOWN]))


def table_html(caption: str, headings: list[str], rows: list[list[str]], notes: list[str]) -> str:
    listed = "".join(f"<li>{escape.escape(note)}</li>" for note in notes)
    return _table(caption, headings, rows) + (f"<ul>{listed}</ul>" if listed else "")


def _axes(ax: Any) -> Any:
    if ax is not None:
        return ax
    try:
        from matplotlib import pyplot
    except ImportError:
        raise ImportError("plots need matplotlib. Try: pip install matplotlib") from None
    # Without this layout, long labels of axes are cut off.
    return pyplot.subplots(layout="constrained")[1]


def _log_axis(ax: Any, low: float, high: float) -> None:
    """A logarithmic horizontal axis with 1, 2 and 5 times powers of ten as plain numbers."""
    ax.set_xscale("log")
    ticks = [factor * 10.0**power for power in range(-3, 7) for factor in (1, 2, 5)]
    ticks = [tick for tick in ticks if low <= tick <= high]
    if len(ticks) > 1:
        ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        ax.set_xticks([], minor=True)


def plot_catalogue(catalogue: Any, kind: Literal["histogram", "map"], ax: Any) -> Any:
    good = catalogue[catalogue.good]
    if kind == "histogram":
        ax = _axes(ax)
        mean = catalogue.mean_shear()
        for k, colour in ((1, "C0"), (2, "C1")):
            e = good[f"e{k}"]
            # The tails of noisy galaxies would leave the rest in one bin.
            edge = float(np.quantile(np.abs(e), 0.99))
            ax.hist(e, bins=60, range=(-edge, edge), histtype="step", color=colour, label=f"e{k}")
            ax.axvline((mean.g1, mean.g2)[k - 1], color=colour, linestyle="--", linewidth=1)
        ax.set(xlabel="ellipticity", ylabel="galaxies")
        ax.set_title(str(mean), fontsize="small", wrap=True)
        ax.legend()
        return ax
    if kind != "map":
        raise ValueError(f"kind: found {kind!r}; expected 'histogram' or 'map'")
    names = catalogue.dtype.names or ()
    if "x" not in names or "y" not in names:
        raise ValueError("kind: found 'map' of a catalogue without positions; expected columns x and y. Try: measure(…, x=x, y=y)")
    ax = _axes(ax)
    cells = []
    edges = [np.linspace(good[axis].min(), np.nextafter(good[axis].max(), np.inf), _CELLS + 1) for axis in "xy"]
    place = [np.clip(np.digitize(good[axis], edge) - 1, 0, _CELLS - 1) for axis, edge in zip("xy", edges)]
    for j in range(_CELLS):
        for i in range(_CELLS):
            here = good[(place[0] == i) & (place[1] == j)]
            if len(here) > 1:
                g1, g2 = here.mean_shear()
                cells.append((here["x"].mean(), here["y"].mean(), g1, g2))
    if not cells:
        raise ValueError("catalogue: no cell has two good galaxies; expected more galaxies")
    x, y, g1, g2 = np.array(cells).T
    size, angle = np.hypot(g1, g2), 0.5 * np.arctan2(g2, g1)
    style = dict(headwidth=0, headlength=0, headaxislength=0, pivot="middle", angles="xy")
    arrows = ax.quiver(x, y, size * np.cos(angle), size * np.sin(angle), **style)
    typical = float(np.median(size))
    ax.quiverkey(arrows, 0.85, 1.03, typical, f"shear {typical:.2g}", labelpos="E")
    ax.set(xlabel="x (px)", ylabel="y (px)", aspect="equal")
    return ax


def plot_score(score: Any, ax: Any) -> Any:
    ax = _axes(ax)
    table = score.spectrum
    chosen = table["modes"] > 0
    l, error = table["l"][chosen], table["ee_error"][chosen]
    error = np.where(np.isfinite(error), error, 0.0)
    ax.errorbar(l, table["ee"][chosen], error, fmt="o", markersize=4, label="EE")
    ax.plot(l, table["bb"][chosen], "x", markersize=4, label="BB")
    ax.plot(l, table["true_ee"][chosen], color="black", linewidth=1, label="true EE")
    ax.set(xlabel="ℓ", ylabel="ℓ²C(ℓ)/2π")
    ax.set_title(repr(score).strip("<>"), fontsize="small", wrap=True)
    _log_axis(ax, l.min(), l.max())
    ax.set_yscale("symlog", linthresh=max(float(np.nanmax(np.abs(table["true_ee"]))) * 1e-2, 1e-12))
    if min(table["ee"][chosen].min(), table["bb"][chosen].min()) >= 0:
        ax.set_ylim(bottom=0)
    ax.legend()
    return ax


# The tightest published requirements, as on the command line (docs/validate-shapes.md).
_LIMIT = {"m": 2e-3, "c": 2e-4}


def plot_bias(bias: Any, quantity: Literal["m", "c"], limit: float | None, ax: Any) -> Any:
    if quantity not in _LIMIT:
        raise ValueError(f"quantity: found {quantity!r}; expected 'm' or 'c'")
    ax = _axes(ax)
    limit = _LIMIT[quantity] if limit is None else limit
    ax.axhspan(-limit, limit, color="0.85", label=f"|{quantity}| < {limit:g}")
    ax.axhline(0, color="0.5", linewidth=0.8)
    # The first row is of all galaxies.
    rows = bias.rows[1:] or bias.rows
    ends = np.array([[np.nan if row.get(key) is None else row[key] for key in ("low", "high")] for row in rows], dtype=float)
    # Outer bins have no end, and stand at their inner edge.
    ends[np.abs(ends) > 1e300] = np.nan
    known = np.isfinite(ends)
    places = np.where(known.any(axis=1), np.where(known, ends, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1), np.arange(len(rows)))
    apart = 0.012 * (float(np.ptp(places)) or 1.0)
    for k, colour, marker in ((1, "C0", "o"), (2, "C1", "s")):
        key = f"{quantity}{k}"
        value, error = (
            np.array([np.nan if row.get(name) is None else row[name] for row in rows], dtype=float) for name in (key, f"{key}_error")
        )
        if np.isfinite(value).any():
            ax.errorbar(places + (k - 1.5) * apart, value, error, fmt=marker, color=colour, markersize=4, capsize=2, label=key)
    ax.margins(x=0.1)
    if not known.any():
        ax.set_xticks([])
    meaning = {"m": "Multiplicative bias", "c": "Additive bias"}[quantity]
    ax.set(xlabel=bias.binned or "all galaxies", ylabel=quantity, title=f"{meaning} of {bias['n']:.0f} galaxies")
    ax.legend(fontsize="small")
    return ax
