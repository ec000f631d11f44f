"""The cases of the stress table, as data."""

from dataclasses import dataclass, replace

@dataclass(frozen=True)
class Case:
    """A departure from the conditions; `aim` is the largest |m| in 10⁻³, over errors."""

    name: str
    aim: float = 1.0
    snr: float = 20.0
    #: FWHM of the PSF in pixels; of a range, each image has its own.
    fwhm: float | tuple[float, float] = 3.4
    psf: str = "moffat"
    galaxy: str = "fiducial"
    stamp: int = 48
    off: float = 0.0
    #: Whether galaxies are within half a pixel of the middle of the stamp, or else exactly there.
    dithered: bool = True
    #: Distance of a second galaxy in pixels; of a range, at random in the plane.
    neighbour: float | tuple[float, float] = 0.0
    #: Its flux in units of the galaxy's, at random in the logarithm.
    ratio: tuple[float, float] = (1.0, 1.0)
    #: Whether shear moves and distorts the neighbour as well.
    sheared: bool = False
    sky: float = 0.0
    header: float = 1.0
    noise: str = "white"
    #: S/N √(Σ p²)/σ of stars; one for an "image" or for each "galaxy".
    star: float | None = None
    star_of: str = "image"
    #: Galaxies along an axis of an image.
    grid: int = 50
    #: The column and the lowest share of it that is removed.
    cut: tuple[str, float] | None = None
    #: Which pixels are missing: "bad" ones and a cosmic ray, or those beyond an "edge" of the exposure.
    missing: str = ""
    #: Whether fluxes are the catalogue's own, a quarter of the galaxies being below S/N 12.
    own_flux: bool = False
    #: Largest scatter in units of the bound; none where there is no bound.
    scatter: float | None = None
    #: Largest scatter of m between images in 10⁻³, over the scatter that pixel noise makes.
    images: float | None = None
    #: Largest part of the PSF's ellipticity in the mean ellipticity, over errors.
    leak: float | None = None
    #: Least and largest share of flagged galaxies.
    flagged: tuple[float, float] = (0.0, 1.0)


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
    Case("off2", aim=5.0, off=2.0),
    Case("off3", aim=15.0, off=3.0),
    Case("neighbour20", aim=float("inf"), neighbour=20.0),
    Case("bad-pixels", missing="bad"),
    Case("edge", missing="edge"),
    Case("small", galaxy="small"),
    Case("large", galaxy="large"),
    Case("cosmos20", galaxy="cosmos"),
    Case("cosmos-own", aim=2.0, galaxy="cosmos", own_flux=True),
    Case("aegis20", galaxy="aegis"),
]
PROFILES = {"fiducial": (2.3, 4.8), "small": (1.8, 2.6), "large": (3.4, 10.0)}

#: Bulges with discs, and Sérsic profiles, each of any size, as the ones of an independent check.
MIXED = Case("mixed", galaxy="mixed", fwhm=(3.0, 4.0))


def mixed(name, aim, **changes):
    return replace(MIXED, name=name, aim=aim, **changes)


#: Real data have these.
CASES += [
    mixed("mixed", 1.0),
    mixed("size30", 2.0, cut=("size", 0.3), leak=0.01),
    mixed("size30-snr10", 3.0, cut=("size", 0.3), snr=10.0, leak=0.01),
    mixed("size30-snr7", 5.0, cut=("size", 0.3), snr=7.0, leak=0.01),
    mixed("flux50", 2.0, cut=("flux", 0.5), leak=0.01),
    mixed("star100-each", 2.0, star=100.0, star_of="galaxy", flagged=(0.0, 0.0)),
    mixed("star50-each", 5.0, star=50.0, star_of="galaxy", flagged=(0.0, 0.0)),
    mixed("kolm100-each", 2.0, psf="kolmogorov", star=100.0, star_of="galaxy", flagged=(0.0, 0.0)),
    mixed("kolm50-each", 5.0, psf="kolmogorov", star=50.0, star_of="galaxy", flagged=(0.0, 0.0)),
    mixed("airy100-each", 2.0, psf="airy", star=100.0, star_of="galaxy", flagged=(0.0, 0.0)),
    mixed("airy50-each", 5.0, psf="airy", star=50.0, star_of="galaxy", flagged=(0.0, 0.0)),
    mixed("star100-image", float("inf"), star=100.0, grid=16, images=22.0),
    # No target; how m scatters between images is printed.
    *(
        mixed(f"star{snr}-image", float("inf"), star=float(snr), grid=16, images=float("inf"))
        for snr in (50, 200, 500, 1000)
    ),
    mixed("sky+0.5", 2.0, sky=0.5),
    mixed("sky-0.5", 2.0, sky=-0.5),
    mixed("near16-24", float("inf"), neighbour=(16.0, 24.0), ratio=(0.3, 3.0)),
    mixed("near10-16", float("inf"), neighbour=(10.0, 16.0), ratio=(0.3, 3.0)),
    mixed("near5-10", float("inf"), neighbour=(5.0, 10.0), ratio=(0.3, 3.0)),
    mixed("near16-24s", 5.0, neighbour=(16.0, 24.0), ratio=(0.3, 3.0), sheared=True),
    mixed("near10-16s", 5.0, neighbour=(10.0, 16.0), ratio=(0.3, 3.0), sheared=True),
    mixed("near5-10s", 5.0, neighbour=(5.0, 10.0), ratio=(0.3, 3.0), sheared=True),
    mixed("radius8", 1.0, galaxy="mixed8"),
    mixed("mixed-snr7", 2.0, snr=7.0),
    mixed("mixed-smooth", 1.0, noise="smoothed"),
]

#: Galaxies that look like blends, alone on their stamps.
CASES += [
    Case(f"{kind}{snr}", aim=2.0, galaxy=kind, snr=float(snr))
    for kind in ("knots", "offset", "ring", "aegis")
    for snr in (20, 60, 200)
    if (kind, snr) != ("aegis", 20)
]
