#!/usr/bin/env python3
"""m, c and noise of a submission on galaxies that GalSim renders, away from the conditions it was made in.

    python3 tests/stress/stress.py --shearq target/release/shearq [--galaxies 40000] [--cases base,sky+]
                                   [--real FOLDER] [--peers REGAUSS FPFS] [--seed 20261] [--json FILE]

See README.md beside this file for the cases, what is printed, and how the figures are worked out.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import peers
import pyarrow.parquet as parquet
from astropy.io import fits
from cases import CASES
from estimates import VERSIONS, bias, leakage, mean_of, scatter_of_images, weighted
from scenes import RENDERED, SHEAR, bound, noise_field, render

#: Stamps of one shear that are in memory at a time.
IN_MEMORY = 20_000
#: Pixels a side of star stamps.
STAR = 48


def stars_of(case, psf, grid, random, fields):
    """Star stamps of each noise field: the PSF, or with noise one for all galaxies or a mosaic of one per galaxy."""
    star = psf.drawImage(nx=STAR, ny=STAR, scale=1).array
    if not case.star:
        return [star] * fields
    sigma = np.sqrt((star**2).sum()) / case.star
    if case.star_of == "image":
        return [star + sigma * random.standard_normal(star.shape) for _ in range(fields)]
    stars = []
    for _ in range(fields // 2):
        noise = sigma * random.standard_normal((grid * STAR, grid * STAR))
        stars += [np.tile(star, (grid, grid)) + sign * noise for sign in (1, -1)]
    return stars


def write_images(case, stamps, stars, fields, data):
    """Writes the images of a case for shearq, in pairs of opposite shear, and returns how many."""
    _, count, side, _ = stamps.shape
    grid = int(np.sqrt(count))
    folder = data / "set01"
    folder.mkdir(parents=True)
    number = 0
    for noise, star in zip(fields, stars):
        for sign in range(2):
            number += 1
            image = stamps[sign] + noise + case.sky
            image = image.reshape(grid, grid, side, side).transpose(0, 2, 1, 3)
            image = fits.PrimaryHDU(image.reshape(grid * side, grid * side).astype(np.float32))
            keys = {"SET": 1, "IMAGE": number, "STAMP": side, "NGRID": grid, "NOISESIG": case.header}
            image.header.update(keys)
            image.writeto(folder / f"galaxies-{number:03}.fits")
            star_file = fits.PrimaryHDU(star.astype(np.float32))
            star_file.header["STAMP"] = STAR
            star_file.writeto(folder / f"psf-{number:03}.fits")
    return number


def run_measure(options, data, out, environment=None):
    """Runs `measure`; returns its error message, or None."""
    command = [options.shearq, "measure", "--submission", options.submission]
    command += ["--data", str(data), "--out", str(out), "--threads", str(options.threads)]
    run = subprocess.run(command, capture_output=True, text=True, env=environment)
    return run.stderr if run.returncode else None


def read_catalogues(folder, names, number):
    paths = [folder / "set01" / f"catalogue-{k:03}.parquet" for k in range(1, number + 1)]
    return [parquet.read_table(path, columns=names) for path in paths]


def measured(case, stamps, stars, fields, options):
    """Catalogues `[field, ±shear]` as dicts of arrays, from images written for shearq."""
    with tempfile.TemporaryDirectory() as folder:
        data, out = Path(folder) / "data", Path(folder) / "out"
        number = write_images(case, stamps, stars, fields, data)
        if error := run_measure(options, data, out):
            sys.exit(f"{case.name}: {error}")
        names = ["e1", "e2", "R11", "R22", "flags", "flux", "size"]
        if options.versions:
            names += [f"{name}_{version}" for name in ("e1", "e2", "flux", "size") for version in VERSIONS]
        tables = read_catalogues(out, names, number)
        if case.cut and not options.hard_cuts and not options.versions:
            column, share = case.cut
            values = np.concatenate([table[column].to_numpy()[table["flags"].to_numpy() == 0] for table in tables])
            selected = Path(folder) / "selected"
            command = [options.shearq, "select", "--measured", str(out), "--out", str(selected)]
            command += ["--where", f"step({column}, {np.quantile(values, share)})"]
            run = subprocess.run(command, capture_output=True, text=True)
            if run.returncode:
                sys.exit(f"{case.name}: {run.stderr}")
            tables = read_catalogues(selected, names, number)
    count = stamps.shape[1]
    columns = {name: np.array([table[name].to_numpy() for table in tables]) for name in names}
    return {name: values.reshape(-1, 2, count) for name, values in columns.items()}


class Peers:
    """What others make of the stamps of a case."""

    def __init__(self, case, names, seed):
        # Missing pixels are not theirs to fill, and they get the PSF without noise.
        self.found = {name: [] for name in names if not (case.missing or case.star)}
        self.case, self.seed, self.blocks = case, seed, 0

    def wants(self, estimators):
        """Whether one of these estimators was asked for."""
        return any(name in estimators for name in self.found)

    def look(self, estimators, stamps, psf, fields):
        if not self.wants(estimators):
            return
        versions = np.array([stamps + field for field in fields]) + self.case.sky

        def noise(field):
            # As that of the fields: each once with the other sign.
            random = np.random.default_rng([self.seed, self.blocks, field // 2])
            return (1 - 2 * (field % 2)) * noise_field(self.case, stamps.shape[1:], random)

        for name, found in self.found.items():
            if name in estimators:
                found.append(estimators[name](versions, psf, noise))
        self.blocks += 1

    def results(self):
        return {name: self.result(found) for name, found in self.found.items()}

    @staticmethod
    def result(found):
        e = np.concatenate([e for e, _ in found], 2)
        response = np.concatenate([own for _, own in found])
        good = np.isfinite(e).all((0, 1, 3))
        result = {"failed": 1.0 - good.mean()}
        noise = []
        for k in (0, 1):
            apart = (e[:, 0, :, k] - e[:, 1, :, k]).mean(0) / (2 * SHEAR)
            result[f"m{k + 1}"], result[f"m{k + 1}_error"], _ = bias(apart, response[:, k], good)
            noise.append((e[0, 0] - e[2, 0])[good, k].std() / np.sqrt(2) / apart[good].mean())
        return result | {"noise": float(np.sqrt(np.mean(np.square(noise))))}


def measure_case(case, options, others):
    """Measurements of a case, block by block: flags, sums of its estimate, and those of each image."""
    random = np.random.default_rng([options.seed, sum(case.name.encode())])
    wanted = max(options.galaxies // options.fields, 8)
    rows = []
    while sum(len(row["good"]) for row in rows) < wanted:
        left = wanted - sum(len(row["good"]) for row in rows)
        # An even number a side keeps fours together.
        most = min(case.grid, 2 * int(np.sqrt(IN_MEMORY / options.fields) / 2))
        grid = min(most, 2 * int(np.ceil(np.sqrt(left) / 2)))
        again = deepcopy(random)
        stamps, psf = render(case, grid * grid, random, options.real)
        fields = []
        for _ in range(options.fields // 2):
            noise = noise_field(case, stamps.shape[1:], random)
            fields += [noise, -noise]
        if others.wants(peers.CENTRED):
            middle, _ = render(replace(case, dithered=False), grid * grid, again, options.real)
            others.look(peers.CENTRED, middle, psf, fields)
        others.look(peers.PEERS, stamps, psf, fields)
        stars = stars_of(case, psf, grid, random, options.fields)
        found = measured(case, stamps, stars, fields, options)
        good = (found["flags"] == 0).all((0, 1))
        if options.versions:
            good &= np.isfinite(found["e1_noshear"]).all((0, 1))
        row = {"good": good, "flagged": (found["flags"] != 0).mean()}
        for k in (1, 2):
            response = np.where(found["flags"] == 0, found[f"R{k}{k}"], np.nan)
            if good.any():
                row[k] = weighted(case, found, k, good, options)
        rows.append(row)
    return rows


def examine(case, options):
    """The row of a case."""
    others = Peers(case, options.peers, options.seed)
    rows = measure_case(case, options, others)
    good = np.concatenate([row["good"] for row in rows])
    result = {
        "case": case.name,
        "galaxies": int(len(good)) * options.fields,
        "flagged": 1.0 - good.mean(),
        "flagged_once": float(np.mean([row["flagged"] for row in rows])),
        "aim": case.aim,
        "peers": others.results(),
    }
    if good.sum() < 8:
        return result | {"verdict": "FAILED"}
    kept = [row for row in rows if 1 in row]
    of = np.concatenate([row["good"] for row in kept])
    images = []
    for k in (1, 2):
        e = np.concatenate([row[k][0] for row in kept], 2)
        response = np.concatenate([row[k][1] for row in kept], 2)
        apart = (e[:, 0] - e[:, 1]) / (2 * SHEAR)
        result[f"m{k}"], result[f"m{k}_error"], mean = bias(apart.mean(0), response.mean((0, 1)), of)
        c, error = mean_of(e.mean((0, 1)) / mean, of)
        result[f"c{k}"], result[f"c{k}_error"] = 1e4 * c, 1e4 * error
        result[f"noise{k}"] = (e[0, 0] - e[2, 0])[of].std() / np.sqrt(2) / mean
        for row in kept:
            e, response = row[k]
            apart = (e[:, 0] - e[:, 1]) / (2 * SHEAR)
            images += [(apart[j], response[j].mean(0), row["good"]) for j in range(options.fields)]
    result["noise"] = float(np.sqrt((result["noise1"] ** 2 + result["noise2"] ** 2) / 2))
    result["leak"], result["leak_error"] = leakage(result)
    if case.images:
        result["images"], result["images_error"] = scatter_of_images(images)
    if least := bound(case):
        result["over_bound"] = result["noise"] / least
    result["verdict"] = verdict(case, result, int(good.sum()))
    return result


def verdict(case, result, count):
    """Whether a case is within its aims."""
    held = [abs(result[f"m{k}"]) <= case.aim + 2 * result[f"m{k}_error"] for k in (1, 2)]
    if case.scatter and "over_bound" in result:
        # The scatter of n values is known to 1/√(2n).
        held.append(result["over_bound"] <= case.scatter * (1 + 2 / np.sqrt(4.0 * count)))
    if case.leak:
        held.append(abs(result["leak"]) <= case.leak + 2 * result["leak_error"])
    if case.images:
        held.append(result["images"] <= case.images + 2 * result["images_error"])
    held.append(case.flagged[0] <= result["flagged_once"] <= case.flagged[1])
    if not all(held):
        return "FAILED"
    sharp = max(result["m1_error"], result["m2_error"]) <= max(case.aim, 0.7)
    return "holds" if sharp else "holds, blunt"


def line(row):
    if "m1" not in row:
        share = f"{100 * row['flagged_once']:.1f} % of measurements flagged"
        return f"{row['case']:12} no m: {row['verdict']}; {share}"
    m = f"{row['m1']:+8.2f} {row['m2']:+8.2f} ± {max(row['m1_error'], row['m2_error']):.2f}"
    c = f"{row['c1']:+7.2f} {row['c2']:+7.2f} ± {max(row['c1_error'], row['c2_error']):.2f}"
    over = f"{row['over_bound']:.3f}" if "over_bound" in row else "–"
    more = f"; {100 * row['flagged_once']:.1f} % of measurements flagged" if row["flagged_once"] else ""
    if "images" in row:
        more += f"; m of images ± {row['images']:.0f} ± {row['images_error']:.0f}"
    return (
        f"{row['case']:12} {m:>26} {c:>24} {row['noise']:.4f} {over:>6} {100 * row['flagged']:6.2f} "
        f"{row['leak']:+6.3f} {row['aim']:4.0f}  {row['verdict']}"
    ) + more


def lines_of_peers(row):
    for name, found in row["peers"].items():
        m = f"{found['m1']:+8.2f} {found['m2']:+8.2f} ± {max(found['m1_error'], found['m2_error']):.2f}"
        yield f"  {name:13} {m:>23} {'':24} {found['noise']:.4f} {'':6} {100 * found['failed']:6.2f}"


def even(text):
    """An even number of at least four."""
    number = int(text)
    if number < 4 or number % 2:
        raise argparse.ArgumentTypeError(f"{text} is not an even number of at least 4")
    return number


def main():
    words = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    words.add_argument("--shearq", default="target/release/shearq", help="the program")
    words.add_argument("--submission", default="48/linear/star", help="a name or a settings file")
    words.add_argument("--galaxies", type=int, default=40_000, help="galaxies a case, each of one noise field")
    words.add_argument(
        "--fields", type=even, default=8, help="noise fields each galaxy is measured under, half of them with the other sign"
    )
    words.add_argument("--cases", help="names with commas; all of them without")
    words.add_argument("--real", type=Path, help="folder with GalSim's example catalogues; without, those cases are left out")
    words.add_argument("--seed", type=int, default=20261)
    words.add_argument(
        "--peers", nargs="*", default=[], choices=[*peers.PEERS, *peers.CENTRED], help="estimators of others, on the same stamps"
    )
    words.add_argument(
        "--hard-cuts", action="store_true", help="cut the columns as a filter does, without the response of `select`"
    )
    words.add_argument(
        "--versions",
        type=float,
        metavar="STEP",
        help="cut the columns of each sheared version sharply; the submission has shape.sheared_step = STEP",
    )
    words.add_argument("--threads", type=int, default=1)
    words.add_argument("--json", type=Path, help="the table as JSON")
    options = words.parse_args()
    known = {case.name: case for case in CASES}
    names = options.cases.split(",") if options.cases else list(known)
    if unknown := [name for name in names if name not in known]:
        sys.exit(f"no case {unknown[0]}; known: {', '.join(known)}")
    if not options.real:
        names = [name for name in names if known[name].galaxy in RENDERED]
    print(f"{options.submission}, {options.galaxies} galaxies a case, {options.fields} noise fields, seed {options.seed}")
    print(f"{'case':12} {'m1, m2 [1e-3]':>26} {'c1, c2 [1e-4]':>24}  noise /bound flag %   leak  aim", flush=True)
    rows = []
    for name in names:
        rows.append(examine(known[name], options))
        print(line(rows[-1]), *lines_of_peers(rows[-1]), sep="\n", flush=True)
        if options.json:
            settings = {"submission": options.submission, "galaxies": options.galaxies, "seed": options.seed}
            settings["fields"] = options.fields
            settings["peers"] = options.peers
            options.json.write_text(json.dumps({"settings": settings, "cases": rows}, indent=1))
    return any(row["verdict"] == "FAILED" for row in rows)


if __name__ == "__main__":
    sys.exit(main())
