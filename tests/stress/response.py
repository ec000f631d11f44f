"""The excess of shears that are divided by the mean response of few galaxies, at S/N 10.

A mean response R̂ of N galaxies is noisy, so that ē/R̂ exceeds ē/⟨R⟩. To first order in 1/N the excess is κ/N of the shear, with

    κ = ⟨(R − ⟨R⟩)²⟩/⟨R⟩² − ⟨(R − ⟨R⟩)(d − ⟨d⟩)⟩/(⟨R⟩⟨d⟩),    d = (e₊ − e₋)/2γ,

of galaxies under shears of ±γ with the same noise. Neither shapes nor the noise of e enter, so that some ten thousand galaxies determine
what a comparison of shears would need 10⁷ for. `measured` compares both divisions of the same galaxies in images of N.

`python3 tests/stress/response.py --shearq target/release/shearq` needs pandas and pyarrow.
"""

import argparse
import pathlib
import subprocess
import tempfile

import numpy as np
import pandas

SHEAR = 0.02
COUNTS = (40, 400)
DRAWS = 20


def catalogues(shearq, grid, seed, folder):
    """Catalogues of the sign of the shear and of the rotation."""
    subprocess.run([shearq, "simulate", "--sets", "5", "--images", "1", "--grid", str(grid), "--seed", str(seed), "--constant-shear",
                    f"{SHEAR},{SHEAR}", "--opposite", "--rotated", "--out", folder / "sim"], check=True, capture_output=True)
    found = {}
    for sign in "+-":
        for turn in ("", "_rotated"):
            name = f"g1_{sign}0.02_g2_{sign}0.02{turn}"
            subprocess.run([shearq, "measure", "--submission", "48/linear/star", "--data", folder / "sim" / name, "--out", folder / name],
                           check=True, capture_output=True)
            found[sign, turn] = pandas.read_parquet(folder / name / "set05/catalogue-001.parquet")
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shearq", type=pathlib.Path, required=True)
    parser.add_argument("--grid", type=int, default=140, help="galaxies per side")
    parser.add_argument("--seed", type=int, default=61)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = catalogues(options.shearq.resolve(), options.grid, options.seed, pathlib.Path(folder))
    good = np.all([one["flags"] == 0 for one in found.values()], axis=0)
    rng = np.random.default_rng(options.seed)
    for k in "12":
        e, own = ({sign: np.concatenate([found[sign, turn][name][good] for turn in ("", "_rotated")]) for sign in "+-"}
                  for name in (f"e{k}", f"R{k}{k}"))
        d = (e["+"] - e["-"]) / (2 * SHEAR)
        both = (own["+"] + own["-"]) / 2
        mean, signal = both.mean(), d.mean()
        terms = sum((own[sign] - mean) ** 2 for sign in "+-") / 2 / mean**2 - (d - signal) * (both - mean) / (mean * signal)
        # Rotated versions share their noise.
        error = terms.std() / np.sqrt(len(terms) / 2)
        print(f"component {k}: κ = {terms.mean():.3f} ± {error:.3f}")
        for count in COUNTS:
            excess = []
            for _ in range(DRAWS):
                images = rng.permutation(len(d))[: len(d) // count * count].reshape(-1, count)
                image = sum((1 if sign == "+" else -1) * e[sign][images].mean(1) / own[sign][images].mean(1) for sign in "+-") / (2 * SHEAR)
                excess.append((image - d[images].mean(1) / mean).mean() / signal * mean)
            spread = (image - d[images].mean(1) / mean).std() / np.sqrt(len(images)) / signal * mean
            print(f"  {count} per image: κ/N = {1e3 * terms.mean() / count:+.2f} ± {1e3 * error / count:.2f}, "
                  f"measured {1e3 * np.mean(excess):+.2f} ± {1e3 * spread:.2f} (10⁻³)")


if __name__ == "__main__":
    main()
