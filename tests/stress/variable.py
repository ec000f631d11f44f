#!/usr/bin/env python3
"""Q_v of simulated fields of a variable branch of GREAT3, and the Q_v that their noise allows.

    for seed in $(seq 211 260); do
        shearq simulate --challenge great3 --branch control-ground-variable --subfields 20 --seed $seed --out fields/$seed
        shearq measure --data fields/$seed/control/ground/variable --submission 48/linear/star --out fields/$seed/measured
    done
    python3 tests/stress/variable.py fields

Each seed is one field. Noise allows what true shapes reach with the residuals of the measured ones in random order: they have the
same scatter, and know nothing of place or shape. It needs the Python package of shearq, astropy and pyarrow.
"""

import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet
import shearq
from astropy.table import Table

SUBFIELDS, FIELDS, SIDE = 20, 10, 700
#: Radii that Q_v averages over, and its σ² on the ground (great3.md).
RADII, LEAST = slice(3, 13), 9e-8
#: Random orders of the residuals of a field, and random tens of fields.
ORDERS, TENS = 4, 4000


def shapes(field):
    """True and measured ellipticities of a field, and IDs."""
    true, measured, ids = [], [], []
    for subfield, path in enumerate(sorted((field / "measured").rglob("catalogue-*.parquet"))):
        truth = Table.read(field / f"truth/control/ground/variable/galaxy_catalog-{subfield:03}.fits")
        found = parquet.read_table(path, columns=["id", "e1", "e2", "R11", "flags"]).to_pandas()
        if not (np.array_equal(truth["ID"], found["id"]) and (found["flags"] == 0).all()):
            sys.exit(f"{path}: other galaxies than the truth, or galaxies with flags")
        g, shape = (np.array(truth[f"g1{of}"] + 1j * truth[f"g2{of}"]) for of in ("", "_intrinsic"))
        true.append((shape + g) / (1 + g.conj() * shape))
        measured.append((found["e1"] + 1j * found["e2"]).to_numpy() / found["R11"].mean())
        ids.append(found["id"].to_numpy())
    return (np.concatenate(part) for part in (true, measured, ids))


def aperture(e, ids):
    """⟨M_ap²⟩ of E modes at the radii of Q_v."""
    nodes = ids // 1000 % 1000, ids % 1000
    return shearq.aperture_mass(e.real.copy(), e.imag.copy(), nodes=nodes, side=SIDE)["map_e"][RADII]


def quality(off, random):
    """Mean Q_v of random tens of fields that are off the truth by this."""
    tens = (off[random.permutation(len(off))[:FIELDS]] for _ in range(TENS))
    return np.mean([1.837e-4 / (LEAST + np.abs(ten.mean(0)).mean()) for ten in tens])


def main():
    random = np.random.default_rng(1)
    off, allowed, truths = [], [], []
    for field in sorted(path for path in Path(sys.argv[1]).iterdir() if path.is_dir()):
        true, measured, ids = shapes(field)
        truth = aperture(true, ids)
        orders = [true + random.permutation(measured - true) for _ in range(ORDERS)]
        off.append(aperture(measured, ids) - truth)
        allowed.append([aperture(order, ids) - truth for order in orders])
        truths.append(truth)
    off, allowed, truth = np.array(off), np.array(allowed), np.mean(truths, 0).sum()
    least = np.mean([quality(allowed[:, order], random) for order in range(ORDERS)])
    error = off.sum(1).std(ddof=1) / np.sqrt(len(off)) / abs(truth)
    print(f"{len(off)} fields: Q_v {quality(off, random):.0f}, noise allows {least:.0f}; ⟨M_ap²⟩ off by {off.sum(1).mean() / truth:+.4f} ± {error:.4f}")


if __name__ == "__main__":
    main()
