"""m and c of weak-lensing shear catalogues, galaxy shapes with their shear responses, and scores of challenges.

>>> import shearq
>>> cat = shearq.measure(stamps, psf)       # stamps (n, ny, nx), psf (py, px): a catalogue, one row per galaxy
>>> print(cat.mean_shear())                 # g1 = +0.0201 ± 0.0009, g2 = ...
>>> cat.write("shapes.parquet")

Measure    measure, measure_blocks, detect, from_galsim, from_ngmix, from_meds, from_exposure, FunctionalPsf, DataWarning, set_threads, get_threads
Catalogues Catalogue, concatenate, mean_shear, MeanShear, Flag, read, read_all
Score      score, galaxies, Galaxies, compare, power_spectrum, aperture_mass, Score, METRICS
Validate   bias, bias_sums, Bias, BiasSums, null_tests
Simulate   simulate, Simulation, SimulatedImage; settings: submission, submissions, Configuration

help(shearq.measure) explains each. Images are indexed [y, x]. e1 > 0 is elongation along +x, e2 > 0 along x = y. Noise
is a standard deviation per pixel in image units. Results equal those of the command line, for any number of threads.
"""

# No __all__: help(shearq) would print each object in full.
from . import adapters as adapters
from ._bias import Bias as Bias, BiasSums as BiasSums, bias as bias, bias_sums as bias_sums
from ._catalogue import (
    Catalogue as Catalogue,
    Flag as Flag,
    MeanShear as MeanShear,
    concatenate as concatenate,
    mean_shear as mean_shear,
)
from ._detect import detect as detect
from ._exposure import from_exposure as from_exposure
from ._files import read as read, read_all as read_all
from ._galsim import from_galsim as from_galsim
from ._measure import (
    DataWarning as DataWarning,
    FunctionalPsf as FunctionalPsf,
    measure as measure,
    measure_blocks as measure_blocks,
)
from ._null import null_tests as null_tests
from ._score import Galaxies as Galaxies, METRICS as METRICS, Score as Score, aperture_mass as aperture_mass, compare as compare, galaxies as galaxies, power_spectrum as power_spectrum, score as score
from ._shearq import __version__ as __version__
from ._simulate import SimulatedImage as SimulatedImage, Simulation as Simulation, simulate as simulate
from ._submissions import Configuration as Configuration, submission as submission, submissions as submissions
from ._threads import get_threads as get_threads, set_threads as set_threads
from ._meds import from_meds as from_meds
from .adapters import from_ngmix as from_ngmix
