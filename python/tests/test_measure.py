"""Measuring arrays of any kind."""

import copy
import pickle
import subprocess
import sys
import threading
import warnings

import numpy as np
import pytest
from conftest import same_bits

import shearq


@pytest.fixture(scope="module")
def measured(image):
    return shearq.measure(image.stamps, image.psf, noise=image.noise)


def again(image, stamps=None, psf=None, noise=None, **options):
    return shearq.measure(
        image.stamps if stamps is None else stamps,
        image.psf if psf is None else psf,
        noise=image.noise if noise is None else noise,
        **options,
    )


def test_submissions_can_be_pickled_and_copied(image):
    own = shearq.submission({"extends": "48/linear/star", "noise": {"source": "border", "border": 4}})
    for submission in [shearq.submission("23/den/star"), own]:
        for again in [pickle.loads(pickle.dumps(submission)), copy.deepcopy(submission), copy.copy(submission)]:
            assert isinstance(again, shearq.Configuration)
            for name in ("name", "description", "extends", "settings", "toml", "published"):
                assert getattr(again, name) == getattr(submission, name), name
    measured = [shearq.measure(image.stamps, image.psf, submission=own) for own in (own, pickle.loads(pickle.dumps(own)))]
    assert same_bits(*measured)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_the_number_of_threads_changes_nothing(image, measured, threads):
    assert same_bits(again(image, threads=threads), measured)


def layouts(stamps):
    yield "double", stamps.astype("f8")
    yield "big-endian", stamps.astype(">f4")
    yield "Fortran order", np.asfortranarray(stamps)
    yield "every other of twice as many", np.repeat(stamps, 2, axis=0)[::2]
    yield "turned twice", np.ascontiguousarray(stamps[::-1, ::-1, ::-1])[::-1, ::-1, ::-1]
    record = np.zeros(len(stamps), dtype=[("flag", "u1"), ("stamp", "f4", stamps.shape[1:])])
    record["stamp"] = stamps
    assert not record["stamp"].flags.aligned
    yield "not aligned", record["stamp"]
    yield "list", list(stamps)
    yield "masked, nothing masked", np.ma.masked_array(stamps)


@pytest.mark.parametrize("name", [name for name, _ in layouts(np.zeros((2, 3, 3), "f4"))])
def test_strides_and_orders_of_bytes_change_nothing(image, measured, name):
    stamps = dict(layouts(image.stamps))[name]
    assert same_bits(again(image, stamps), measured)


def test_read_only_arrays_and_memory_maps_are_taken(image, measured, tmp_path):
    locked = image.stamps.copy()
    locked.flags.writeable = False
    assert same_bits(again(image, locked), measured)
    np.save(tmp_path / "stamps.npy", image.stamps)
    assert same_bits(again(image, np.load(tmp_path / "stamps.npy", mmap_mode="r")), measured)


def test_whole_numbers_are_taken(image):
    whole = np.rint(image.stamps * 100).astype("i2")
    assert same_bits(again(image, whole, noise=100.0), again(image, whole.astype("f4"), noise=100.0))


def test_psfs_and_noise_may_be_one_each(image, measured):
    count = len(image.stamps)
    stars = np.broadcast_to(image.psf, (count, *image.psf.shape))
    assert same_bits(again(image, psf=stars), measured)
    assert same_bits(again(image, psf=stars.astype(">f8")), measured)
    assert same_bits(again(image, noise=np.full(count, image.noise)), measured)
    assert same_bits(again(image, psf=stars, noise=np.full(count, image.noise)), measured)
    variable = shearq.simulate(set=1, seed=3, grid=8)[0]
    one_each = again(variable, psf=variable.functional_psf)
    noises = np.full(len(variable.stamps), variable.noise)
    assert same_bits(again(variable, psf=variable.functional_psf, noise=noises), one_each)
    halves = [again(variable, variable.stamps[k:][:32], variable.psf[k:][:32])["R11"] for k in (0, 32)]
    assert same_bits(np.concatenate(halves), again(variable)["R11"])


