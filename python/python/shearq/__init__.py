"""shearq: galaxy shapes for weak lensing from postage stamps and PSFs, and the metrics of shear challenges.

>>> import shearq
>>> cat = shearq.measure(stamps, psf)                  # (n, ny, nx) and (py, px)
>>> cat["e1"], cat["R11"], cat["flags"]                # a structured array, calibrated by its mean response
>>> cat.mean_shear()                                   # g1, g2 with errors

Conventions: images are indexed [y, x]. e1 > 0 is elongation along +x, e2 > 0 along x = y. Noise is a standard deviation
per pixel in the unit of the image. Results have the same bits as those of the command line, for any number of threads.
"""

from . import adapters
from ._measure import Catalogue, DataWarning, Flag, FunctionalPsf, MeanShear, measure
from ._score import METRICS, Score, compare, power_spectrum, score
from ._shearq import __version__
from ._simulate import SimulatedImage, Simulation, simulate
from ._submissions import Configuration, submission, submissions

__all__ = [
    "METRICS",
    "Catalogue",
    "DataWarning",
    "Flag",
    "FunctionalPsf",
    "MeanShear",
    "Score",
    "SimulatedImage",
    "Simulation",
    "Configuration",
    "__version__",
    "adapters",
    "compare",
    "measure",
    "power_spectrum",
    "score",
    "simulate",
    "submission",
    "submissions",
]
