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
from dataclasses import dataclass
from pathlib import Path

import galsim
import numpy as np
import peers
import pyarrow.parquet as parquet
from astropy.io import fits

SHEAR = 0.02
#: Noise fields a galaxy is measured under: four, each added and taken away.
FIELDS = 8
#: Galaxies that differ by turns of 45 degrees alone: their ellipticities cancel, and so does what one component of
#: shear does to the other, which goes as the product of those of the ellipticity.
TURNS = 4
#: Most galaxies along an axis of an image.
MOST = 50
PSF_SHAPE = {"g1": 0.03, "g2": -0.02}
ACCURACY = galsim.GSParams(folding_threshold=1e-3, maximum_fft_size=16384)
COSMOS = "real_galaxy_catalog_23.5_example.fits"
AEGIS = "AEGIS_F814w_catalog.fits"
#: Arcseconds a pixel of galaxies from catalogues.
PIXEL = 0.2


@dataclass(frozen=True)
class Case:
    """A departure from the conditions; `aim` is the largest |m| in 10⁻³, over errors."""

    name: str
    aim: float = 1.0
    snr: float = 20.0
    fwhm: float = 3.4
    psf: str = "moffat"
    galaxy: str = "fiducial"
    stamp: int = 48
    off: float = 0.0
    neighbour: float = 0.0
    sky: float = 0.0
    header: float = 1.0
    noise: str = "white"
    #: Which pixels are missing: "bad" ones and a cosmic ray, or those beyond an "edge" of the exposure.
    missing: str = ""
    #: Whether fluxes are the catalogue's own, a quarter of the galaxies being below S/N 12.
    own_flux: bool = False
    #: Largest scatter in units of the bound; none where there is no bound.
    scatter: float | None = None
    #: A flag on all of them is as good as the aim.
    or_flagged: bool = False


CASES = [
    Case("base", scatter=1.03),
    Case("snr100", snr=100.0),
    Case("snr10", aim=3.0, snr=10.0, scatter=1.05),
    Case("snr7", aim=3.0, snr=7.0),
    Case("airy", psf="airy"),
    Case("fwhm1.6", fwhm=1.6),
    Case("fwhm2.0", fwhm=2.0, scatter=1.08),
    Case("fwhm2.3", fwhm=2.3, scatter=1.08),
    Case("fwhm2.7", fwhm=2.7),
    Case("fwhm4.5", fwhm=4.5, scatter=1.05),
    Case("fwhm6.0", fwhm=6.0, scatter=1.05),
    Case("sky+", sky=0.05),
    Case("sky-", sky=-0.05),
    Case("stamp64", stamp=64),
    Case("header+5%", aim=2.0, header=1.05),
    Case("header-5%", aim=2.0, header=0.95),
    Case("correlated", aim=3.0, noise="summed", scatter=1.05),
    Case("smoothed", aim=3.0, noise="smoothed"),
    Case("off1", off=1.0),
    Case("off2", off=2.0),
    Case("off3", off=3.0),
    Case("neighbour20", aim=5.0, neighbour=20.0),
    Case("neighbour14", aim=20.0, neighbour=14.0, or_flagged=True),
    Case("bad-pixels", missing="bad"),
    Case("edge", missing="edge"),
    Case("small", galaxy="small"),
    Case("large", galaxy="large"),
    Case("cosmos20", galaxy="cosmos"),
    Case("cosmos-own", aim=2.0, galaxy="cosmos", own_flux=True),
    Case("aegis20", galaxy="aegis"),
]
PROFILES = {"fiducial": (2.3, 4.8), "small": (1.8, 2.6), "large": (3.4, 10.0)}


def profile(kind):
    """Half the light in a de Vaucouleurs bulge, half in an exponential disc, round."""
    bulge, disc = PROFILES[kind]
    return 0.5 * galsim.DeVaucouleurs(half_light_radius=bulge) + 0.5 * galsim.Exponential(
        half_light_radius=disc
    )


