#!/usr/bin/env python3
"""Measures noise, m, c and CPU time of shearq and of other codes on the same stamps.

    python3 compare.py --shearq target/release/shearq --work FOLDER [--methods NAME ...] [--limit 1] [--seed 20270]

README.md in this folder describes the galaxies, the methods and the columns of `results.json`.
A stopped run continues where it was: finished pieces stay in FOLDER.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

# CPU times are those of one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import galsim
import numpy as np
from astropy.io import fits

STAMP, SHEAR = 48, 0.02
SNRS = (7, 10, 20, 40, 100)
BULGE, DISC, FWHM = 2.3, 4.8, 3.4
#: Galaxies of one piece, on a square grid, and pieces that are rendered; later pieces repeat them with new noise.
#: Pieces come in twos with opposite noise, because then m and c do not change with the noise to first order.
GRID = 40
PIECE = GRID * GRID
RENDERED = 4
#: Galaxies that differ only by turns of 45 degrees: intrinsic shapes cancel in their mean.
TURNS = 4
#: Signs of the shear and fields of noise of the four measurements of a galaxy.
VERSIONS = ((1, 0), (-1, 0), (1, 1), (-1, 1))
ACCURACY = galsim.GSParams(folding_threshold=1e-3, maximum_fft_size=16384)
#: AnaCal works in arcseconds and in magnitudes: pixel and noise of its example of isolated galaxies.
SCALE, ANACAL_NOISE, MAG_ZERO = 0.2, 0.37, 30.0
#: Kernels of FPFS in pixels: AnaCal's example, and the one that scatters least on these galaxies (of 2.6 to 6 px).
NARROW, WIDE = 2.6, 4.5
#: FWHM in px of the Gaussian weight of metacal's moments, which has the least noise here of 4.5 to 18 px. That of ngmix's
#: example, 4/3 of the PSF, has 1.4 times the noise.
METACAL_WEIGHT = 10.0
METACAL_STEP = 0.01


def profile():
    return 0.5 * galsim.DeVaucouleurs(half_light_radius=BULGE) + 0.5 * galsim.Exponential(half_light_radius=DISC)


def psf():
    return galsim.Moffat(beta=3, fwhm=FWHM).shear(g1=0.03, g2=-0.02)


def draw(galaxy, place=(0.0, 0.0)):
    image = galsim.Convolve(galaxy.shift(*place), psf(), gsparams=ACCURACY)
    return image.drawImage(nx=STAMP, ny=STAMP, scale=1).array


def psf_image(shift=0.0):
    return psf().shift(shift, shift).drawImage(nx=STAMP, ny=STAMP, scale=1, dtype=float).array


def bound():
    """Cramér–Rao bound on ε per component at S/N 1, of a round galaxy in the middle of its stamp."""
    images = [draw(profile().shear(g1=g, g2=0.0)) for g in (0.01, 0.0, -0.01)]
    change = (images[0] - images[2]) / 0.02
    return float(np.sqrt((images[1] ** 2).sum() / (change**2).sum()))


@dataclass(frozen=True)
class Galaxies:
    """Noise-free stamps `[±shear, galaxy, y, x]` at S/N 1 for noise of 1, and places from the stamp's middle."""

    stamps: np.ndarray
    places: np.ndarray


