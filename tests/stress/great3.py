"""m, c and Q_c of a branch like control-ground-constant or control-space-constant of GREAT3, drawn by GalSim in the released layout.

Galaxies are fits to COSMOS, in rotated pairs, behind an optical PSF with aberrations and, from the ground, Kolmogorov's profile. Numbers of seeing, optics
and shear are those of the organisers' public program (great3sims/psf.py, shear.py). `draw` writes the branch, and below `opposite` the same
galaxies with the same noise under the opposite shears, from which m follows with hardly any noise. `measure` measures both with a
configuration of shearq and with REGAUSS of GalSim:

    python3 tests/stress/great3.py draw --branch control-ground-constant --out branch
    python3 tests/stress/great3.py measure --shearq target/release/shearq branch

`measure` also reads branches of `shearq simulate --challenge great3 --opposite`. It needs numpy, astropy and galsim.
"""

import argparse
import json
import subprocess
from pathlib import Path

import galsim
import numpy as np
from astropy.io import fits

COSMOS = Path(__file__).resolve().parent / "../../../shared/cosmos"
CATALOGUE = "real_galaxy_catalog_23.5_example.fits"
# Less light is folded than by default, which biases m by 1e-3.
ACCURATE = galsim.GSParams(folding_threshold=1e-3, maximum_fft_size=8192)
# Stamp in px, pixel in arcsec, λ/D in arcsec, rms of all aberrations in waves, share of defocus among them. Below λ/D = 0.03″, down to 0.013″ in the
# challenge, images of pupils take gigabytes, and hardly differ behind the seeing.
OBSERVATIONS = {"ground": (48, 0.2, (0.03, 0.083), 0.41, 0.36), "space": (96, 0.05, (0.12, 0.17), 0.08, 0.125)}
ABERRATIONS = ("defocus", "astig1", "astig2", "coma1", "coma2", "trefoil1", "trefoil2", "spher")
LEAST_SNR = 20.0


def drawn_psf(observation, rng):
    """A PSF of a subfield, without the pixel, as an image, of which stars and galaxies are drawn: the transforms of its factors take longer."""
    pixel = OBSERVATIONS[observation][1] / 4
    image = formula_of_psf(observation, rng).drawImage(nx=512, ny=512, scale=pixel, method="no_pixel", dtype=np.float64)
    return galsim.InterpolatedImage(image, flux=1, gsparams=ACCURATE)


def formula_of_psf(observation, rng):
    _, _, optics, rms, defocus = OBSERVATIONS[observation]
    weights = np.full(len(ABERRATIONS), (1 - defocus) / (len(ABERRATIONS) - 1))
    weights[0] = defocus
    sizes = rms * weights / np.sqrt(np.sum(weights**2)) * rng.standard_normal(len(weights))
    optical = galsim.OpticalPSF(
        lam_over_diam=rng.uniform(*optics), obscuration=rng.uniform(0.1, 0.5), **dict(zip(ABERRATIONS, sizes))
    )
    if observation == "space":
        jitter = galsim.Gaussian(sigma=np.sqrt(2) * 0.005).shear(e=rng.uniform(0, 0.3), beta=rng.uniform(0, 180) * galsim.degrees)
        charge = galsim.Gaussian(sigma=0.05 * rng.uniform(0.1, 0.2)).shear(e1=rng.uniform(0, 0.2), e2=0)
        return galsim.Convolve(optical, jitter, charge)
    seeing = galsim.Kolmogorov(fwhm=rng.triangular(0.5, 0.5, 0.85))
    angle = rng.uniform(0, 180) * galsim.degrees
    return galsim.Convolve(seeing.shear(e=np.sqrt(rng.uniform(1e-4, 9e-4)), beta=angle), optical)


def drawn(galaxy, psf, offset, size, pixel):
    scene = galsim.Convolve(galaxy.shift(offset[0] * pixel, offset[1] * pixel), psf, gsparams=ACCURATE)
    return scene.drawImage(nx=size, ny=size, scale=pixel).array


def mosaic(stamps):
    """An image of n × n stamps, row by row."""
    n, size = int(np.sqrt(len(stamps))), stamps.shape[-1]
    return stamps.reshape(n, n, size, size).transpose(0, 2, 1, 3).reshape(n * size, n * size).astype(np.float32)


def write_yaml(path, **values):
    path.write_text("{" + ", ".join(f"{name}: {value}" for name, value in values.items()) + "}\n")