def test_no_stamps_are_an_empty_catalogue(image):
    empty = again(image, image.stamps[:0])
    assert len(empty) == 0 and empty["e1"].shape == (0,)
    with pytest.raises(ValueError, match="catalogue: found no galaxies"):
        empty.mean_shear()


def test_galaxies_that_cannot_be_measured_are_flagged(image):
    stamps = image.stamps.copy()
    # Too many are missing; a few are filled from the opposite side.
    stamps[3, 10:] = np.nan
    stamps[4] = 2.0
    stamps[6, 7, 5] = np.nan
    found = again(image, stamps)
    assert found["flags"][[3, 4]].tolist() == [shearq.Flag.NotFinite, shearq.Flag.NoScale]
    assert np.isnan(found["e1"][[3, 4]]).all() and found.good.sum() == len(stamps) - 2
    stars = np.repeat(image.psf[np.newaxis], len(stamps), axis=0)
    stars[7] = 0
    assert shearq.Flag(int(again(image, psf=stars)["flags"][7])) == shearq.Flag.BadPsf


def test_a_call_without_a_good_galaxy_is_an_error_with_its_cause(image):
    stamps = np.full_like(image.stamps[:5], np.nan)
    with pytest.raises(ValueError, match="stamps: no galaxy could be measured: 5 of 5 .*missing.*Try: check that masks"):
        again(image, stamps)


def test_noise_per_stamp_is_compared_with_the_stamps(image):
    # Half of the stamps are ten times as bright, so no single level is right.
    scale = np.where(np.arange(len(image.stamps)) % 2, 10.0, 1.0)
    stamps = image.stamps * scale[:, np.newaxis, np.newaxis]
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "the given noise", shearq.DataWarning)
        shearq.measure(stamps, image.psf, noise=image.noise * scale)
    with pytest.warns(shearq.DataWarning, match="the given noise disagrees"):
        shearq.measure(stamps, image.psf, noise=2 * image.noise * scale)


def test_the_catalogue_knows_what_made_it_and_keeps_it(measured):
    attrs = measured.attrs
    assert attrs["submission"] == "48/linear/star" and attrs["version"] == shearq.__version__
    assert attrs["response"] == "not applied"
    assert 'method = "linear"' in attrs["settings"] and attrs["ellipticity"] == "shear"
    assert type(measured["e1"]) is np.ndarray and type(measured[["e1", "e2"]]) is shearq.Catalogue
    some = measured[measured["e1"] > 0]
    assert type(some) is shearq.Catalogue and some.attrs == attrs
    back = pickle.loads(pickle.dumps(some))
    assert back.attrs == attrs and same_bits(back, some)


def test_the_mean_shear_is_the_mean_ellipticity_with_weights_over_their_own_response(measured):
    shear = measured.mean_shear()
    # ⟨R⟩⟨g⟩ = ⟨e⟩.
    e = np.array([measured[f"e{k}"] for k in "12"])
    response = np.array([[measured[f"R{j}{k}"] for k in "12"] for j in "12"])
    mean = response.mean(axis=2)
    assert list(shear) == pytest.approx(np.linalg.solve(mean, e.mean(axis=1)).tolist(), rel=1e-12)
    residual = np.linalg.solve(mean, e - np.einsum("jkn,k->jn", response, list(shear)))[1]
    assert shear.g2_error == pytest.approx(residual.std(ddof=1) / len(measured) ** 0.5, rel=1e-2)
    assert shear.covariance[1][1] == pytest.approx(shear.g2_error**2) and shear.flagged == 0
    assert shear.galaxies == len(measured) and tuple(shear) == (shear.g1, shear.g2)
    # Weights of zero and one are a choice of rows.
    chosen = measured["flux"] > np.median(measured["flux"])
    by_weight, by_row = measured.mean_shear(chosen), measured[chosen].mean_shear()
    assert by_weight.g1 == pytest.approx(by_row.g1, rel=1e-12)
    assert by_weight.g1_error == pytest.approx(by_row.g1_error, rel=1e-12)
    assert by_row.response == pytest.approx((measured["R11"][chosen].mean(), measured["R22"][chosen].mean()))
    for weights, message in [
        (np.ones(3), r"weights: found an array of shape \(3,\); expected \(144,\)"),
        (-np.ones(144), "weights: found one that is negative"),
        (np.zeros(144), "weights: each of the 144 galaxies has a flag or a weight of zero"),
    ]:
        with pytest.raises(ValueError, match=message):
            measured.mean_shear(weights)