def render(work, placement, piece, seed):
    path = work / f"galaxies-{placement}-{piece}.npz"
    if path.exists():
        saved = np.load(path)
        return Galaxies(saved["stamps"], saved["places"])
    random = np.random.default_rng([seed, piece])
    stamps = np.empty((2, PIECE, STAMP, STAMP), np.float32)
    # The middle of an even stamp is a corner of pixels. FPFS expects the centre of the pixel above it.
    places = np.full((PIECE, 2), 0.5)
    for first in range(0, PIECE, TURNS):
        modulus, angle = min(random.rayleigh(0.14), 0.6), random.uniform(0.0, np.pi)
        dithers = random.uniform(-0.5, 0.5, (TURNS, 2))
        if placement == "dithered":
            places[first : first + TURNS] = dithers
        if placement == "nearest":
            places[first : first + TURNS] = dithers + 0.5
        for turn in range(TURNS):
            phase = 2 * (angle + turn * np.pi / TURNS)
            galaxy = profile().shear(g1=modulus * np.cos(phase), g2=modulus * np.sin(phase))
            for sign in range(2):
                g = SHEAR * (1 - 2 * sign)
                stamps[sign, first + turn] = draw(galaxy.shear(g1=g, g2=g), places[first + turn])
        # One factor for all: a factor for each stamp would depend on shear.
        stamps[:, first : first + TURNS] /= np.sqrt((stamps[:, first : first + TURNS] ** 2).sum((2, 3)).mean())
    np.savez(path, stamps=stamps, places=places)
    return Galaxies(stamps, places)


def mosaic(stamps):
    side = round(len(stamps) ** 0.5)
    return stamps.reshape(side, side, STAMP, STAMP).transpose(0, 2, 1, 3).reshape(side * STAMP, side * STAMP)


class Noise:
    """Gaussian noise of variance 1; the second piece of two has the opposite of the first."""

    def __init__(self, piece, *seed):
        self.random = np.random.default_rng([*seed, piece // 2])
        self.sign = 1 - 2 * (piece % 2)

    def __call__(self, shape):
        return self.sign * self.random.standard_normal(shape, dtype=np.float32)


class Clock:
    """CPU time of this process within `with`: imports and preparation do not count."""

    def __init__(self):
        self.seconds = 0.0

    def __enter__(self):
        self.start = time.process_time()

    def __exit__(self, *_):
        self.seconds += time.process_time() - self.start


# A method takes stamps [version, galaxy, y, x] with noise of 1, places and noise to add. It returns
# ellipticities [version, galaxy, component], not a number if it failed, its own response of the same shape, and
# CPU seconds. An ellipticity over its response is an estimate of ε.


def shearq(stamps, _places, _noise, options, configuration):
    import pyarrow.parquet as parquet

    def measured(images):
        """Catalogues of images of galaxies, and CPU seconds less those of starting the program."""
        children = lambda: sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])
        with tempfile.TemporaryDirectory(dir=options.work) as folder:
            data, out = Path(folder) / "data", Path(folder) / "out"
            (data / "set01").mkdir(parents=True)
            for number, galaxies in enumerate(images, 1):
                image = fits.PrimaryHDU(mosaic(galaxies).astype(np.float32))
                side = round(len(galaxies) ** 0.5)
                image.header.update({"SET": 1, "IMAGE": number, "STAMP": STAMP, "NGRID": side, "NOISESIG": 1.0})
                image.writeto(data / "set01" / f"galaxies-{number:03}.fits")
                star = fits.PrimaryHDU(psf_image().astype(np.float32))
                star.header["STAMP"] = STAMP
                star.writeto(data / "set01" / f"psf-{number:03}.fits")
            command = [options.shearq, "measure", "--submission", configuration, "--threads", "1"]
            before = children()
            run = subprocess.run([*command, "--data", str(data), "--out", str(out)], capture_output=True, text=True)
            seconds = children() - before
            if run.returncode:
                sys.exit(f"error: shearq failed: {run.stderr}")
            before = children()
            subprocess.run([options.shearq, "--version"], capture_output=True, check=True)
            seconds -= children() - before
            paths = [out / f"set01/catalogue-{k + 1:03}.parquet" for k in range(len(images))]
            return [parquet.read_table(path) for path in paths], seconds

    tables, _ = measured(stamps)
    # The noise of an image costs a fixed time. Surveys have more galaxies per image, so the time is of one image.
    _, seconds = measured([stamps.reshape(-1, STAMP, STAMP)])
    column = lambda name: np.array([table[name].to_numpy() for table in tables])
    response = np.stack([column("R11"), column("R22")], 2)
    e = np.stack([column(f"e{k}") for k in (1, 2)], 2)
    e[column("flags") != 0] = np.nan
    return e, response, seconds


