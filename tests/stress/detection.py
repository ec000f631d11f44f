"""A study: detection whose response to shear is known in closed form, on scenes of `shearq simulate --scenes`: a plain form of what `shearq detect` does, without its lengths.

    shearq simulate --scenes 60 --side 1500 --border 80 --constant-shear 0.04,0.04 --opposite --rotated --opposite-noise --out scenes
    python tests/stress/detection.py scenes

Every pixel is a candidate with a weight w between 0 and 1, a product of smooth steps of linear functionals v of the deconvolved
image: v0, smoothed light, is above a threshold, and v0 - v_j above zero for four neighbours j (the idea of AnaCal, Li & Mandelbaum
2023, MNRAS 521, 4904). The ellipticity is e = M22 / (M00 + C) about the pixel. A shear about the pixel changes a functional with
the filter F(k) into one with the filter -(k_x d_x - k_y d_y) F, or -(k_y d_x + k_x d_y) F for its second component. With
f = w e of the functionals u, Stein's lemma gives the response without added noise,

    df/dg = sum_a f_a u_a' - sum_ab f_ab <n_b n_a'>,

and a quarter of sum_ab f_ab (C_ab behind the PSF turned by 90 degrees - C_ab) takes out what noise of the PSF's shape adds to f.
The covariances of noise are constants of the image, because its level is.
"""

import sys
from pathlib import Path

import numpy as np
from astropy.io import fits

#: σ in px of the smoothing of v0 and its neighbours, and of the moments; C in standard deviations of M00.
DETECTION_SIGMA, MOMENT_SIGMA, SOFTENING = 1.9, 3.5, 15.0
#: Of v0, in its standard deviations: threshold, and half width of its step. Distance of the neighbours in px.
THRESHOLD, HALF_WIDTH, DISTANCE = 7.0, 2.0, 3
#: Half width of the steps of neighbours: standard deviations of the difference, and a share of v0. Without the share, single pixels
#: of bright galaxies dominate the response.
NEIGHBOUR_HALF_WIDTH, SHARE = 1.0, 0.15
#: Of the PSF's transform, below which modes are left out.
MIN_TRANSFER = 1e-5
STEPS, FUNCTIONALS = 5, 8  # v0 and four differences; then M00 and both components of M22