def test_columns_of_anacal_give_the_same_shear(measured):
    columns = measured.columns("anacal")
    responses = ["de1_dg1", "de1_dg2", "de2_dg1", "de2_dg2"]
    assert sorted(columns) == [*responses, "e1", "e2", "flags"]
    matrix = np.reshape([columns[name].sum() for name in responses], (2, 2))
    shear = np.linalg.solve(matrix, [columns["e1"].sum(), columns["e2"].sum()]).tolist()
    assert shear == pytest.approx(list(measured.mean_shear()), rel=1e-12)
    assert list(measured.columns()) == list(measured.dtype.names)


def test_a_method_without_a_response_gives_a_plain_mean(image):
    found = again(image, submission="23/raw/star", noise=0.0)
    assert "response" not in found.attrs and np.isnan(found["R11"]).all()
    good = found[found.good]
    assert found.mean_shear().g1 == pytest.approx(good["e1"].mean()) and found.mean_shear().response is None


def test_submissions_of_ones_own_are_mappings_texts_and_files(image, tmp_path):
    settings = {"extends": "48/linear/star", "noise": {"source": "border", "border": np.int64(4)}}
    text = 'extends = "48/linear/star"\n[noise]\nsource = "border"\nborder = 4\n'
    (tmp_path / "mine.toml").write_text(text)
    found = [
        shearq.measure(image.stamps, image.psf, submission=own)
        for own in (settings, text, tmp_path / "mine.toml", str(tmp_path / "mine.toml"))
    ]
    assert all(same_bits(one, found[0]) for one in found)
    assert not shearq.submission(settings).needs_noise
    assert shearq.submission(tmp_path / "mine.toml").name == "mine"
    resolved = shearq.submission(settings)
    assert shearq.submission(resolved.toml).settings == resolved.settings == shearq.submission(resolved.settings).settings


def test_submissions_have_settings_and_published_metrics():
    all_of_them = shearq.submissions()
    assert list(all_of_them)[0] == "subm/19/den/star" and "48/linear/func" in all_of_them
    assert all_of_them["23/den/star"].published == {"q": 87.06, "m_half": 0.0357, "sqrt_a": 0.0895}
    linear = all_of_them["48/linear/star"]
    assert linear.published is None and linear.settings["stamp"]["size"] == linear.stamp_size == 48
    assert (linear.psf_size, linear.psf_form, linear.extends) == (48, "star", None)


@pytest.mark.parametrize(("name", "side"), [("48/linear/star", 44), ("48/linear/star", 31), ("23/raw/star", 20)])
def test_small_stamps_name_the_settings_that_measure_them(name, side):
    image = shearq.simulate(set=8, grid=8, seed=1)[0]
    first = (48 - side) // 2
    stamps = image.stamps[:, first : first + side, first : first + side]
    with pytest.raises(ValueError, match=f"stamps of {side} × {side} pixels; expected at least .* Try: submission=") as raised:
        shearq.measure(stamps, image.psf, noise=image.noise, submission=name)
    stated: dict[str, str] = {}
    exec(str(raised.value).split("Try: ")[1], stated)
    assert not shearq.measure(stamps, image.psf, noise=image.noise, submission=stated["submission"])["flags"].all()