class Galaxies:
    """Draws galaxies of a kind before shear and PSF."""

    def __init__(self, kind, folder):
        self.kind = kind
        if kind == "cosmos":
            self.catalogue = galsim.COSMOSCatalog(
                COSMOS, dir=str(folder), use_real=False, exclusion_level="none"
            )
        elif kind == "aegis":
            self.catalogue = galsim.RealGalaxyCatalog(AEGIS, dir=str(folder))

    def __call__(self, random):
        if self.kind in PROFILES:
            modulus = min(random.rayleigh(0.14), 0.6)
            angle = random.uniform(0.0, np.pi)
            return profile(self.kind).shear(
                g1=modulus * np.cos(2 * angle), g2=modulus * np.sin(2 * angle)
            )
        index = int(random.integers(self.catalogue.nobjects))
        if self.kind == "cosmos":
            galaxy = self.catalogue.makeGalaxy(index, gal_type="parametric")
        else:
            galaxy = galsim.RealGalaxy(self.catalogue, index=index)
        turned = galaxy.rotate(random.uniform(0.0, 360.0) * galsim.degrees)
        return turned.dilate(1.0 / PIXEL)


def psf_of(case):
    if case.psf == "airy":
        return galsim.Airy(lam_over_diam=2.4, obscuration=0.3).shear(**PSF_SHAPE)
    return galsim.Moffat(beta=3, fwhm=case.fwhm).shear(**PSF_SHAPE)


def drawn(galaxy, psf, side):
    image = galsim.Convolve(galaxy, psf, gsparams=ACCURACY)
    return image.drawImage(nx=side, ny=side, scale=1).array


def direction(random, length):
    angle = random.uniform(0.0, 2 * np.pi)
    return length * np.array([np.cos(angle), np.sin(angle)])