def hsm(stamps, _places, _noise, _options, estimator):
    star = galsim.Image(psf_image())
    e = np.full((*stamps.shape[:2], 2), np.nan)
    clock = Clock()
    with clock:
        for version, galaxies in enumerate(stamps):
            for k, stamp in enumerate(galaxies):
                found = galsim.hsm.EstimateShear(
                    galsim.Image(stamp), star, sky_var=1.0, shear_est=estimator, strict=False
                )
                if found.error_message:
                    continue
                if estimator == "REGAUSS":
                    e[version, k] = found.corrected_e1 / 2, found.corrected_e2 / 2
                else:
                    e[version, k] = found.corrected_g1, found.corrected_g2
    # Distortions above 2 are cut, as HSC does; a few of them would determine all scatter.
    e[np.hypot(e[..., 0], e[..., 1]) > 1.0] = np.nan
    response = np.ones_like(e)
    if estimator == "REGAUSS":
        # Responsivity 1 − ⟨χ²⟩ with the intrinsic χ² per component: the product of two measurements with
        # independent noise. Its mean over a four is what one galaxy contributes.
        off = 2 * (e - np.nanmean(e, 1, keepdims=True))
        response -= np.stack([off[0] * off[2], off[1] * off[3]])[[0, 1, 0, 1]]
    return e, response, clock.seconds


def fpfs(stamps, _places, noise, _options, kernel, renoised):
    """FPFS at the known centres: the pixel above the stamp's middle."""
    import anacal

    config = anacal.fpfs.FpfsConfig(npix=STAMP, sigma_shapelets1=kernel)
    side = round(stamps.shape[1] ** 0.5)
    at = np.empty(stamps.shape[1], dtype=[("y", np.int32), ("x", np.int32)])
    y, x = np.mgrid[0:side, 0:side] * STAMP + STAMP // 2
    at["y"], at["x"] = y.ravel(), x.ravel()
    star = psf_image(0.5)
    e, response, clock = [], [], Clock()
    fields = added_noise(stamps, noise) if renoised else [None] * len(stamps)
    for galaxies, added in zip(stamps, fields):
        image = np.ascontiguousarray(mosaic(galaxies) * ANACAL_NOISE, dtype=np.float32)
        with clock:
            table = anacal.fpfs.process_image(
                fpfs_config=config,
                pixel_scale=SCALE,
                noise_variance=ANACAL_NOISE**2,
                mag_zero=MAG_ZERO,
                gal_array=image,
                psf_array=star,
                noise_array=added,
                detection=at,
            )
        e.append(np.stack([table["fpfs1_e1"], table["fpfs1_e2"]], 1))
        response.append(np.stack([table["fpfs1_de1_dg1"], table["fpfs1_de2_dg2"]], 1))
    return np.array(e), np.array(response), clock.seconds


def added_noise(stamps, noise):
    """Noise for AnaCal's renoising, one field for each field of noise of the stamps."""
    fields = [noise(stamps.shape[1:]) * ANACAL_NOISE for _ in range(2)]
    return [np.ascontiguousarray(mosaic(fields[field])) for _, field in VERSIONS]