WRONG = [
    (dict(stamps=np.zeros((48, 48))), ValueError, r"stamps: found an array of shape \(48, 48\); expected \(n, ny, nx\)"),
    (dict(stamps=np.zeros((2, 48, 46))), ValueError, r"stamps: found an array of shape \(2, 48, 46\); expected squares"),
    (dict(stamps=np.zeros((2, 40, 40))), ValueError, "stamps: stamps of 40 × 40 pixels; expected at least 48 × 48"),
    (dict(stamps=np.zeros((2, 48, 48), "c8")), TypeError, "stamps: found numbers of type complex64"),
    (dict(stamps=np.zeros((2, 48, 48), "O")), TypeError, "stamps: found numbers of type object"),
    (dict(stamps="stamps.fits"), ValueError, "stamps: stamps.fits: cannot open the file"),
    (dict(stamps=[np.zeros((48, 48)), np.zeros((40, 40))]), ValueError, "stamps: found arrays of shapes \\(48, 48\\), \\(40, 40\\); expected one shape"),
    (dict(stamps=np.ma.masked_all((2, 48, 48))), ValueError, "stamps: no galaxy could be measured"),
    (dict(psf=np.ma.masked_all((32, 32))), ValueError, "psf: found masked values"),
    (dict(mask=np.zeros((2, 48, 48), bool)), ValueError, r"mask: found an array of shape \(2, 48, 48\)"),
    (dict(mask=np.zeros((48, 48))), TypeError, "mask: found values of type float64"),
    (dict(x=np.zeros(3)), ValueError, r"x: found an array of shape \(3,\)"),
    (dict(ids=np.zeros(144)), TypeError, "ids: found values of type float64"),
    (dict(psf=np.zeros((3, 32, 32))), ValueError, r"psf: found an array of shape \(3, 32, 32\); expected \(py, px\) or \(144,"),
    (dict(psf=np.zeros((32, 32))), ValueError, "psf: the pixels of the PSF stamp sum to 0"),
    (dict(psf=np.ones((30, 30))), ValueError, "psf: a PSF stamp of 30 × 30 pixels; expected at least 32 × 32"),
    (dict(psf=np.ones((144, 30, 30))), ValueError, "psf: PSF stamps of 30 × 30 pixels; expected at least 32 × 32"),
    (dict(psf=np.full((32, 32), np.nan)), ValueError, "psf: "),
    (dict(psf=shearq.FunctionalPsf([3.0, 3.1])), ValueError, "psf: 2 given; expected 144, one for each stamp"),
    (dict(psf=shearq.FunctionalPsf(-1.0)), ValueError, "psf: the PSF's FWHM must be a positive number"),
    (dict(noise=-1.0), ValueError, "noise: found -1.0; expected a finite number"),
    (dict(noise=np.nan), ValueError, "noise: found nan"),
    (dict(noise="one"), TypeError, "noise: found str"),
    (dict(noise=np.ones(3)), ValueError, r"noise: found an array of shape \(3,\); expected one number, or \(144,\)"),
    (dict(noise=np.r_[-1.0, np.ones(143)]), ValueError, "noise: the noise level is -1"),
    (dict(submission="48/linear/stra"), KeyError, "submission: there is no configuration or file named"),
    (dict(submission="a\nb"), ValueError, "submission: in the configuration file own"),
    (dict(submission={"extends": "48/linear/star", "stamp": {"sise": 4}}), ValueError, "sise"),
    (dict(submission={"extends": "48/linear/star", "stamp": {"size": 4000}}), ValueError, "stamp.size"),
    (dict(submission={"extends": object()}), ValueError, "submission: not valid settings"),
    (dict(submission={"extends": None}), ValueError, "submission: not valid settings"),
    (dict(submission=48), TypeError, "submission: found int; expected a name"),
    (dict(threads=0), ValueError, "threads: found 0; expected a whole number from 1 to 1024"),
    (dict(threads=1.5), TypeError, "threads: found float"),
    (dict(progress=3), TypeError, "progress: found int"),
]


@pytest.mark.parametrize("arguments, error, message", WRONG)
def test_what_is_wrong_is_told_by_the_arguments_name(image, arguments, error, message):
    given = {"stamps": image.stamps, "psf": image.psf, "noise": image.noise, **arguments}
    with pytest.raises(error, match=message):
        shearq.measure(**given)


def test_noise_that_is_needed_is_asked_for(image):
    told = {"extends": "48/linear/star", "noise": {"source": "header"}}
    assert shearq.submission(told).needs_noise and not shearq.submission("48/linear/star").needs_noise
    with pytest.raises(ValueError, match="noise: the noise level is not given"):
        shearq.measure(image.stamps, image.psf, submission=told)