def draw(options):
    experiment, observation, shears = options.branch.split("-")
    size, pixel, *_ = OBSERVATIONS[observation]
    below = Path(experiment, observation, shears)
    cosmos = galsim.COSMOSCatalog(CATALOGUE, dir=str(options.real), use_real=False, exclusion_level="none")
    galaxies = [cosmos.makeGalaxy(k, gal_type="parametric") for k in range(cosmos.nobjects)]
    # A tenth of the galaxies would be below the least S/N behind a typical PSF, and is left out.
    typical = drawn_psf(observation, np.random.default_rng(0))
    light = np.array([np.sqrt(np.sum(drawn(own, typical, (0, 0), size, pixel) ** 2)) for own in galaxies])
    noise = np.percentile(light, 10) / LEAST_SNR
    galaxies = [own for own, norm in zip(galaxies, light) if norm >= LEAST_SNR * noise]
    n = options.grid
    for subfield in range(options.subfields):
        rng = np.random.default_rng([options.seed, subfield])
        psf = drawn_psf(observation, rng)
        modulus, angle = np.sqrt(rng.uniform(0.01**2, 0.05**2)), rng.uniform(0, 2 * np.pi)
        g = modulus * np.cos(angle), modulus * np.sin(angle)
        stamps = np.empty((2, n * n, size, size), np.float32)
        places = rng.permutation(n * n)
        for first in range(0, n * n, 2):
            galaxy = galaxies[rng.integers(len(galaxies))].rotate(rng.uniform(0, 360) * galsim.degrees)
            for turn, place in enumerate(places[first : first + 2]):
                turned, offset = galaxy.rotate(90 * turn * galsim.degrees), rng.uniform(-1, 1, 2)
                for k, sign in enumerate((1, -1)):
                    stamps[k, place] = drawn(turned.shear(g1=sign * g[0], g2=sign * g[1]), psf, offset, size, pixel)
        stamps += noise * rng.standard_normal(stamps.shape[1:])
        stars = [drawn(galsim.DeltaFunction(), psf, rng.uniform(-1, 1, 2) if k else (0, 0), size, pixel) for k in range(9)]
        moments = galsim.hsm.FindAdaptiveMom(galsim.Image(stars[0], scale=pixel)).observed_shape
        columns, rows = np.arange(n * n) % n, np.arange(n * n) // n
        table = {"x": columns * size + size // 2 - 1, "y": rows * size + size // 2 - 1}
        table["ID"] = 1_000_000 * subfield + 1000 * columns + rows
        for k, sign in enumerate((1, -1)):
            root = options.out / "opposite" if k else options.out
            data, truth = root / below, root / "truth" / below
            data.mkdir(parents=True, exist_ok=True)
            truth.mkdir(parents=True, exist_ok=True)
            fits.writeto(data / f"image-{subfield:03}-0.fits", mosaic(stamps[k]), overwrite=True)
            fits.writeto(data / f"starfield_image-{subfield:03}-0.fits", mosaic(np.array(stars)), overwrite=True)
            listed = [fits.Column(name, "K", array=values) for name, values in table.items()]
            fits.BinTableHDU.from_columns(listed).writeto(data / f"galaxy_catalog-{subfield:03}.fits", overwrite=True)
            write_yaml(data / f"subfield_offset-{subfield:03}.yaml", offset_deg_x=0, offset_deg_y=0)
            write_yaml(data / f"epoch_dither-{subfield:03}-0.yaml", xdither_pixels=0, ydither_pixels=0)
            write_yaml(truth / f"shear_params-{subfield:03}.yaml", g1=sign * g[0], g2=sign * g[1])
            write_yaml(truth / f"starshape_parameters-{subfield:03}-0.yaml", psf_g1=moments.g1, psf_g2=moments.g2)
        print(f"subfield {subfield} of {options.subfields}", flush=True)


def regauss(data, out):
    """Writes shears of REGAUSS, divided by the response that it states, into a table of a galaxy per row."""
    rows = []
    for path in sorted(data.glob("image-*-0.fits")):
        image, stars = fits.getdata(path), fits.getdata(path.with_name("starfield_" + path.name))
        size = len(stars) // 3
        psf = galsim.Image(stars[:size, :size].astype(np.float64))
        table = fits.getdata(path.with_name(path.name.replace("image", "galaxy_catalog").replace("-0.fits", ".fits")))
        found = np.full((len(table), 2), np.nan)
        for k, (x, y) in enumerate(zip(table["x"], table["y"])):
            x, y = x + 1 - size // 2, y + 1 - size // 2
            stamp = galsim.Image(image[y : y + size, x : x + size].astype(np.float64))
            answer = galsim.hsm.EstimateShear(stamp, psf, shear_est="REGAUSS", strict=False)
            if answer.error_message == "" and np.hypot(answer.corrected_e1, answer.corrected_e2) < 1:
                found[k] = answer.corrected_e1, answer.corrected_e2
        # Of distortions, with their mean square per component (Bernstein & Jarvis 2002), noise included as in the organisers' example.
        shears = found / (2 * (1 - np.nanmean(found**2)))
        rows += [f"{name:09} {g1} {g2}" for name, (g1, g2) in zip(table["ID"], np.nan_to_num(shears, nan=10.0))]
    out.write_text("\n".join(rows) + "\n")


def yaml_numbers(folder, stem, *names):
    """Complex numbers of the released files of all subfields."""
    texts = [path.read_text() for path in sorted(folder.glob(f"*/*/*/{stem}*.yaml"))]
    return np.array([complex(*(float(text.split(f"{name}: ")[1].split(",")[0].strip("}\n")) for name in names)) for text in texts])


def measure(options):
    def shearq(*words):
        run = subprocess.run([options.shearq, *map(str, words)], capture_output=True, text=True, check=False)
        if run.returncode:
            raise SystemExit(f"shearq {' '.join(map(str, words))}: {run.stderr[-800:]}")
        return run.stdout

    roots = [options.branch, options.branch / "opposite"]
    data = [next(root.glob("*/*/constant")) for root in roots]
    name = "-".join(data[0].relative_to(roots[0]).parts)
    images = sorted(data[0].glob("image-*-0.fits"))
    size = len(fits.getdata(data[0] / "starfield_image-000-0.fits")) // 3
    branch = ["--challenge", "great3", "--branch", name, "--subfields", len(images)]
    known = [*branch, "--grid", len(fits.getdata(images[0])) // size]
    for method in options.methods:
        shears, scored = [], []
        for root, folder in zip(roots, data):
            packed, table = root / f"{method.replace('/', '-')}.txt", root / f"{method.replace('/', '-')}-galaxies.txt"
            if method == "REGAUSS":
                regauss(folder, table)
                shearq("pack", *known, "--whole-galaxies", "--out", packed, table)
            else:
                out = root / method.replace("/", "-")
                shearq("measure", "--submission", method, "--data", folder, "--out", out)
                shearq("pack", *known, "--measured", out, "--out", packed)
            shears.append(np.loadtxt(packed)[:, 1:3] @ [1, 1j])
            scored.append(json.loads(shearq("score", *branch, "--truth", root / "truth", "--format", "json", packed)))
        truth, axes = (yaml_numbers(roots[0] / "truth", *names) for names in (("shear_params", "g1", "g2"), ("starshape", "psf_g1", "psf_g2")))
        # In the frame of the PSF, as the challenge scores. In half of the difference noise and shapes cancel, in the mean the shears do.
        turn = np.exp(-1j * np.angle(axes))
        truth, slope, mean = truth * turn, (shears[0] - shears[1]) / 2 * turn, (shears[0] + shears[1]) / 2 * turn
        for name, of in (("+", np.real), ("x", np.imag)):
            x, y, c = of(truth), of(slope), of(mean)
            m = np.sum(x * y) / np.sum(x * x) - 1
            error = np.sqrt(np.sum((x * (y - (1 + m) * x)) ** 2)) / np.sum(x * x)
            shown = f"m{name} {1e3 * m:+.2f} ± {1e3 * error:.2f}   c{name} {1e3 * c.mean():+.3f} ± {1e3 * c.std() / np.sqrt(len(c)):.3f} 10⁻³"
            print(f"{method:16} opposite shears: {shown}", flush=True)
        for found in scored:
            shown = [f"{key} {1e3 * found[key]:+.2f} ± {1e3 * found['sigma_' + key]:.2f}" for key in ("m_plus", "m_cross", "c_plus", "c_cross")]
            print(f"{method:16} Q_c {found['Q_c']:6.0f}   {'   '.join(shown)} 10⁻³", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("draw", help="draw a branch by GalSim")
    one.add_argument("--branch", default="control-ground-constant", choices=[f"control-{kind}-constant" for kind in OBSERVATIONS])
    one.add_argument("--subfields", type=int, default=20)
    one.add_argument("--grid", type=int, default=50, help="galaxies per side of a subfield; even, for pairs")
    one.add_argument("--seed", type=int, default=1)
    one.add_argument("--real", type=Path, default=COSMOS, help="folder of GalSim's example catalogue of COSMOS")
    one.add_argument("--out", type=Path, required=True)
    one.set_defaults(run=draw)
    one = commands.add_parser("measure", help="measure and score a branch and its opposite")
    one.add_argument("branch", type=Path)
    one.add_argument("--shearq", default="shearq")
    one.add_argument("--methods", nargs="+", default=["48/linear/star", "REGAUSS"])
    one.set_defaults(run=measure)
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