def fpfs_detected(stamps, _places, noise, _options):
    """FPFS after AnaCal's own detection, with its detection weight and its response.

    Kernel, thresholds and C are the production settings of AnaCal's authors.
    """
    import anacal

    star = psf_image(0.5)
    side = round(stamps.shape[1] ** 0.5)
    gauss = anacal.ngmix.fit_psf_gauss(star, SCALE)
    kernel = np.sqrt(gauss.T * anacal.ngmix.ellip_dilation(gauss.e1, gauss.e2, 1.1) / 2)
    task = anacal.task.Task(
        scale=SCALE,
        sigma_arcsec=kernel,
        snr_peak_min=5.0,
        omega_f=0.218,
        omega_v=0.011,
        stamp_size=STAMP,
        image_bound=0,
        num_epochs=0,
        force_center=True,
        fpfs_c0=30.0,
        mag_zero=MAG_ZERO,
    )
    e, response, clock = [], [], Clock()
    for galaxies, added in zip(stamps, added_noise(stamps, noise)):
        image = np.ascontiguousarray(mosaic(galaxies) * ANACAL_NOISE, dtype=np.float32)
        with clock:
            cells = anacal.geometry.get_cell_list(
                img_nx=image.shape[1], img_ny=image.shape[0], cell_nx=250, cell_ny=250, cell_overlap=80, scale=SCALE
            )
            table = task.process_image(
                image, star, variance=ANACAL_NOISE**2, cell_list=cells, noise_array=added
            )
        # Sum over the detections in each stamp; a stamp without a detection has zero.
        x, y = (np.round(table[f"{axis}_det"] / SCALE).astype(int) // STAMP for axis in ("x1", "x2"))
        stamp = np.clip(y, 0, side - 1) * side + np.clip(x, 0, side - 1)
        sums = lambda values: np.bincount(stamp, values, side * side)
        weight = table["wsel"]
        e.append(np.stack([sums(weight * table[f"fpfs_e{k}"]) for k in (1, 2)], 1))
        response.append(
            np.stack(
                [
                    sums(weight * table[f"fpfs_de{k}_dg{k}"] + table[f"dwsel_dg{k}"] * table[f"fpfs_e{k}"])
                    for k in (1, 2)
                ],
                1,
            )
        )
    return np.array(e), np.array(response), clock.seconds


class Metacal:
    """Metacalibration (Huff & Mandelbaum 2017, Sheldon & Huff 2017) with GalSim, in the steps that ngmix takes.

    Deconvolve, shear by ±0.01, convolve with a round Gaussian slightly larger than the PSF, measure moments under a
    Gaussian at the known centre. A second field of noise is turned by 90 degrees before these steps and back after
    them, and added.
    """

    SHEARS = [(0.0, 0.0)] + [tuple(s * METACAL_STEP * np.eye(2)[k]) for k in (0, 1) for s in (1, -1)]

    def __init__(self):
        star = galsim.Image(psf_image(), scale=1.0)
        self.inverse = galsim.Deconvolve(galsim.InterpolatedImage(star, x_interpolant="lanczos15"))
        found = galsim.hsm.FindAdaptiveMom(star)
        e = found.observed_shape.e
        trace = 2 * found.moments_sigma**2 / np.sqrt(1 - e**2)
        # The target covers the PSF's long axis, and what a shear exposes.
        dilation = min(1 + 2 * (np.sqrt(1 + e) - 1), 1.1)
        sigma = np.sqrt(trace * dilation / 2) * (1 + 2 * METACAL_STEP)
        self.target = galsim.Gaussian(sigma=sigma, flux=star.array.sum())

    def images(self, stamp):
        bare = galsim.Convolve(
            galsim.InterpolatedImage(galsim.Image(stamp, scale=1.0), x_interpolant="lanczos15"), self.inverse
        )
        for g1, g2 in self.SHEARS:
            image = galsim.Convolve(bare.shear(g1=g1, g2=g2), self.target)
            yield image.drawImage(nx=STAMP, ny=STAMP, scale=1, dtype=float, method="no_pixel").array

    def moments(self, image, place):
        y, x = np.mgrid[0:STAMP, 0:STAMP] - (STAMP - 1) / 2
        x, y = x - place[0], y - place[1]
        weighted = image * np.exp(-0.5 * (x**2 + y**2) * (2.3548 / METACAL_WEIGHT) ** 2)
        size = (weighted * (x**2 + y**2)).sum()
        if weighted.sum() <= 0 or size <= 0:
            return np.nan, np.nan
        return (weighted * (x**2 - y**2)).sum() / size, (2 * weighted * x * y).sum() / size

    def __call__(self, stamp, noise, place):
        turned = self.images(np.rot90(noise).copy())
        e = [
            self.moments(image + np.rot90(other, 3), place)
            for image, other in zip(self.images(stamp), turned)
        ]
        return e[0], ((e[1][0] - e[2][0]) / (2 * METACAL_STEP), (e[3][1] - e[4][1]) / (2 * METACAL_STEP))


def metacal(stamps, places, noise, _options):
    calibrate, clock = Metacal(), Clock()
    fields = [noise(stamps.shape[1:]).astype(float) for _ in range(2)]
    e, response = np.empty((2, *stamps.shape[:2], 2))
    for version, (_, field) in enumerate(VERSIONS):
        for k in range(stamps.shape[1]):
            with clock:
                found = calibrate(stamps[version, k].astype(float), fields[field][k], places[k])
            e[version, k], response[version, k] = found
    e[np.isnan(response).any(2)] = np.nan
    return e, response, clock.seconds


@dataclass(frozen=True)
class Method:
    """`pieces`: how many are measured at S/N below 20, and from there on; `galaxies`: how many of each."""

    name: str
    variant: str
    package: str
    placement: str
    run: object
    arguments: dict
    pieces: tuple
    galaxies: int = PIECE
    own_response: bool = True


METHODS = {
    "shearq": Method(
        "48/linear/star", "dithered", "shearq", "dithered", shearq, {"configuration": "48/linear/star"}, (24, 16)
    ),
    "shearq-centred": Method(
        "48/linear/star", "centred", "shearq", "centred", shearq, {"configuration": "48/linear/star"}, (2, 2)
    ),
    "regauss": Method(
        "REGAUSS", "dithered, responsivity", "galsim", "dithered", hsm, {"estimator": "REGAUSS"}, (4, 4)
    ),
    "ksb": Method(
        "KSB", "dithered, uncalibrated", "galsim", "dithered", hsm, {"estimator": "KSB"}, (4, 4), own_response=False
    ),
    "fpfs": Method(
        "FPFS",
        "centred, renoised, kernel 2.6 px",
        "anacal",
        "centred",
        fpfs,
        {"kernel": NARROW * SCALE, "renoised": True},
        (6, 6),
    ),
    "fpfs-wide": Method(
        "FPFS",
        "centred, renoised, kernel 4.5 px",
        "anacal",
        "centred",
        fpfs,
        {"kernel": WIDE * SCALE, "renoised": True},
        (24, 16),
    ),
    "fpfs-bare": Method(
        "FPFS",
        "centred, not renoised, kernel 2.6 px",
        "anacal",
        "centred",
        fpfs,
        {"kernel": NARROW * SCALE, "renoised": False},
        (6, 6),
    ),
    "fpfs-bare-wide": Method(
        "FPFS",
        "centred, not renoised, kernel 4.5 px",
        "anacal",
        "centred",
        fpfs,
        {"kernel": WIDE * SCALE, "renoised": False},
        (24, 16),
    ),
    "fpfs-nearest": Method(
        "FPFS",
        "at the nearest pixel, not renoised, kernel 2.6 px",
        "anacal",
        "nearest",
        fpfs,
        {"kernel": NARROW * SCALE, "renoised": False},
        (2, 2),
    ),
    "fpfs-nearest-wide": Method(
        "FPFS",
        "at the nearest pixel, not renoised, kernel 4.5 px",
        "anacal",
        "nearest",
        fpfs,
        {"kernel": WIDE * SCALE, "renoised": False},
        (2, 2),
    ),
    "shearq-nearest": Method(
        "48/linear/star",
        "cut at the nearest pixel",
        "shearq",
        "nearest",
        shearq,
        {"configuration": "48/linear/star"},
        (2, 2),
    ),
    "fpfs-detected": Method(
        "FPFS", "dithered, own detection, renoised", "anacal", "dithered", fpfs_detected, {}, (6, 6)
    ),
    "metacal": Method("metacal", "dithered, weighted moments", "galsim", "dithered", metacal, {}, (6, 6), 200),
}


def measure(key, snr, piece, options):
    """Measures one piece, unless its file exists."""
    method = METHODS[key]
    path = options.work / f"{key}-{snr}-{piece}.npz"
    if path.exists():
        return
    galaxies = render(options.work, method.placement, piece // 2 % RENDERED, options.seed)
    noise = Noise(piece, options.seed, snr)((2, PIECE, STAMP, STAMP))
    count = method.galaxies
    stamps = np.stack(
        [snr * galaxies.stamps[(1 - sign) // 2, :count] + noise[field, :count] for sign, field in VERSIONS]
    )
    added = Noise(piece, options.seed, snr, 1)
    e, response, seconds = method.run(stamps, galaxies.places[:count], added, options, **method.arguments)
    part = path.with_suffix(".part.npz")
    np.savez(part, e=e.astype(np.float32), response=response.astype(np.float32), seconds=seconds)
    part.rename(path)


def jackknife(statistic, sums):
    """Value and jackknife error of a function of sums over groups `[group, ...]`."""
    total, n = sums.sum(0), len(sums)
    value = statistic(total)
    left_out = np.array([statistic(total - one) for one in sums])
    return value, np.sqrt((n - 1) / n * ((left_out - left_out.mean(0)) ** 2).sum(0))


def summary(key, snr, options):
    """One row of the results, or None if no piece is measured."""
    method = METHODS[key]
    paths = sorted(options.work.glob(f"{key}-{snr}-*[0-9].npz"))
    if not paths:
        return None
    count = method.galaxies
    groups = RENDERED * count // TURNS
    # Sums over a group of turned galaxies and over all noise it was measured with: one sample of the jackknife.
    sums, seconds, failed, robust = np.zeros((groups, 6, 2)), [], 0, []
    for path in paths:
        saved = np.load(path)
        piece = int(path.stem.rsplit("-", 1)[1]) // 2 % RENDERED
        e, response = saved["e"].astype(float), saved["response"].astype(float)
        seconds.append(float(saved["seconds"]))
        good = np.isfinite(e).all((0, 2)) & np.isfinite(response).all((0, 2))
        failed += (~good).sum()
        noise = [(e[0] - e[2]) / np.sqrt(2), (e[1] - e[3]) / np.sqrt(2)]
        robust.append(np.stack(noise)[:, good])
        columns = [
            np.ones((count, 2)),
            (e[0] - e[1] + e[2] - e[3]) / (4 * SHEAR),
            response.mean(0),
            e.mean(0),
            sum(d**2 for d in noise) / 2,
            (e**2).mean(0),
        ]
        values = np.stack(columns, 1)
        values[~good] = 0.0
        at = piece * count // TURNS
        sums[at : at + count // TURNS] += values.reshape(-1, TURNS, 6, 2).sum(1)
    sums = sums[sums[:, 0, 0] > 0]

    def numbers(s):
        galaxies, slope, own, mean, noise, square = s
        true = slope / galaxies
        m = slope / own - 1
        c = mean / own
        per_component = [noise / galaxies / true**2, (square / galaxies - (mean / galaxies) ** 2) / true**2]
        return np.array([*m, *c, *(np.sqrt(p.mean()) for p in per_component), *true])

    value, error = jackknife(numbers, sums)
    quartiles = np.percentile(np.concatenate(robust, 1), [25, 75], axis=(0, 1))
    spread = np.sqrt((((quartiles[1] - quartiles[0]) / 1.349 / value[6:8]) ** 2).mean())
    n = count * len(paths)
    names = ["m1", "m2", "c1", "c2", "noise", "noise_with_shapes", "response1", "response2"]
    row = {"method": method.name, "variant": method.variant, "snr": snr, "galaxies": n}
    for name, v, s in zip(names, value, error):
        row[name], row[name + "_error"] = float(f"{v:.6g}"), float(f"{s:.3g}")
    row["noise_robust"] = float(f"{spread:.6g}")
    row["failed"] = float(f"{failed / n:.4g}")
    # Other work on the machine makes CPU times longer: the fastest piece is the least disturbed.
    row["cpu_us"] = float(f"{1e6 * min(seconds) / (len(VERSIONS) * count):.4g}")
    row["own_response"] = method.own_response
    return row


def version_of(package, options):
    if package == "shearq":
        text = subprocess.run([options.shearq, "--version"], capture_output=True, text=True, check=True).stdout
        return text.split()[1]
    return __import__(package).__version__


def machine():
    model = platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.split(":")[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    return f"{model}, {platform.system()}, Python {platform.python_version()}, NumPy {np.__version__}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--shearq", default="target/release/shearq", help="the binary")
    parser.add_argument("--work", type=Path, required=True, help="folder of rendered and measured pieces")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--snr", nargs="+", type=int, choices=SNRS, default=list(SNRS))
    parser.add_argument("--limit", type=int, help="most pieces for each method and S/N")
    parser.add_argument("--minutes", type=float, help="stop measuring after this time, and write what there is")
    parser.add_argument("--seed", type=int, default=20270)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results.json")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    tasks = []
    for key in options.methods:
        for snr in options.snr:
            pieces = METHODS[key].pieces[0 if snr < 20 else 1]
            pieces = min(pieces, options.limit or pieces)
            tasks += [((k // 2 + 0.5) / pieces, key, snr, k) for k in range(pieces)]
    # All methods and S/N advance together, so that a stopped run has some of each.
    end = time.monotonic() + 60 * (options.minutes or np.inf)
    for _, key, snr, piece in sorted(tasks):
        if time.monotonic() > end:
            break
        measure(key, snr, piece, options)
    least = bound()
    versions = {p: version_of(p, options) for p in sorted({METHODS[key].package for key in METHODS})}
    rows = [row for key in METHODS for snr in SNRS if (row := summary(key, snr, options))]
    for row, package in ((r, m.package) for r in rows for m in METHODS.values() if (m.name, m.variant) == (r["method"], r["variant"])):
        row["version"] = f"{package} {versions[package]}"
    run = {
        "command": "compare.py" + f" --seed {options.seed}" + (f" --limit {options.limit}" if options.limit else ""),
        "seed": options.seed,
        "machine": machine(),
        "versions": versions,
        "bound_at_snr_1": float(f"{least:.6g}"),
        "shear": SHEAR,
    }
    text = ",\n".join("    " + json.dumps(row) for row in rows)
    head = json.dumps(run, indent=2).replace("\n", "\n  ")
    options.out.write_text(f'{{\n  "run": {head},\n  "rows": [\n{text}\n  ]\n}}\n')
    for row in rows:
        print(
            f"{row['method']:15} {row['variant']:36} {row['snr']:4} "
            f"m {1e3 * row['m1']:+8.2f} ± {1e3 * row['m1_error']:<6.2f} {1e3 * row['m2']:+8.2f} ± {1e3 * row['m2_error']:<6.2f} "
            f"noise {row['noise']:.4f} ({row['noise_robust']:.4f}, {row['noise'] * row['snr'] / least:.3f} of the bound) "
            f"{row['noise_with_shapes']:.4f}  R {row['response1']:.3f}  failed {row['failed']:.4f}  {row['cpu_us']:.0f} µs  n {row['galaxies']}"
        )


if __name__ == "__main__":
    main()