class Detection:
    """The functionals of images of a side, behind a star, in white noise of one level."""

    def __init__(self, star, side, sigma=1.0):
        self.side = side
        self.filters = self.functionals(star)
        turned = self.functionals(np.rot90(star))
        plain = [own[0] for own in self.filters]
        self.covariance = sigma**2 * self.products(plain, plain)
        self.of_shear = [sigma**2 * self.products(plain, [own[k] for own in self.filters]).T for k in (1, 2)]
        behind_turned = sigma**2 * self.products([own[0] for own in turned], [own[0] for own in turned])
        self.psf_shape = (behind_turned - self.covariance) / 4
        self.deviation = np.sqrt(np.diag(self.covariance))
        self.threshold = THRESHOLD * self.deviation[0]
        self.half_widths = np.r_[HALF_WIDTH, np.full(4, NEIGHBOUR_HALF_WIDTH)] * self.deviation[:STEPS]

    def functionals(self, star):
        """Filters of each functional and of its changes with both components of shear."""
        side = self.side
        kx = 2 * np.pi * np.fft.rfftfreq(side)[None, :]
        ky = 2 * np.pi * np.fft.fftfreq(side)[:, None]
        padded = np.zeros((side, side))
        padded[: star.shape[0], : star.shape[1]] = star
        # The centre of an even stamp is half a pixel from a pixel's.
        centre = (np.array(star.shape) - 1) / 2
        transfer = np.fft.rfft2(padded) * np.exp(1j * (ky * centre[0] + kx * centre[1]))
        usable = np.abs(transfer) > MIN_TRANSFER
        inverse = np.where(usable, 1 / np.where(usable, transfer, 1), 0)
        plus, cross, square = kx**2 - ky**2, 2 * kx * ky, kx**2 + ky**2

        def smoothed(factor, of_plus, of_cross, sigma, at=(0, 0)):
            """A factor times a Gaussian at a place; of_plus and of_cross are (k_x d_x - k_y d_y) and (k_y d_x + k_x d_y) of the factor."""
            light = np.exp(-0.5 * square * sigma**2 + 1j * (kx * at[0] + ky * at[1]))
            first = of_plus + factor * (-(sigma**2) * plus + 1j * (kx * at[0] - ky * at[1]))
            second = of_cross + factor * (-(sigma**2) * cross + 1j * (ky * at[0] + kx * at[1]))
            return [part * light * inverse for part in (factor, -first, -second)]

        centre_light = smoothed(1.0, 0.0, 0.0, DETECTION_SIGMA)
        filters = [centre_light]
        for at in ((DISTANCE, 0), (-DISTANCE, 0), (0, DISTANCE), (0, -DISTANCE)):
            beside = smoothed(1.0, 0.0, 0.0, DETECTION_SIGMA, at)
            filters.append([own - other for own, other in zip(centre_light, beside)])
        scale = -(MOMENT_SIGMA**2)
        filters.append(smoothed(1.0, 0.0, 0.0, MOMENT_SIGMA))
        filters.append(smoothed(scale * plus, scale * 2 * square, 0.0, MOMENT_SIGMA))
        filters.append(smoothed(scale * cross, 0.0, scale * 2 * square, MOMENT_SIGMA))
        return filters

    def products(self, left, right):
        """Mean products of functionals of white noise of variance one."""
        weight = np.full(self.side // 2 + 1, 2.0)
        weight[0] = 1.0
        weight[-1] = 1.0 if self.side % 2 == 0 else 2.0
        left, right = np.array([own.ravel() for own in left]), np.array([own.ravel() for own in right])
        weight = np.broadcast_to(weight, (self.side, weight.size)).ravel()
        return ((left * weight) @ right.conj().T).real / self.side**2

    def filtered(self, transform, own):
        return np.fft.irfft2(transform * own, s=(self.side, self.side))

    def changes(self, image, place):
        """Changes of all functionals with both components of shear, at places."""
        transform = np.fft.rfft2(image)
        return [np.array([self.filtered(transform, own[k])[place] for own in self.filters]) for k in (1, 2)]

    def candidates(self, image):
        """Of the pixels of an image that may have a weight: sums of f, derivatives of f by functionals, and sums of the response's noise
        and of the correction for the PSF's shape, by component; changes of the functionals; and places. The sum of w is the last."""
        transform = np.fft.rfft2(image)
        maps = [self.filtered(transform, own[0]) for own in self.filters[:STEPS]]
        is_candidate = maps[0] > self.threshold - self.half_widths[0]
        for values, half_width in zip(maps[1:], self.half_widths[1:]):
            is_candidate &= values > -(half_width + SHARE * np.maximum(maps[0], 0))
        place = np.nonzero(is_candidate)
        u = np.array([own[place] for own in maps] + [self.filtered(transform, own[0])[place] for own in self.filters[STEPS:]])
        w, gradient, hessian = self.weight(u)
        f, slopes, noise, of_psf = [], [], [], []
        divisor = u[5] + SOFTENING * self.deviation[5]
        for k in range(2):
            moment = u[6 + k]
            e = moment / divisor
            of_e, of_e_twice = np.zeros_like(u), np.zeros((FUNCTIONALS, *u.shape))
            of_e[6 + k], of_e[5] = 1 / divisor, -moment / divisor**2
            of_e_twice[5, 5] = 2 * moment / divisor**3
            of_e_twice[5, 6 + k] = of_e_twice[6 + k, 5] = -1 / divisor**2
            second = hessian * e + w * of_e_twice + gradient[:, None] * of_e[None] + of_e[:, None] * gradient[None]
            f.append((w * e).sum())
            slopes.append(gradient * e + w * of_e)
            noise.append(np.einsum("abn,ab->", second, self.of_shear[k]))
            of_psf.append(np.einsum("abn,ab->", second, self.psf_shape))
        return (f, slopes, noise), self.changes(image, place), place, of_psf, w.sum()

    def sums(self, image):
        """Sums over the pixels of an image: f, its correction for the PSF's shape, response, and w."""
        (f, slopes, noise), changes, _, of_psf, weight = self.candidates(image)
        response = [(slopes[k] * changes[k]).sum() - noise[k] for k in range(2)]
        return np.array([*f, *of_psf, *response, weight])

    def weight(self, u):
        """w of the functionals, its gradient and its second derivatives."""
        count = u.shape[1]
        steps = np.empty((STEPS, count))
        first, second = np.zeros((STEPS, FUNCTIONALS, count)), np.zeros((STEPS, FUNCTIONALS, FUNCTIONALS, count))
        steps[0], slope, curve = step((u[0] - self.threshold) / self.half_widths[0])
        first[0, 0], second[0, 0, 0] = slope / self.half_widths[0], curve / self.half_widths[0] ** 2
        for j in range(1, STEPS):
            # The argument u_j / (half width + share · v0), and its derivatives with u_j (a) and v0 (b).
            width = self.half_widths[j] + SHARE * u[0]
            steps[j], slope, curve = step(u[j] / width)
            a, b = 1 / width, -SHARE * u[j] / width**2
            ab, bb = -SHARE / width**2, 2 * SHARE**2 * u[j] / width**3
            first[j, j], first[j, 0] = slope * a, slope * b
            second[j, j, j] = curve * a**2
            second[j, 0, j] = second[j, j, 0] = curve * a * b + slope * ab
            second[j, 0, 0] = curve * b**2 + slope * bb
        w = steps.prod(0)
        inverse = np.where(steps > 1e-12, 1 / np.maximum(steps, 1e-12), 0)
        of_log = first * inverse[:, None]
        gradient = of_log.sum(0)
        hessian = (second * inverse[:, None, None]).sum(0) - np.einsum("jan,jbn->abn", of_log, of_log)
        hessian += gradient[:, None] * gradient[None]
        return w, w * gradient, w * hessian


def step(t):
    """A step from 0 at t = -1 to 1 at t = 1 with two continuous derivatives; it and these."""
    t = np.clip((t + 1) / 2, 0, 1)
    return t**3 * (10 - 15 * t + 6 * t**2), 15 * t**2 * (1 - t) ** 2, 15 * t * (1 - t) * (1 - 2 * t)


def jackknife(estimate, units):
    """An estimate of sums of units, and its error."""
    total = units.sum(0)
    without = np.array([estimate(total - own) for own in units])
    return estimate(total), np.sqrt((len(units) - 1) / len(units) * ((without - without.mean(0)) ** 2).sum(0))


def main(root):
    versions = sorted(path.parent for path in root.glob("g1_*/psf.fits"))
    scenes = len(list(versions[0].glob("scene-*.fits")))
    detection, units = None, []
    for scene in range(1, scenes + 1):
        sums = []
        for version in versions:
            g = [float(text) for text in version.name.split("_noise")[0].split("_rotated")[0][3:].split("_g2_")]
            image = fits.getdata(version / f"scene-{scene:03d}.fits").astype(float)
            detection = detection or Detection(fits.getdata(version / "psf.fits").astype(float), image.shape[0])
            found = detection.sums(image)
            sums.append(np.r_[found, found[:2] * np.sign(g), found[2:4] * np.sign(g), np.abs(g)])
        units.append(sums)
        if scene > 2:
            report(np.array(units))


def report(units):
    """Prints m and c of the scenes so far, `[scene, version, sums]`, with the shear error of one scene."""
    g = units[0, 0, 11:13]
    all_versions = units.sum(1)
    # Versions that are not rotated and of one noise have their shapes and their noise in c.
    alone = units[:, [0, units.shape[1] // 2]].sum(1)
    for name, of_psf in (("as it is", 0.0), ("corrected for noise of the PSF's shape", 1.0)):

        def biases(s, of_psf=of_psf):
            m = (s[7:9] + of_psf * s[9:11]) / s[4:6] / g - 1
            c = (s[0:2] + of_psf * s[2:4]) / s[4:6]
            return np.r_[1e3 * m, 1e3 * m.mean(), 1e4 * c]

        value, error = jackknife(biases, all_versions)
        m, c = (" ".join(f"{value[k]:+.2f} ± {error[k]:.2f}" for k in of) for of in ((0, 1, 2), (3, 4)))
        of_scene = 1e-4 * np.sqrt((jackknife(biases, alone)[1][3:] ** 2).mean() * len(units))
        print(f"{len(units)} scenes, {name}: m1, m2, mean (1e-3) {m}; c (1e-4) {c}; shear error of a scene {of_scene:.5f}", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
