"""m and c of `shearq detect` at weak shear, on scenes under a shear, its opposite and none.

    python tests/stress/detected.py --shearq target/release/shearq --work FOLDER --variant default --scenes 150 --seed 9001

The mean response of catalogues under ±g contains terms of the order g², so that m of two shears has terms in |g|² that no weak shear
has. The response is that to a shear which is added to g by (g + δ)/(1 + g* δ): along g, δ changes it by 1 - |g|². The integral of
R/(1 - |g|²) from -g to g is, by Simpson's rule, 2g (k R(-g) + 4 R(0) + k R(g)) / 6 with k = 1/(1 - |g|²), and

    m = (e(+g) - e(-g)) / (integral of R/(1 - |g|²)) - 1

is zero for each estimator whose response is the derivative of its mean, for strong shears, too. Shears of 0.08 give errors of m four
times as small as those of 0.02. The script prints m by this response and by that of ±g alone, which is larger by |g|²/3 for a
constant response.

Galaxies that a shear moves across the edge of a mask are in one of the versions only, so that pairs cancel less of their shapes. Of
the variant `stars`, sums are those of the same scenes without stars, averaged over the mask's eight reflections and turns (which are as
likely as the mask, because stars lie anywhere), and what the light of the stars changes under their own mask. Their expectation is that
of the sums with stars, and their scatter smaller.

Each piece of scenes is simulated, measured and deleted. Sums of a scene are added to FOLDER/VARIANT.jsonl, so that a stopped run
continues; `--report` prints the results of all variants in FOLDER.
"""

import argparse
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import polars as pl
from astropy.io import fits

SHEAR = 0.08
#: In px: in the corners, both components of 0.08 move galaxies by 0.16 of half a side of 1500, at most 104 px from an inner border.
BORDER = 130
SIDE = 1500
#: Options of `simulate`.
VARIANTS = {
    "default": [],
    "sparse": ["--density", "40"],
    "dense": ["--density", "150"],
    "seeing": ["--seeing", "1"],
    "sharp": ["--seeing", "0.55"],
    "stars": ["--stars", "1"],
    "elliptical-psf": ["--psf-shape", "0.04,0.03"],
    "cosmos": [],
    "epochs": ["--epochs", "3"],
}
#: Light of a star above which a pixel is masked, in units of the noise.
STAR_LIGHT = 0.02
#: Of the PSF of `simulate`: β and FWHM in px of the Moffat profile.
BETA, FWHM = 3.0, 3.5


def star_mask(truth):
    """Pixels in which the light of a star exceeds STAR_LIGHT: discs, which are the same under all shears."""
    masked = np.zeros((SIDE, SIDE), np.uint8)
    y, x = np.mgrid[1 : SIDE + 1, 1 : SIDE + 1]
    alpha = FWHM / 2 / np.sqrt(2 ** (1 / BETA) - 1)
    peak = (BETA - 1) / (np.pi * alpha**2)
    for star_x, star_y, flux in truth.filter(pl.col("star") == 1).select("x", "y", "flux").iter_rows():
        radius = alpha * np.sqrt((flux * peak / STAR_LIGHT) ** (1 / BETA) - 1)
        masked |= (x - star_x) ** 2 + (y - star_y) ** 2 < radius**2
    return masked


def detected_sums(options, exposure, mask=None):
    """The number of rows, and their sums of ellipticities and responses."""
    out = exposure.parent.parent / "detected"
    masked = []
    if mask is not None:
        masked = ["--mask", out.with_suffix(".fits")]
        fits.writeto(masked[1], mask, overwrite=True)
    epochs = sorted(exposure.parent.glob(f"{exposure.stem}*.fits"), key=lambda path: (len(path.stem), path.stem))
    run(options, "detect", "--exposure", *epochs, "--psf", exposure.parent / "psf.fits", "--noise", 1, *masked, "--out", out)
    (catalogue,) = out.glob("set01/*.parquet")
    rows = pl.read_parquet(catalogue, columns=["e1", "e2", "R11", "R12", "R21", "R22"])
    shutil.rmtree(out)
    return np.array([rows.height, *(float(rows[name].sum()) for name in ("e1", "e2", "R11", "R12", "R21", "R22"))])


def star_sums(options, exposure, without_stars, truth):
    """Sums as of an exposure with masked stars, with less scatter."""
    mask = star_mask(truth)
    turned = [np.ascontiguousarray(np.rot90(own, k)) for own in (mask, mask.T) for k in range(4)]
    own, *others = [detected_sums(options, without_stars, mask) for mask in turned]
    return np.mean([own, *others], axis=0) + detected_sums(options, exposure, mask) - own


