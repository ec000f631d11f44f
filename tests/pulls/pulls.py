"""Scatter of m and c over many simulated catalogues, in units of the errors that `shearq bias` states, for each design.

    python3 tests/pulls/pulls.py --shearq target/release/shearq [--catalogues 200] [--designs pairs,fields] [--seed 1]

The standard deviation of (m - m_true)/sigma is 1 if errors are right; over 200 catalogues it is known to 0.05. Shapes scatter by 0.25,
noise by 0.05, and the response of a galaxy is 0.8 +- 0.2. Versions are several measurements of the same galaxies: images that are
rotated by 90 degrees, other noise, other bands. Needs numpy and pyarrow.
"""

import argparse
import json
import pathlib
import subprocess
import tempfile

import numpy as np
import pyarrow
import pyarrow.parquet

M, C = np.array([0.02, -0.03]), np.array([1e-3, -2e-3])
SHAPES, NOISE = 0.25, 0.05


class Galaxies:
    def __init__(self, random, number, first=0):
        self.random, self.id = random, first + np.arange(number)
        self.shapes = SHAPES * random.normal(size=(2, number))
        self.response = 0.8 + 0.2 * random.normal(size=(2, number))

    def table(self, g, turn=1, c=C, **more):
        """Measured under a shear, with new noise; `turn` is -1 after a rotation by 90 degrees."""
        g = np.asarray(g, float).reshape(2, -1) * np.ones(len(self.id))
        noise = NOISE * self.random.normal(size=self.shapes.shape)
        e = turn * self.shapes + noise + self.response * ((1 + M)[:, None] * g + c[:, None])
        columns = dict(id=self.id, e1=e[0], e2=e[1], R11=self.response[0], R22=self.response[1], g1=g[0], g2=g[1])
        return columns | more


def one(random):
    return {"c": Galaxies(random, 2000).table((0.02, 0.03), c=0 * C)}


def null(random):
    own = Galaxies(random, 2000).table((0, 0))
    return {"c": {name: own[name] for name in ("id", "e1", "e2", "R11", "R22")}}


def galaxies(random):
    return {"c": Galaxies(random, 2000).table(0.05 * random.normal(size=(2, 2000)))}


def galaxies_bands(random):
    own, g = Galaxies(random, 1000), 0.05 * random.normal(size=(2, 1000))
    bands = [own.table(g) for _ in range(3)]
    return {"c": {name: np.concatenate([band[name] for band in bands]) for name in bands[0]}}


def rotated(random):
    own, g = Galaxies(random, 1000), 0.05 * random.normal(size=(2, 1000))
    both = own.table(g), own.table(g, turn=-1)
    return {"c": {name: np.stack([a, b], axis=1).ravel() for (name, a), b in zip(both[0].items(), both[1].values())}}


def pairs(random):
    own = Galaxies(random, 1000)
    return {sign: own.table((g, g)) for sign, g in (("plus", 0.02), ("minus", -0.02))}


def tiles(random, arms, versions, number=24, same=True, size=100):
    """Catalogues of tiles under several shears, in several versions."""
    files = {}
    for tile in range(number):
        for arm, g in arms.items():
            if not same or arm == next(iter(arms)):
                own = Galaxies(random, size, 1000 * len(files))
            for version, turn in versions.items():
                columns = own.table(g, turn)
                del columns["id"]
                files[f"{arm}{version}/tile{tile:02d}"] = columns
    return files


PAIR = {"plus": (0.02, 0.02), "minus": (-0.02, -0.02)}
FOUR = {"a": (0.02, 0), "b": (-0.02, 0), "c": (0, 0.02), "d": (0, -0.02)}
UNLIKE = {"a": (0.02, -0.01), "b": (0, 0.03), "c": (-0.01, 0)}
PLAIN, TURNED, NOISES = {"": 1}, {"_rot0": 1, "_rot90": -1}, {"_noise1": 1, "_noise2": 1, "_noise3": 1}


def fields(random, versions=PLAIN):
    files = {}
    for field in range(60):
        own, g = Galaxies(random, 100), 0.03 * random.normal(size=2)
        for version, turn in versions.items():
            columns = own.table(g, turn)
            del columns["id"]
            files[f"field{field:02d}{version}"] = columns
    return files


# The design, its versions, the catalogues and the options.
DESIGNS = [
    ("single", "none", one, []),
    ("null", "none", null, []),
    ("galaxies", "none", galaxies, []),
    ("galaxies", "3 bands, rows with one id", galaxies_bands, []),
    ("rotated", "neighbouring rows", rotated, ["--design", "rotated"]),
    ("pairs", "none, rows with one id", pairs, []),
    ("pairs", "none, tiles", lambda r: tiles(r, PAIR, PLAIN), []),
    ("pairs", "2 rotations", lambda r: tiles(r, PAIR, TURNED), []),
    ("pairs", "3 noise realisations", lambda r: tiles(r, PAIR, NOISES), []),
    ("shears", "none, four shears", lambda r: tiles(r, FOUR, PLAIN), []),
    ("shears", "2 rotations, four shears", lambda r: tiles(r, FOUR, TURNED), []),
    ("shears", "none, unlike shears", lambda r: tiles(r, UNLIKE, PLAIN), []),
    ("shears", "3 noise realisations, unlike shears", lambda r: tiles(r, UNLIKE, NOISES), []),
    ("fields", "none", fields, []),
    ("fields", "3 noise realisations", lambda r: fields(r, NOISES), []),
]


def estimate(shearq, files, options):
    with tempfile.TemporaryDirectory() as folder:
        paths = []
        for name, columns in files.items():
            path = pathlib.Path(folder, name + ".parquet")
            path.parent.mkdir(exist_ok=True)
            pyarrow.parquet.write_table(pyarrow.table(columns), path)
            paths.append(str(path))
        found = subprocess.run([shearq, "bias", *paths, "--format", "json", *options], capture_output=True, text=True)
        if found.returncode:
            raise SystemExit(found.stderr)
        return json.loads(found.stdout)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--shearq", default="shearq")
    parser.add_argument("--catalogues", type=int, default=200)
    parser.add_argument("--designs", default="")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    print("design,versions,units,m1,m2,c1,c2")
    for number, (design, versions, simulate, options) in enumerate(DESIGNS):
        if arguments.designs and design not in arguments.designs.split(","):
            continue
        pulls, units = [], None
        for catalogue in range(arguments.catalogues):
            random = np.random.default_rng([arguments.seed, number, catalogue])
            found = estimate(arguments.shearq, simulate(random), options)
            assert f"Design: {design} (" in found["notes"][0], found["notes"][0]
            row = found["rows"][0]
            units = row["units"]
            true = dict(m1=M[0], m2=M[1], c1=C[0], c2=C[1])
            pulls.append([(row[key] - true[key]) / row[key + "_error"] if row[key] is not None else np.nan for key in true])
        spread = np.std(pulls, axis=0, ddof=1)
        shown = ["" if np.isnan(own) else f"{own:.2f}" for own in spread]
        print(f'{design},"{versions}",{units:.0f},' + ",".join(shown), flush=True)


if __name__ == "__main__":
    main()
