"""Readings held against statements: what the cells of a reading predict, and how far that is from the paper."""

import itertools

import numpy as np

from predict import Leaderboard

# Of each kind: the set that stands for it, how many of the 24 sets are of it, its S/N, and its size over the
# fiducial one (docs/reproduction.md; radii of small, fiducial and large discs 2.6, 4.8 and 10 px, of bulges
# 1.8, 2.3 and 3.4 px: geometric means).
KINDS = {
    "fiducial": (2, 3, 20, 1.0),
    "low-snr": (5, 3, 10, 1.0),
    "high-snr": (8, 3, 40, 1.0),
    "smooth-snr": (11, 3, 20, 1.0),
    "small": (14, 2, 20, 0.65),
    "large": (16, 2, 20, 1.75),
    "smooth-size": (18, 2, 20, 1.0),
    "kolmogorov": (20, 2, 20, 1.0),
    "bulge-fraction": (22, 2, 20, 1.0),
    "offset": (24, 2, 20, 1.0),
}
assert sum(weight for _, weight, _, _ in KINDS.values()) == 24
# What GREAT10 did not publish, with the range in which it is left open, each value as likely as any other:
# the power of the shear over the fiducial spectrum, S/N over that of the simulator (its definition), and sizes
# of galaxies over the simulator's.
NUISANCES = {
    "amplitude": [1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0],
    "snr": [0.8, 1.0, 1.25, 1.6, 2.0],
    "size": [0.8, 1.0, 1.25],
}
# A single statement counts for no more than four tolerances.
MOST = 4.0

BOARD = Leaderboard()


def through(points, at):
    """The parabola through three points (x, y); beyond them it goes on along its slope there."""
    (x, y) = np.array(points, float).T
    curve = np.polyfit(x, y, 2)
    inside = np.clip(at, x.min(), x.max())
    slope = np.polyval(np.polyder(curve), inside)
    return np.polyval(curve, inside) + slope * (at - inside)


def scaled(cells, kind, snr, size):
    """Response and variance of a kind's cell with S/N and size changed by factors, by what the cells of other
    S/N and size tell: their ratios are those of the fiducial galaxy."""
    cell = cells[kind]
    _, _, own_snr, own_size = KINDS[kind]
    gain, spread = 1.0, 1.0
    for axis, names, factor, own in [
        (2, ["low-snr", "fiducial", "high-snr"], snr, own_snr),
        (3, ["small", "fiducial", "large"], size, own_size),
    ]:
        if factor == 1.0:
            continue
        for what in ("response", "variance"):
            value = lambda name: np.log(max(np.mean(cells[name][what]), 1e-6))
            points = [(np.log(KINDS[name][axis]), value(name)) for name in names]
            ratio = np.exp(through(points, np.log(own * factor)) - through(points, np.log(own)))
            if what == "response":
                gain *= ratio
            else:
                spread *= ratio
    return [gain * r for r in cell["response"]], spread * float(np.mean(cell["variance"]))


def sets(cells, amplitude):
    """Q, M/2 and √A of each kind of set, of which `cells` has response and variance."""
    return {kind: BOARD.figures(*cells[kind], amplitude=amplitude) for kind in KINDS}


def mean(figures):
    """The mean over 24 sets."""
    weights = [KINDS[kind][1] for kind in figures]
    return np.average(list(figures.values()), axis=0, weights=weights)


def table_one(rows, amplitude):
    """Figures of Sect. 5 by name. `rows` has response and variance of each row, by kind."""
    found = {}
    for row, cells in rows.items():
        each = sets(cells, amplitude)
        q, m_half, sqrt_a = mean(each)
        found |= {f"q {row}": q, f"m_half {row}": m_half, f"sqrt_a {row}": sqrt_a}
        # Sect. 5.3 speaks of all submissions; the denoised one stands for them, which the abstract takes.
        if row == "23/den":
            for kind in KINDS:
                found[f"q {kind} over q fiducial"] = each[kind][0] / each["fiducial"][0]
    for a, b in [("q 23/den", "q 23/raw"), ("q 29/den", "q 23/den"), ("sqrt_a 23/den", "sqrt_a 23/raw")]:
        if a in found and b in found:
            found[f"{a} over {b}"] = found[a] / found[b]
    return found