def test_noise_is_measured_on_stamps_that_hold_some(image):
    found = shearq.measure(image.stamps, image.psf)
    assert found["noise"] == pytest.approx(image.noise, rel=0.02) and found.good.all()
    # Of other numbers and another order of bytes.
    assert same_bits(shearq.measure(image.stamps.astype(">f8"), image.psf), found)
    point = np.zeros_like(image.stamps)
    point[:, 24, 24] = 1
    with pytest.raises(ValueError, match="noise: cannot measure the noise on the borders of 144 stamp"):
        shearq.measure(point, image.psf)
    # Without anything on them there is nothing to measure.
    with pytest.raises(ValueError, match="no galaxy could be measured"):
        shearq.measure(0 * point + 3, image.psf)


def test_progress_counts_every_galaxy_and_its_exceptions_come_through(image, measured):
    heard = []
    assert same_bits(again(image, progress=heard.append), measured)
    assert sum(heard) == len(image.stamps)

    def stop(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        again(image, progress=stop)


def test_other_threads_run_meanwhile(image, measured):
    stamps = np.broadcast_to(image.stamps[:1], (4000, 48, 48))
    results = []
    workers = [threading.Thread(target=lambda: results.append(again(image, stamps, threads=1))) for _ in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(results) == 2 and same_bits(*results)


PEAK = """
import resource, sys
import numpy as np
import shearq

peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
stamps = np.random.default_rng(1).normal(size=(10_000, 48, 48)).astype(np.float32)
y, x = np.mgrid[:48, :48] - 23.5
stamps += (30 * np.exp(-(x * x + y * y) / 30)).astype(np.float32)
stamps = stamps.astype(sys.argv[1])
psf = shearq.FunctionalPsf(3.4)
shearq.measure(stamps[:100], psf, noise=1.0)
# The array is in memory; so is what making it took, beside which the measurement could hide.
with open("/proc/self/clear_refs", "w") as file:
    file.write("5")
before = peak()
shearq.measure(stamps, psf, noise=1.0)
print(peak() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the peak of memory is read as Linux tells it")
@pytest.mark.parametrize("dtype", ["f4", ">f4"])
def test_little_memory_is_taken_beside_the_input(dtype):
    done = subprocess.run([sys.executable, "-c", PEAK, dtype], capture_output=True, text=True, check=True)
    # In MB; a copy of the input would be 88, twice that in double precision.
    assert float(done.stdout) < 40


def gaussian_psf(sigma, side, factor):
    """A Gaussian of σ in pixels of the galaxies on finer pixels, each integrated roughly by 8 points along each axis."""
    points = (np.arange(side * factor * 8) + 0.5) / (8 * factor) - side / 2
    profile = np.exp(-0.5 * (points / sigma) ** 2).reshape(-1, 8).sum(1)
    return np.outer(profile, profile)


def test_oversampled_psfs_are_those_on_galaxy_pixels():
    image = shearq.simulate(set=8, grid=8)[0]
    native = shearq.measure(image.stamps, gaussian_psf(1.45, 48, 1), noise=1.0)
    fine = shearq.measure(image.stamps, gaussian_psf(1.45, 48, 3), noise=1.0, psf_oversampling=3)
    np.testing.assert_allclose(fine["e1"], native["e1"], atol=1e-3)
    np.testing.assert_allclose(fine["R11"], native["R11"], rtol=1e-3)
    each = np.repeat(gaussian_psf(1.45, 48, 3)[None], len(image.stamps), axis=0)
    some = shearq.measure(image.stamps, each, noise=1.0, psf_oversampling=3)
    np.testing.assert_allclose(some["e1"], native["e1"], atol=1e-3)


def test_headers_state_units_and_detectors():
    fits = pytest.importorskip("astropy.io.fits")
    image = shearq.simulate(set=8, grid=8)[0]
    for header, message in (
        ({"BUNIT": "mag"}, "the pixels are magnitudes"),
        ({"BUNIT": "adu2"}, "the pixels are variances"),
        ({"GAIN": 10.0}, r"a gain of 10.0 in the header.* changes m by about \+0.00"),
        ({"SATURATE": 0.5}, "above 0.8 of SATURATE"),
    ):
        with pytest.warns(shearq.DataWarning, match=message):
            shearq.measure(fits.PrimaryHDU(image.stamps, fits.Header(header)), image.psf)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shearq.measure(fits.PrimaryHDU(image.stamps, fits.Header({"GAIN": 1000.0, "SATURATE": 1e5})), image.psf)


def test_headers_state_sizes_of_pixels(tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    image = shearq.simulate(set=8, grid=8)[0]
    fine = gaussian_psf(1.45, 48, 2)
    expected = shearq.measure(image.stamps, fine, noise=1.0, psf_oversampling=2)
    psf = fits.PrimaryHDU(fine, fits.Header({"OVERSAMP": 2, "PIXELSCL": 0.1}))
    psf.writeto(tmp_path / "psf.fits")
    stamps = fits.PrimaryHDU(image.stamps, fits.Header({"PIXSCALE": 0.2}))
    for given in (psf, tmp_path / "psf.fits"):
        with pytest.warns(shearq.DataWarning, match="has 2 × 2 pixels for a pixel of the galaxies"):
            found = shearq.measure(stamps, given, noise=1.0)
        # Files are read in single precision.
        np.testing.assert_allclose(found["e1"], expected["e1"], atol=1e-6)
    for header in ({"PSF_SAMP": 0.5}, {"SAMPLING": 2.0}):
        with pytest.warns(shearq.DataWarning, match="PSF_SAMP or SAMPLING of its header"):
            found = shearq.measure(stamps, fits.PrimaryHDU(fine, fits.Header(header)), noise=1.0)
        np.testing.assert_allclose(found["e1"], expected["e1"], atol=1e-6)
    native = gaussian_psf(1.45, 48, 1)
    with pytest.warns(shearq.DataWarning, match="states 1.500 pixels of the PSF"):
        shearq.measure(stamps, fits.PrimaryHDU(native, fits.Header({"PSF_SAMP": 1 / 1.5})), noise=1.0)
    other = fits.PrimaryHDU(native, fits.Header({"SECPIX": 0.25}))
    with pytest.warns(shearq.DataWarning, match="different pixel scales .found 0.25, expected 0.2 "):
        shearq.measure(stamps, other, noise=1.0)
    # A scale that `wcs` states, on which OVERSAMP has no part.
    contradicted = fits.PrimaryHDU(native, fits.Header({"OVERSAMP": 2, "PIXELSCL": 0.2}))
    wcs = np.diag([0.2, 0.2])
    found = shearq.measure(image.stamps, contradicted, noise=1.0, wcs=wcs)
    np.testing.assert_array_equal(found["e1"], shearq.measure(image.stamps, native, noise=1.0, wcs=wcs)["e1"])
    galsim = pytest.importorskip("galsim")
    stamps_of_galsim = [galsim.Image(stamp, wcs=galsim.JacobianWCS(0.2, 0, 0, 0.2)) for stamp in image.stamps]
    found = shearq.measure(stamps_of_galsim, contradicted, noise=1.0)
    np.testing.assert_array_equal(found["e1"], shearq.measure(image.stamps, native, noise=1.0)["e1"])
    # OVERSAMP that the scales contradict.
    for scale in (0.2, 0.3):
        contradicted = fits.PrimaryHDU(native, fits.Header({"OVERSAMP": 4, "PIXELSCL": scale}))
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            shearq.measure(stamps, contradicted, noise=1.0)
        assert any("different pixel scales" in str(one.message) for one in found) == (scale == 0.3)


def test_oversampling_needs_images_of_whole_pixels():
    image = shearq.simulate(set=8, grid=8)[0]
    with pytest.raises(ValueError, match="oversampled PSF"):
        shearq.measure(image.stamps, gaussian_psf(1.45, 49, 1), noise=1.0, psf_oversampling=4)
    with pytest.raises(ValueError, match="formulas"):
        shearq.measure(image.stamps, shearq.FunctionalPsf(3.4), noise=1.0, psf_oversampling=4)
