"""Odd inputs end in a result or in an error that names what is odd, never in a crash."""

import warnings

import numpy as np
import pytest

import shearq

hypothesis = pytest.importorskip("hypothesis", reason="trying odd inputs needs hypothesis")
from hypothesis import HealthCheck, given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402
from hypothesis.extra import numpy as arrays  # noqa: E402

TOLD = (ValueError, TypeError, KeyError)
ODD = [0.0, -0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-320, 3e38, 1e-45, 1e17, 1e18]
# Small pieces, so that few pixels are enough.
SMALL = {"extends": "48/linear/star", "stamp": {"size": 16}, "psf": {"size": 8}, "deconvolution": {"window_sigma": 3.0}}
SUBMISSIONS = [SMALL, {**SMALL, "noise": {"source": "border", "border": 4}}]
SUBMISSIONS += [{"extends": name, "stamp": {"size": 9}, "psf": {"size": 5}} for name in ("23/den/star", "23/raw/func")]
thorough = settings(
    max_examples=330, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True, database=None
)


def mostly(usual, odd, share=8):
    """The usual in all but one of so many cases."""
    return st.integers(1, share).flatmap(lambda k: odd if k == share else usual)


def numbers(shapes):
    """Arrays of any type, full of odd numbers or of noise, with odd strides."""

    @st.composite
    def made(draw):
        shape = draw(shapes)
        real = st.sampled_from(["f4", "f8", ">f4", ">f8", "f2", "g", "i2", ">i8"])
        dtype = draw(mostly(real, st.sampled_from(["u1", "?", "c8", "O", "S3", "M8[s]"]), 16))
        noise = np.random.default_rng(draw(st.integers(0, 99))).normal(size=shape)
        peak = np.zeros(shape)
        if all(shape) and len(shape) >= 2:
            # A galaxy, or a star, where one should be.
            peak[..., shape[-2] // 2, shape[-1] // 2] = draw(mostly(st.sampled_from([1e3, 1e4]), st.just(0.0)))
        constant = st.builds(np.full, st.just(shape), st.sampled_from(ODD))
        values = np.array(draw(mostly(st.sampled_from([noise + peak, peak]), constant)))
        if values.size:
            for _ in range(draw(mostly(st.just(0), st.integers(1, 3), 4))):
                values.flat[draw(st.integers(0, values.size - 1))] = draw(st.sampled_from(ODD))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            array = values.astype("f8" if dtype in ("S3", "M8[s]") else dtype)
            array = array.astype(dtype) if dtype == "S3" else array.astype("i8").astype(dtype) if dtype == "M8[s]" else array
        kind = draw(st.sampled_from(["as it is", "turned", "Fortran", "packed", "read-only", "repeated", "list"]))
        if kind == "turned" and array.ndim:
            array = array[::-1]
        elif kind == "Fortran":
            array = np.asfortranarray(array)
        elif kind == "packed" and dtype != "O":
            record = np.zeros(shape, dtype=[("a", "u1"), ("b", array.dtype)])
            record["b"] = array
            array = record["b"]
        elif kind == "read-only":
            array.flags.writeable = False
        elif kind == "repeated" and array.ndim and len(array):
            array = np.broadcast_to(array[:1], array.shape)
        return array.tolist() if kind == "list" else array

    return made()


SIDES = mostly(st.sampled_from([16, 18, 20]), st.sampled_from([17, 9]))
ANY_SHAPE = arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=20)
STAMPS = mostly(st.builds(lambda n, side: (n, side, side), st.integers(0, 5), SIDES), ANY_SHAPE)
STARS = mostly(st.builds(lambda side: (side, side), st.sampled_from([8, 10, 16])), ANY_SHAPE)
SCALAR = st.one_of(st.sampled_from(ODD), st.none(), st.text(max_size=3), st.complex_numbers(), st.integers())


@thorough
@given(
    stamps=numbers(STAMPS),
    psf=mostly(
        numbers(STARS),
        st.one_of(numbers(STAMPS), SCALAR),
    ),
    noise=mostly(st.sampled_from([1.0, 0.1]), st.one_of(SCALAR, numbers(ANY_SHAPE))),
    submission=st.sampled_from(SUBMISSIONS),
    threads=mostly(st.sampled_from([None, 1, 3]), SCALAR),
)
def test_measuring(stamps, psf, noise, submission, threads):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = shearq.measure(stamps, psf, noise=noise, submission=submission, threads=threads)
        except TOLD as error:
            assert str(error).strip("'\"").split(":")[0] in ("stamps", "psf", "noise", "submission", "threads"), error
            return
        assert len(found) == len(stamps)
        assert np.array_equal(np.isnan(found["e1"]), ~found.good)
        try:
            found.mean_shear()
        except ValueError:
            pass


@thorough
@given(
    fwhm=mostly(st.floats(0.5, 8), st.one_of(st.floats(), numbers(ANY_SHAPE)), 3),
    e1=mostly(st.floats(-0.5, 0.5), st.floats(), 4),
    e2=mostly(st.floats(-0.5, 0.5), numbers(ANY_SHAPE), 4),
    beta=mostly(st.sampled_from([3.0, None, 1.0001, 1e3]), st.floats()),
)
def test_formulas_of_psfs(fwhm, e1, e2, beta):
    stamps = np.zeros((2, 16, 16))
    stamps[:, 7:9, 7:9] = 1.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            psf = shearq.FunctionalPsf(fwhm, e1, e2, beta=beta)
            shearq.measure(stamps, psf, noise=0.01, submission=SMALL)
        except TOLD:
            pass


E_SHAPES = mostly(st.sampled_from([(8, 8)]), st.one_of(st.sampled_from([(64,), (2, 64), (3, 8, 8), (9, 9)]), ANY_SHAPE))


@thorough
@given(
    e1=numbers(E_SHAPES),
    e2=numbers(E_SHAPES),
    truth=st.tuples(*[numbers(E_SHAPES)] * 2),
    images=mostly(st.none(), st.one_of(SCALAR, numbers(E_SHAPES))),
    positions=mostly(st.none(), st.one_of(SCALAR, st.tuples(numbers(E_SHAPES), numbers(E_SHAPES)))),
    stamp=mostly(st.sampled_from([None, 48]), SCALAR),
    field_degrees=mostly(st.just(10.0), SCALAR),
    convention=mostly(st.sampled_from([5, "best", "matched"]), SCALAR),
    definition=mostly(st.sampled_from(["leaderboard", "corrected"]), SCALAR),
    noise_variance=mostly(st.none(), SCALAR),
)
def test_scoring(e1, e2, truth, **options):
    # Mostly the ellipticities are the truth itself, so that something is scored.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for first, second in ((e1, e2), truth):
            try:
                assert repr(shearq.score(first, second, *truth, **options))
            except TOLD:
                pass
            options.pop("convention", None)
            spectral = {k: v for k, v in options.items() if k != "noise_variance"}
            try:
                assert len(shearq.power_spectrum(first, second, **spectral)) == 20
            except TOLD:
                pass


@settings(thorough, max_examples=100)
@given(of=st.one_of(st.text(), st.dictionaries(st.text(), st.recursive(SCALAR, lambda s: st.lists(s) | st.dictionaries(st.text(), s))), SCALAR))
def test_submissions(of):
    try:
        shearq.submission(of)
    except TOLD as error:
        assert "submission: " in str(error)
