"""A study: the response of a detection by Stein's lemma and by renoising, of the same functionals on the same scenes.

    shearq simulate --scenes 100 --constant-shear 0,0 --out scenes
    python tests/stress/renoising.py scenes

Renoising adds an image of noise n* with the covariance of the noise n, and estimates sum_a f_a u_a' of the sky under the steps and
moments of the image with both by sum_a f_a (u_a' - 2 n*_a'), because n and n* have the same mean products with f_a. On these images
Stein's lemma has the response sum_a f_a u_a' - 2 sum_ab f_ab <n_b n_a'>. Steps have the widths of the image without n*, so that what
is detected differs by its noise alone. The script prints the ratio of both mean responses, their scatter between scenes, and the
shear error with and without the added noise.
"""

import sys
from pathlib import Path

import detection
import numpy as np
from astropy.io import fits

#: Those of `detect` for a seeing of 0.7 arcsec on pixels of 0.2 arcsec, whose σ is 1.61 px.
detection.DETECTION_SIGMA, detection.MOMENT_SIGMA, detection.DISTANCE = 1.93, 2.57, 3
detection.THRESHOLD, detection.SHARE = 6.0, 0.2


def responses(found, changes, noise):
    """Sums over pixels of f, and of the response by Stein's lemma and by renoising with `noise`, from what `candidates` returns."""
    f, first, stein = found
    raw = [(first[k] * changes[k]).sum() for k in range(2)]
    return np.array([[f[k], raw[k] - stein[k], raw[k] - 2 * (first[k] * noise[k]).sum()] for k in range(2)])


def main(root):
    rng = np.random.default_rng(1)
    star = fits.getdata(root / "psf.fits").astype(float)
    rows = []
    for path in sorted(root.glob("scene-*.fits")):
        image = fits.getdata(path).astype(float)
        if not rows:
            own = detection.Detection(star, len(image))
            both = detection.Detection(star, len(image), np.sqrt(2))
            # The steps and the constant of the moments stay.
            both.threshold, both.half_widths, both.deviation = own.threshold, own.half_widths, own.deviation
        added = rng.standard_normal(image.shape)
        one = own.candidates(image)
        two = both.candidates(image + added)
        zero = [np.zeros_like(change) for change in one[1]]
        of_added = both.changes(added, two[2])
        rows.append([responses(*one[:2], zero), responses(*two[:2], of_added)])
        if len(rows) % 10 == 0:
            report(np.array(rows))


def report(rows):
    """Prints the result of `[scene, without and with added noise, component, (f, Stein, renoising)]`."""
    f, stein, renoising = (rows[..., k] for k in range(3))

    def estimate(keep):
        error = [np.sqrt(((f[keep, k] / response[keep, k].mean(0)).std(0) ** 2).mean()) for k, response in ((0, stein), (1, stein), (1, renoising))]
        scatter = [(response[keep, 1].std(0) / response[keep, 1].mean(0)).mean() for response in (stein, renoising)]
        ratio = (renoising[keep, 1].mean(0) / stein[keep, 1].mean(0)).mean()
        return np.array([ratio, *scatter, error[0], error[1] / error[0]])

    count = len(rows)
    every = np.arange(count)
    value = estimate(every)
    without = np.array([estimate(every != own) for own in every])
    error = np.sqrt((count - 1) / count * ((without - without.mean(0)) ** 2).sum(0))
    names = ("R by renoising over R by Stein", "scatter of R by Stein", "by renoising", "shear error of a scene", "with added noise, over it")
    print(f"{count} scenes: " + "; ".join(f"{name} {v:.4f} ± {e:.4f}" for name, v, e in zip(names, value, error)), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