def piece(options, variant, seed, scenes):
    """Sums of each scene: `[scene][version]`, versions as (g, rotated, noise)."""
    work = Path(options.work) / f"{variant}-{seed}"
    shutil.rmtree(work, ignore_errors=True)
    more = VARIANTS[variant] + (["--galaxies", options.cosmos] if variant == "cosmos" else [])
    for g, both in ((SHEAR, ["--opposite"]), (0.0, [])):
        for place, stars in (("seen", more), ("starless", [])):
            if place == "seen" or variant == "stars":
                run(options, "simulate", "--scenes", scenes, "--side", SIDE, "--border", BORDER, "--constant-shear", f"{g},{g}", *both,
                    "--rotated", "--opposite-noise", "--seed", seed, *stars, "--out", work / f"{place}-g{g}")  # fmt: skip
    rows = [[] for _ in range(scenes)]
    for folder in sorted(path.parent for path in work.glob("seen-*/g1_*/psf.fits")):
        version = [float(folder.name.split("_")[1]), "rotated" in folder.name, "noise" in folder.name]
        for scene in range(scenes):
            exposure = folder / f"scene-{scene + 1:03d}.fits"
            if variant == "stars":
                without = Path(str(exposure).replace("/seen-", "/starless-"))
                truth = pl.read_csv(folder / f"truth-{scene + 1:03d}.csv")
                sums = star_sums(options, exposure, without, truth)
            else:
                sums = detected_sums(options, exposure)
            rows[scene].append([*version, *map(float, sums)])
    shutil.rmtree(work)
    return rows


def run(options, *arguments):
    subprocess.run([options.shearq, *map(str, arguments), "--quiet", "--threads", str(options.threads)], check=True)


def biases(units):
    """m1, m2 and their mean (10⁻³) by Simpson's rule, and by ±g alone, and c1, c2 (10⁻⁴), with errors of the jackknife over scenes."""
    units = np.array(units)

    def estimate(total):
        g, e, response = total[:, 0], total[:, 4:6], total[:, 6:10].reshape(-1, 2, 2)
        mean = [[array[np.sign(np.round(g, 6)) == sign].mean(0) for sign in (-1, 0, 1)] for array in (e, response)]
        (minus, _, plus), (r_minus, r_none, r_plus) = mean
        both = (r_minus + r_plus) / 2
        result = []
        added = 1 / (1 - 2 * SHEAR**2)
        for r in ((added * r_minus + 4 * r_none + added * r_plus) / 6, both):
            m = np.linalg.solve(r, (plus - minus) / (2 * SHEAR)) - 1
            result += [*(1e3 * m), 1e3 * m.mean()]
        return np.array(result + [*(1e4 * np.linalg.solve(both, (plus + minus) / 2))])

    # The first three columns name the version and are equal in all scenes; a total has their values, not their sum.
    def total(of):
        sums = of.sum(0)
        sums[:, :3] = of[0, :, :3]
        return sums

    value = estimate(total(units))
    keep = np.ones(len(units), bool)
    without = []
    for scene in range(len(units)):
        keep[scene] = False
        without.append(estimate(total(units[keep])))
        keep[scene] = True
    without = np.array(without)
    error = np.sqrt((len(units) - 1) / len(units) * ((without - without.mean(0)) ** 2).sum(0))
    area = ((SIDE - 2 * BORDER) * 0.2 / 60) ** 2
    return value, error, units[:, :, 3].mean() / area


def report(path):
    units = [json.loads(line)["sums"] for line in path.read_text().splitlines()]
    if len(units) < 3:
        return
    value, error, density = biases(units)
    text = [f"{v:+.2f} ± {e:.2f}" for v, e in zip(value, error)]
    print(f"{path.stem}: {len(units)} scenes, {density:.1f} rows per arcmin²; m1, m2, mean (10⁻³): {', '.join(text[:3])}; by ±g alone: {', '.join(text[3:6])}; c1, c2 (10⁻⁴): {', '.join(text[6:])}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shearq", default="shearq")
    parser.add_argument("--work", required=True)
    parser.add_argument("--variant", action="append", choices=VARIANTS)
    parser.add_argument("--scenes", type=int, default=150, help="of each variant")
    parser.add_argument("--piece", type=int, default=2, help="scenes that are on the disk at a time")
    parser.add_argument("--seed", type=int, default=9001)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--cosmos", help="table of fits for the variant cosmos")
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    work = Path(options.work)
    work.mkdir(parents=True, exist_ok=True)
    if options.report:
        for path in sorted(work.glob("*.jsonl")):
            report(path)
        return
    variants = options.variant or list(VARIANTS)
    for first in range(0, options.scenes, options.piece):
        for variant in variants:
            path = work / f"{variant}.jsonl"
            done = {json.loads(line)["seed"] for line in path.read_text().splitlines()} if path.exists() else set()
            seed = options.seed + first
            if seed in done:
                continue
            sums = piece(options, variant, seed, options.piece)
            with path.open("a") as file:
                for scene in sums:
                    file.write(json.dumps({"seed": seed, "sums": scene}) + "\n")
            report(path)


if __name__ == "__main__":
    main()