def better(adaptive, constant):
    """1/RMSD of the one over that of the other, between a half and two. An update that leaves no galaxy with a
    shape is as bad as that; one where neither does tells nothing and is as good as the other."""
    a, c = np.nan_to_num(adaptive), np.nan_to_num(constant)
    ratio = np.divide(a, c, out=np.where(a > 0, 2.0, 1.0), where=c > 0)
    return np.clip(ratio, 0.5, 2.0)


def calibration(curves):
    """Figures of Sect. 4 by name. `curves[update][snr]` has lists over λ."""
    lam = np.array(curves["log_lambda"])
    adaptive, constant = (
        {snr: {key: np.array(values) for key, values in curve.items()} for snr, curve in curves[update].items()}
        for update in ("adaptive", "constant")
    )
    weak, strong = lam <= -4, lam > -4
    at = lambda value: int(np.argmin(np.abs(lam - value)))
    # The mean over S/N, whose maxima need not be at one λ.
    ctr = np.mean([adaptive[snr]["ctr"] for snr in adaptive], axis=0)
    ratio = {snr: better(adaptive[snr]["inverse_rmsd"], constant[snr]["inverse_rmsd"]) for snr in adaptive}
    dsnr = np.array([adaptive[snr]["dsnr_db"] for snr in ("10", "20", "40")])
    return {
        "log lambda of ctr": lam[np.nanargmax(ctr)] if np.isfinite(ctr).any() else np.nan,
        "ctr 40 dB less 10 dB": (adaptive["40"]["ctr"] - adaptive["10"]["ctr"])[at(-3.5)],
        "least ctr of adaptive less constant": min(
            (adaptive[snr]["ctr"] - constant[snr]["ctr"])[at(-3.5)] for snr in adaptive
        ),
        "least step of dsnr with snr": np.diff(dsnr[:, at(-4)]).min(),
        "fall of dsnr": (dsnr[:, 0] - dsnr[:, -1]).min(),
        "least rmsd ratio, weak lambda": min(r[weak].min() for r in ratio.values()),
        "mean rmsd ratio, strong lambda, 20 and 40 dB": np.mean([ratio[s][strong] for s in ("20", "40")]),
        "mean rmsd ratio, strong lambda, 10 dB": np.mean(ratio["10"][strong]),
    }


def apart(statement, figure):
    """By how many tolerances a figure misses a statement, at most MOST."""
    if figure is None or not np.isfinite(figure):
        return MOST
    tolerance = statement["tolerance"]
    if "value" in statement:
        miss = abs(figure - statement["value"])
    elif "above" in statement:
        miss = max(statement["above"] - figure, 0.0)
    else:
        miss = max(figure - statement["below"], 0.0)
    return min(miss / tolerance, MOST)


def judge(statements, rows, curves):
    """How a reading does: its χ² marginalised over the nuisances, its best χ² with the nuisances that give it, and
    at these the figure and distance of each statement. Statements about what was not measured are left out."""
    fixed = calibration(curves) if curves else {}
    changed = {
        (snr, size): {
            row: {kind: scaled(cells, kind, snr, size) for kind in KINDS} for row, cells in rows.items()
        }
        for snr, size in itertools.product(NUISANCES["snr"], NUISANCES["size"])
    }
    trials = []
    for amplitude, snr, size in itertools.product(*NUISANCES.values()):
        figures = table_one(changed[snr, size], amplitude) | fixed
        told = [s for s in statements if s["what"] in figures]
        distance = [apart(s, figures[s["what"]]) for s in told]
        nuisance = (amplitude, snr, size)
        trials.append((float(np.sum(np.square(distance))), nuisance, figures, told, distance))
    best = min(trials, key=lambda trial: trial[0])
    chi = np.array([trial[0] for trial in trials])
    marginal = best[0] - 2 * np.log(np.mean(np.exp(-0.5 * (chi - best[0]))))
    plain = table_one(changed[1.0, 1.0], 1.0)
    return {
        "marginal": marginal,
        "best": best[0],
        "nuisances": dict(zip(NUISANCES, best[1])),
        "metrics": {key: float(value) for key, value in best[2].items()},
        "plain": {key: float(value) for key, value in plain.items()},
        "statements": {s["id"]: (float(best[2][s["what"]]), d) for s, d in zip(best[3], best[4])},
    }
