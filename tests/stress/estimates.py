"""m, c and their errors, from catalogues of the same galaxies under opposite shears."""

import numpy as np
from scenes import PSF_SHAPE, SHEAR, TURNS


#: Versions of a galaxy: as it is, under γ1 = ± the step, under γ2 = ± the step.
VERSIONS = ["noshear", "1p", "1m", "2p", "2m"]


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


def weighted(case, found, k, good, options):
    """Component k of what is summed over galaxies: weight times ellipticity, and its derivative with shear.

    Both are arrays `[field, ±shear, galaxy]`; the shear of a catalogue is the sum of the first over the sum of the
    second. With hard cuts, the weight is one or zero, each catalogue is cut by its own columns, and the derivative of
    the weight is left out. With sheared versions, each version is cut by its own columns, and the derivative is the difference of
    two. Otherwise `shearq select` has made both.
    """
    if options.versions:

        def cut(version):
            e = found[f"e{k}_{version}"]
            if not case.cut:
                return e
            column, share = case.cut
            least = np.quantile(found[f"{column}_noshear"][:, :, good], share)
            return np.where(found[f"{column}_{version}"] > least, e, 0.0)

        return cut("noshear"), (cut(f"{k}p") - cut(f"{k}m")) / (2 * options.versions)
    weight = np.ones(found["flags"].shape)
    if case.cut and options.hard_cuts:
        column, share = case.cut
        weight = (found[column] > np.quantile(found[column][:, :, good], share)).astype(float)
    return weight * found[f"e{k}"], weight * found[f"R{k}{k}"]


def leakage(result):
    """The part of the PSF's ellipticity that is in the mean ellipticity, and its error."""
    shape = np.array([PSF_SHAPE["g1"], PSF_SHAPE["g2"]])
    weights = 1e-4 * shape / (shape**2).sum()
    c, error = ([result[f"c{k}{of}"] for k in (1, 2)] for of in ("", "_error"))
    return float(weights @ c), float(np.hypot(*(weights * error)))


def scatter_of_images(parts):
    """Scatter of m between images in 10⁻³ beyond that of its errors, and its own error.

    `parts` has `(apart, response, good)` of each image and component.
    """
    found = np.array([bias(*part)[:2] for part in parts])
    square = (found[:, 0] ** 2).mean() - (found[:, 1] ** 2).mean()
    scatter = np.sqrt(max(square, 0.0))
    return float(scatter), float(np.sqrt((found[:, 0] ** 2).mean() / (2 * len(found))))