def missing(case, random):
    """True where a stamp has no pixel."""
    side = case.stamp
    lost = np.zeros((side, side), dtype=bool)
    if case.missing == "bad":
        lost = random.random((side, side)) < 0.01
        x, y = random.integers(0, side - 3, 2)
        lost[y : y + 3, x : x + 3] = True
    if case.missing == "edge":
        lost[:, : int(random.integers(1, side // 4 + 1))] = True
        lost = np.rot90(lost, random.integers(4))
    return lost


def render(case, count, random, folder):
    """Stamps without noise, `[±shear, galaxy, y, x]`, of galaxies in fours turned by 45 degrees; σ is one."""
    psf, kinds, others = psf_of(case), Galaxies(case.galaxy, folder), Galaxies("fiducial", folder)
    side = case.stamp
    stamps = np.empty((2, count, side, side))
    strength = np.empty(count)
    for first in range(0, count, TURNS):
        galaxy = kinds(random)
        for turn in range(TURNS):
            at = first + turn
            place = direction(random, case.off) if case.off else random.uniform(-0.5, 0.5, 2)
            turned = galaxy.rotate(180 / TURNS * turn * galsim.degrees)
            for sign in range(2):
                g = SHEAR * (1 - 2 * sign)
                stamps[sign, at] = drawn(turned.shear(g1=g, g2=g).shift(*place), psf, side)
            strength[at] = np.sqrt((stamps[:, at] ** 2).sum((1, 2)).mean())
            if case.neighbour:
                other = others(random).shift(*direction(random, case.neighbour))
                stamps[:, at] += drawn(other, psf, side)
    # One factor for a four: behind an elliptical PSF galaxies along it are brighter than those across.
    strength = np.sqrt((strength.reshape(-1, TURNS) ** 2).mean(1)).repeat(TURNS)
    if case.own_flux:
        stamps *= 12.0 / np.percentile(strength, 25)
    else:
        stamps *= (case.snr / strength)[None, :, None, None]
    if case.missing:
        stamps[:, np.array([missing(case, random) for _ in range(count)])] = np.nan
    return stamps, psf.drawImage(nx=48, ny=48, scale=1).array


def noise_field(case, shape, random):
    """Noise of variance one in every pixel."""
    field = random.standard_normal(shape)
    if case.noise == "summed":
        return sum(
            np.roll(field, (dy, dx), (1, 2)) for dy in (0, 1) for dx in (0, 1)
        ) / 2
    if case.noise == "smoothed":
        k = 2 * np.pi * np.fft.fftfreq(shape[-1])
        gain = np.exp(-0.5 * 0.7**2 * (k[:, None] ** 2 + k**2))
        gain /= np.sqrt((gain**2).mean())
        return np.fft.ifft2(np.fft.fft2(field) * gain).real
    return field


def bound(case):
    """Cramér–Rao bound on the shear of a round galaxy in this noise, per component; None where there is none."""
    if case.galaxy not in PROFILES or case.neighbour or case.noise == "smoothed":
        return None
    # Light beyond the stamp tells nothing.
    side = case.stamp
    images = [
        drawn(profile(case.galaxy).shear(g1=g, g2=0.0), psf_of(case), side) for g in (0.01, 0.0, -0.01)
    ]
    slope = (images[0] - images[2]) / 0.02 * case.snr / np.sqrt((images[1] ** 2).sum())
    power = np.ones((side, side))
    if case.noise == "summed":
        k = 2 * np.pi * np.fft.fftfreq(side)
        power = np.maximum(np.outer(1 + np.cos(k), 1 + np.cos(k)), 1e-2)
    information = (np.abs(np.fft.fft2(slope)) ** 2 / power).mean()
    return 1.0 / np.sqrt(information)


def measured(case, stamps, psf, fields, options):
    """Catalogues `[field, ±shear]` as dicts of arrays, from images written for shearq."""
    _, count, side, _ = stamps.shape
    grid = int(np.sqrt(count))
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data" / "set01"
        data.mkdir(parents=True)
        number = 0
        for noise in fields:
            for sign in range(2):
                number += 1
                image = stamps[sign] + noise + case.sky
                image = image.reshape(grid, grid, side, side).transpose(0, 2, 1, 3)
                image = fits.PrimaryHDU(image.reshape(grid * side, grid * side).astype(np.float32))
                keys = {"SET": 1, "IMAGE": number, "STAMP": side, "NGRID": grid, "NOISESIG": case.header}
                image.header.update(keys)
                image.writeto(data / f"galaxies-{number:03}.fits")
                star = fits.PrimaryHDU(psf.astype(np.float32))
                star.header["STAMP"] = 48
                star.writeto(data / f"psf-{number:03}.fits")
        out = Path(folder) / "out"
        command = [options.shearq, "measure", "--submission", options.submission]
        command += ["--data", str(data.parent), "--out", str(out), "--threads", str(options.threads)]
        run = subprocess.run(command, capture_output=True, text=True)
        if run.returncode:
            sys.exit(f"{case.name}: {run.stderr}")
        names = ["e1", "e2", "R11", "R22", "flags"]
        tables = [
            parquet.read_table(out / "set01" / f"catalogue-{k:03}.parquet", columns=names)
            for k in range(1, number + 1)
        ]
    columns = {name: np.array([table[name].to_numpy() for table in tables]) for name in names}
    return {name: values.reshape(-1, 2, count) for name, values in columns.items()}


def mean_of(values, good):
    """Mean over good galaxies and its error, from the scatter of groups of turned galaxies, which are not independent."""
    mean = values[good].mean()
    off = np.where(good, values - mean, 0.0).reshape(-1, TURNS).sum(1)
    return mean, np.sqrt((off**2).sum()) / good.sum()


def bias(apart, response, good):
    """m and its error in 10⁻³, and the mean response, of galaxies' change with shear beside their responses."""
    m, error = mean_of(apart - response, good)
    mean = response[good].mean()
    return 1e3 * m / mean, 1e3 * error / mean, mean


class Peers:
    """What others make of the stamps of a case."""

    def __init__(self, case, names, seed):
        # Missing pixels are not theirs to fill.
        self.found = {name: [] for name in names if not case.missing}
        self.case, self.seed, self.blocks = case, seed, 0

    def look(self, stamps, fields):
        if not self.found:
            return
        versions = np.stack([stamps[0] + fields[0], stamps[1] + fields[0], stamps[0] + fields[2]]) + self.case.sky

        def noise(version):
            random = np.random.default_rng([self.seed, self.blocks, version // 2])
            return noise_field(self.case, stamps.shape[1:], random)

        for name, found in self.found.items():
            found.append(peers.PEERS[name](versions, psf_of(self.case), noise))
        self.blocks += 1

    def results(self):
        return {name: self.result(found) for name, found in self.found.items()}

    @staticmethod
    def result(found):
        e = np.concatenate([e for e, _ in found], 1)
        response = np.concatenate([own for _, own in found])
        good = np.isfinite(e).all((0, 2))
        result = {"failed": 1.0 - good.mean()}
        noise = []
        for k in (0, 1):
            apart = (e[0, :, k] - e[1, :, k]) / (2 * SHEAR)
            result[f"m{k + 1}"], result[f"m{k + 1}_error"], _ = bias(apart, response[:, k], good)
            noise.append((e[0] - e[2])[good, k].std() / np.sqrt(2) / apart[good].mean())
        return result | {"noise": float(np.sqrt(np.mean(np.square(noise))))}


def examine(case, options):
    """The row of a case."""
    random = np.random.default_rng([options.seed, sum(case.name.encode())])
    wanted = max(options.galaxies // FIELDS, 8)
    rows, others = [], Peers(case, options.peers, options.seed)
    while sum(len(row["good"]) for row in rows) < wanted:
        left = wanted - sum(len(row["good"]) for row in rows)
        # An even number a side keeps fours together.
        grid = min(MOST, 2 * int(np.ceil(np.sqrt(left) / 2)))
        stamps, psf = render(case, grid * grid, random, options.real)
        fields = []
        for _ in range(FIELDS // 2):
            noise = noise_field(case, stamps.shape[1:], random)
            fields += [noise, -noise]
        others.look(stamps, fields)
        found = measured(case, stamps, psf, fields, options)
        good = (found["flags"] == 0).all((0, 1))
        row = {"good": good}
        for k in (1, 2):
            response = np.where(found["flags"] == 0, found[f"R{k}{k}"], np.nan)
            if good.any():
                # Ellipticities are divided by the mean response of their image: undone, for one mean over all.
                e = found[f"e{k}"] * np.nanmean(response, 2, keepdims=True)
                row[k] = (e, found[f"R{k}{k}"])
        rows.append(row)
    good = np.concatenate([row["good"] for row in rows])
    flagged = 1.0 - good.mean()
    result = {"case": case.name, "galaxies": int(len(good)) * FIELDS, "flagged": flagged, "aim": case.aim}
    result["peers"] = others.results()
    if good.sum() < 8:
        return result | {"verdict": "flagged" if case.or_flagged else "FAILED"}
    for k in (1, 2):
        kept = [row for row in rows if k in row]
        e = np.concatenate([row[k][0] for row in kept], 2)
        response = np.concatenate([row[k][1] for row in kept], 2)
        of = np.concatenate([row["good"] for row in kept])
        apart = ((e[:, 0] - e[:, 1]) / (2 * SHEAR)).mean(0)
        result[f"m{k}"], result[f"m{k}_error"], mean = bias(apart, response.mean((0, 1)), of)
        c, error = mean_of(e.mean((0, 1)) / mean, of)
        result[f"c{k}"], result[f"c{k}_error"] = 1e4 * c, 1e4 * error
        result[f"noise{k}"] = (e[0, 0] - e[2, 0])[of].std() / np.sqrt(2) / mean
    result["noise"] = float(np.sqrt((result["noise1"] ** 2 + result["noise2"] ** 2) / 2))
    least = bound(case)
    held = [abs(result[f"m{k}"]) <= case.aim + 2 * result[f"m{k}_error"] for k in (1, 2)]
    if least:
        result["over_bound"] = result["noise"] / least
        # The scatter of n values is known to 1/√(2n).
        error = 1.0 / np.sqrt(4.0 * good.sum())
        if case.scatter:
            held.append(result["over_bound"] <= case.scatter * (1 + 2 * error))
    sharp = max(result["m1_error"], result["m2_error"]) <= max(case.aim, 0.7)
    verdict = "holds" if all(held) else "FAILED"
    if case.or_flagged and flagged > 0.5:
        verdict = "flagged"
    result["verdict"] = verdict if sharp or verdict != "holds" else "holds, blunt"
    return result


def line(row):
    if "m1" not in row:
        return f"{row['case']:12} all flagged: {row['verdict']}"
    m = f"{row['m1']:+8.2f} {row['m2']:+8.2f} ± {max(row['m1_error'], row['m2_error']):.2f}"
    c = f"{row['c1']:+7.2f} {row['c2']:+7.2f} ± {max(row['c1_error'], row['c2_error']):.2f}"
    over = f"{row['over_bound']:.3f}" if "over_bound" in row else "–"
    return (
        f"{row['case']:12} {m:>26} {c:>24} {row['noise']:.4f} {over:>6} {100 * row['flagged']:6.2f} "
        f"{row['aim']:4.0f}  {row['verdict']}"
    )


def lines_of_peers(row):
    for name, found in row["peers"].items():
        m = f"{found['m1']:+8.2f} {found['m2']:+8.2f} ± {max(found['m1_error'], found['m2_error']):.2f}"
        yield f"  {name:10} {m:>26} {'':24} {found['noise']:.4f} {'':6} {100 * found['failed']:6.2f}"


def main():
    words = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    words.add_argument("--shearq", default="target/release/shearq", help="the program")
    words.add_argument("--submission", default="48/linear/star", help="a name or a settings file")
    words.add_argument("--galaxies", type=int, default=40_000, help="galaxies a case, each of one noise field")
    words.add_argument("--cases", help="names with commas; all of them without")
    words.add_argument("--real", type=Path, help="folder with GalSim's example catalogues; without, those cases are left out")
    words.add_argument("--seed", type=int, default=20261)
    words.add_argument(
        "--peers", nargs="*", default=[], choices=list(peers.PEERS), help="estimators of others, on the same stamps"
    )
    words.add_argument("--threads", type=int, default=1)
    words.add_argument("--json", type=Path, help="the table as JSON")
    options = words.parse_args()
    known = {case.name: case for case in CASES}
    names = options.cases.split(",") if options.cases else list(known)
    if unknown := [name for name in names if name not in known]:
        sys.exit(f"no case {unknown[0]}; known: {', '.join(known)}")
    if not options.real:
        names = [name for name in names if known[name].galaxy in PROFILES]
    print(f"{options.submission}, {options.galaxies} galaxies a case, seed {options.seed}")
    print(f"{'case':12} {'m1, m2 [1e-3]':>26} {'c1, c2 [1e-4]':>24}  noise /bound flag %  aim", flush=True)
    rows = []
    for name in names:
        rows.append(examine(known[name], options))
        print(line(rows[-1]), *lines_of_peers(rows[-1]), sep="\n", flush=True)
        if options.json:
            settings = {"submission": options.submission, "galaxies": options.galaxies, "seed": options.seed}
            settings["peers"] = options.peers
            options.json.write_text(json.dumps({"settings": settings, "cases": rows}, indent=1))
    return any(row["verdict"] == "FAILED" for row in rows)


if __name__ == "__main__":
    sys.exit(main())
