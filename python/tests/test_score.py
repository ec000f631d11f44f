"""Scores and spectra."""

import csv
import gzip
import json
import pathlib
import warnings

import numpy as np
import pytest
from conftest import same_bits

import shearq

# Cases with known metrics that the tests of the Rust crate are held against, too.
CASES = pathlib.Path(__file__).parents[2] / "scoring/tests/data"


def read(path):
    with gzip.open(path, "rt") as file:
        rows = list(csv.reader(file))
    return np.array([[float(value) for value in row] for row in rows if row[0][0].isdigit() or row[0][0] in "-."])


@pytest.mark.parametrize("case", ["p1_tiny_noise", "p2_m005_c1e3", "p3_flipped_e2", "p4_missing"])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_cases_of_the_rust_tests_have_their_figures(case):
    expected = json.loads((CASES / case / "expected.json").read_text())
    truth = read(CASES / case / "truth.csv.gz")
    truth = truth[np.lexsort((truth[:, 0], truth[:, 1]))]
    paths = sorted((CASES / case).glob("catalogue_*.csv.gz"), key=lambda path: int(path.name.split("_")[1].split(".")[0]))
    images = [read(path) for path in paths]
    x, y, e1, e2 = np.concatenate(images).T
    numbers = np.repeat(np.arange(len(images)), [len(rows) for rows in images])
    scored = shearq.score(
        e1, e2, truth[:, 2], truth[:, 3],
        images=numbers, positions=(x, y), stamp=48, truth_sign="challenge", convention="matched", noise_variance=expected["noise_var"],
    )  # fmt: skip
    tolerance = 1e-8 if case == "p1_tiny_noise" else 1e-9
    assert scored.convention == expected["matched"] and scored.images == expected["n_images"]
    assert scored["q"] == pytest.approx(expected["Q_matched"], rel=tolerance)
    assert scored.q_leaderboard == pytest.approx(expected["Q"], rel=tolerance)
    assert scored.spectrum["modes"].tolist() == expected["n_modes"]
    of_class = expected["classes"][expected["matched_class"]]
    assert scored.spectrum["ee"] == pytest.approx(np.array(of_class["EE"]), rel=tolerance)
    assert scored.spectrum["true_ee"] == pytest.approx(np.array(expected["truth"]["EE"]), rel=tolerance)


@pytest.fixture(scope="module")
def wave():
    """A grid of 16 × 16 with a single wave of shear along x."""
    g1 = np.broadcast_to(0.02 * np.cos(2 * np.pi * 3 * np.arange(16) / 16), (16, 16))
    return g1, np.zeros((16, 16))


def test_a_known_bias_is_found_in_any_arrangement(wave):
    g1, g2 = wave
    noise = np.random.default_rng(1).normal(0, 1e-5, (2, 3, 16, 16))
    e1, e2 = 1.01 * g1 + noise[0], g2 + noise[1]
    scored = shearq.score(e1, e2, g1, g2)
    # What noise of 1e-5 does to the mean of 256 galaxies under shear of 0.02.
    assert scored["m_cross"] == pytest.approx(0.01, abs=1e-4)
    assert scored.images == 3 and scored.convention == 5
    # e2 is noise of 1e-5 alone, less than the step of 1e-4 within which placeholders are equal.
    assert all("repeated values" in note for note in scored.notes)
    assert scored.errors["m_cross"] < 1e-3 and scored.replicates.shape == (3, len(shearq.METRICS))
    x, y = np.meshgrid(48 * np.arange(16) + 24.5, 48 * np.arange(16) + 24.5)
    order = np.random.default_rng(2).permutation(3 * 256)
    mixed = [np.broadcast_to(a, e1.shape).reshape(-1)[order] for a in (e1, e2, x, y)]
    labels = np.repeat([7, 8, 9], 256)[order]
    for other in (
        shearq.score(e1.reshape(3, 256), e2.reshape(3, 256), g1.ravel(), g2.ravel()),
        shearq.score(e1.ravel(), e2.ravel(), g1, g2, images=3),
        shearq.score(*mixed[:2], g1, g2, images=labels, positions=mixed[2:], stamp=48),
        shearq.score(e1.astype(">f8"), np.asfortranarray(e2), g1, -g2, truth_sign="challenge"),
    ):
        assert same_bits(list(other.metrics.values()), list(scored.metrics.values()))
    with pytest.raises(KeyError, match="no metric 'Q'; known metrics: q, "):
        scored["Q"]


def test_spectra_are_those_of_the_score(wave):
    g1, g2 = wave
    spectrum = shearq.power_spectrum(g1, g2)
    scored = shearq.score(g1, g2, g1, g2).spectrum
    for name in spectrum.dtype.names:
        assert np.array_equal(spectrum[name], scored[name]), name
    assert np.array_equal(scored["ee"], scored["true_ee"])
    # A wave along x of e1 is an E mode.
    assert spectrum["ee"].max() > 1e20 * spectrum["bb"].max() and spectrum["scored"].sum() == 8
    # 5 degrees a side: half the field, twice the multipoles.
    smaller = shearq.power_spectrum(g1, g2, field_degrees=5)
    filled = (spectrum["l"] > 0) & (smaller["l"] > 0)
    assert smaller["l"][filled] == pytest.approx(2 * spectrum["l"][filled])
    x, y = np.meshgrid(48 * np.arange(16) + 24.5, 48 * np.arange(16) + 24.5)
    placed = shearq.power_spectrum(g1.ravel(), g2.ravel(), positions=(x.ravel(), y.ravel()), stamp=48, cells=16)
    assert np.array_equal(placed["ee"], spectrum["ee"])


def test_axes_and_signs_are_those_told(wave):
    g1, g2 = wave
    diagonal = np.random.default_rng(3).normal(0, 0.01, (16, 16))
    with pytest.warns(UserWarning, match=r"match the truth in convention 6 \(e2 flipped\)"):
        shearq.score(*_field(), *_field(sign=-1), truth_sign="standard")
    found = shearq.score(*_field(), *_field(sign=-1))
    assert (found.truth_sign, found.convention, found.notes) == ("challenge", 5, [])
    assert shearq.score(*_field(), *_field()).truth_sign == "standard"
    random = np.random.default_rng(5)
    (e1, e2), (mixed1, mixed2) = random.normal(0, 0.1, (2, 2, 16, 16))
    with pytest.raises(ValueError, match='truth_g2: cannot determine the sign of g2.*truth_sign="standard"'):
        shearq.score(e1, e2, mixed1, mixed2)
    assert shearq.score(mixed1, mixed2, mixed1, -mixed2).truth_sign == "challenge"
    assert shearq.score(g1, diagonal, g1, diagonal)["m_cross"] == pytest.approx(0, abs=1e-12)


def _field(n=32, sign=1):
    """Shear with power on all scales."""
    rng = np.random.default_rng(4)
    k1, k2 = np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n))
    kappa = np.fft.fft2(rng.normal(size=(n, n)))
    k = k1 + 1j * k2
    turn = np.where(k == 0, 0, k**2 / np.maximum(np.abs(k) ** 2, 1e-30))
    gamma = 0.01 * np.fft.ifft2(turn * kappa)
    return gamma.real, sign * gamma.imag


def test_missing_galaxies_are_warned_of(wave):
    g1, g2 = (np.array(g) for g in wave)
    e1 = g1.copy()
    e1[3, 8] = np.nan
    with pytest.warns(UserWarning, match="1 of 256 galaxies of e1, e2 have no ellipticity"):
        assert shearq.score(e1, g2, g1, g2)["m_cross"] < 0


@pytest.mark.parametrize("value", [-10.0, -99.0, 1e20, 1e30])
def test_failure_values_are_refused_or_dropped_and_counted(wave, value):
    g1, g2 = wave
    e1 = np.stack([g1, g1])
    e1[1, 3, 8] = value
    images = (e1, np.stack([g2, g2]))
    for function, more in ((shearq.score, (g1, g2)), (shearq.power_spectrum, ())):
        with pytest.raises(ValueError, match=r"1 rows have a number that no .* row 57 with .*try drop_missing=True or set it to NaN"):
            function(*images, *more)
    missing = np.where(e1 == value, np.nan, e1)
    with pytest.warns(UserWarning, match="1 of 512 galaxies of e1, e2 have no ellipticity"):
        expected = shearq.score(missing, images[1], g1, g2)
        found = shearq.score(*images, g1, g2, drop_missing=True)
    assert same_bits(list(found.metrics.values()), list(expected.metrics.values()))
    assert (found.dropped, expected.dropped) == (1, 0)
    assert found.notes[-1] == "note: 1 of 512 rows stand for a failed measurement; they count as missing."
    spectra = shearq.power_spectrum(*images, drop_missing=True), shearq.power_spectrum(missing, images[1])
    assert same_bits(*spectra)
    with pytest.raises(ValueError, match="truth_g1: found masked values"):
        shearq.score(g1, g2, np.ma.masked_array(g1, mask=g1 > 0.01), g2)


def test_a_constant_shear_gives_means():
    constant = np.full((12, 12), 0.02)
    e1 = constant + np.random.default_rng(1).normal(0, 0.1, (12, 12))
    # 0.02 is 2.4 errors of the mean: too few for the sign of g2.
    with pytest.raises(ValueError, match="cannot determine the sign of g2"):
        shearq.score(e1, e1, constant, constant)
    mean = shearq.score(e1, e1, constant, constant, truth_sign="standard").mean
    assert mean["e"][0] == pytest.approx(e1.mean()) and mean["truth"] == (0.02, 0.02)
    assert mean["error"][0] == pytest.approx(0.1 / 12, rel=0.3)


FIELD = np.zeros((16, 16))
WRONG = [
    (dict(e2=np.zeros((16, 15))), r"e2: found an array of shape \(16, 15\); expected \(16, 16\), as e1 has"),
    (dict(truth_g2=np.zeros(9)), "truth_g2: found 9 values; expected 256, as truth_g1 has"),
    (dict(truth_g1=np.zeros(10), truth_g2=np.zeros(10)), "truth_g1: found 10 values; expected those of a square"),
    ({name: np.zeros((2, 2)) for name in ("e1", "e2", "truth_g1", "truth_g2")}, "the grid has 2 cells per side; expected 8 to"),
    (dict(truth_g1=FIELD + np.nan), r"the true shear of cell \(1, 1\) is not a finite number"),
    (dict(e1=np.zeros((3, 5)), e2=np.zeros((3, 5))), r"e1: found an array of shape \(3, 5\); expected \(16, 16\)"),
    (dict(images=3), "images: found 3; expected a divisor of the 256 values"),
    (dict(images=np.zeros(3, int)), r"images: found int64 of shape \(3,\)"),
    (dict(positions=(FIELD, FIELD)), "stamp: not given; expected the pixels a side"),
    (dict(positions=(FIELD, FIELD[0]), stamp=48), r"positions: found arrays of shapes \(16, 16\) and \(16,\)"),
    (dict(positions=FIELD, stamp=48), "positions: found ndarray; expected two arrays"),
    (dict(positions=(FIELD, FIELD), stamp=48), "images: not given; expected the number of images"),
    (dict(e1=FIELD - 99), "256 rows have a number that no measurement"),
    (dict(definition="mine"), 'definition: "mine"; expected "leaderboard" or "corrected"'),
    (dict(convention=9), 'convention: found "9", expected `matched`, `best` or a number from 1 to 8'),
    (dict(field_degrees=0), "field_degrees: found 0.0; expected a positive number, at most 360"),
    (dict(field_degrees=1e17), "field_degrees: found 1e"),
    (dict(noise_variance=-1), "noise_variance: found -1.0; expected a finite number, zero or more"),
    (dict(truth_sign="other"), "truth_sign: \"other\""),
]


@pytest.mark.parametrize("arguments, message", WRONG)
def test_what_is_wrong_is_told(arguments, message):
    given = {"e1": FIELD, "e2": FIELD, "truth_g1": FIELD, "truth_g2": FIELD, **arguments}
    with pytest.raises(ValueError, match=message), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        shearq.score(**given)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_catalogues_are_compared_over_the_same_images():
    simulation = shearq.simulate(set=8, images=8, grid=16, seed=2)
    linear = [shearq.measure(i.stamps, i.psf, noise=i.noise) for i in simulation]
    raw = [shearq.measure(i.stamps, i.psf, submission="23/raw/star") for i in simulation]
    rows = shearq.compare({"mine": raw, "48/linear/star": linear, "23/raw/star": raw}, simulation, frame="list")
    assert [row["submission"] for row in rows] == ["mine", "48/linear/star", "23/raw/star"]
    joined = shearq.concatenate(linear)
    e1, e2 = (np.stack([c[f"e{k}"] for c in linear]) / joined[f"R{k}{k}"].mean() for k in (1, 2))
    alone = shearq.score(e1, e2, simulation.g1, simulation.g2)
    assert rows[1]["q"] == pytest.approx(alone["q"], rel=1e-12) and rows[1]["q_difference"] == pytest.approx(alone["q"] - rows[0]["q"])
    assert rows[1]["sigma"] == rows[1]["q_difference"] / rows[1]["q_difference_error"]
    assert np.isnan(rows[0]["q_difference"]) and rows[2]["q_difference"] == 0
    assert rows[2]["q_published"] == 80.33 and np.isnan(rows[1]["q_published"])
    few = shearq.compare({"mine": raw[:7], "48/linear/star": linear[:7]}, simulation, frame="list")
    assert np.isfinite(few[1]["q_difference"]) and np.isnan(few[1]["sigma"])
    # A method that halves the shear differs in Q, and not in calibrated Q beyond what rounding leaves.
    draw = np.random.default_rng(3).normal
    good = [{"e1": simulation.g1 + draw(0, 0.005, (16, 16)), "e2": simulation.g2 + draw(0, 0.005, (16, 16))} for _ in range(8)]
    half = [{name: 0.5 * catalogue[name] for name in catalogue} for catalogue in good]
    halved = shearq.compare({"good": good, "half": half}, simulation, frame="list")[1]
    assert halved["sigma"] < -3 and abs(halved["q_calibrated_difference"]) < 1e-6 * halved["q_calibrated"]
    noisy = [{name: catalogue[name] + draw(0, 0.02, (16, 16)) for name in catalogue} for catalogue in good]
    noisier = shearq.compare({"good": good, "noisy": noisy}, simulation, frame="list")[1]
    calibrated = noisier["q_calibrated_difference"]
    assert calibrated < 0 and noisier["q_calibrated_sigma"] == calibrated / noisier["q_calibrated_difference_error"]
    pandas = pytest.importorskip("pandas", reason="frames of pandas need it")
    frame = shearq.compare({"mine": raw[0]}, (simulation.g1, simulation.g2), frame="pandas")
    assert isinstance(frame, pandas.DataFrame) and frame.shape == (1, len(rows[0]))
    with pytest.raises(ValueError, match="catalogues: 'mine' has no images"):
        shearq.compare({"mine": 3}, simulation, frame="list")
    with pytest.raises(ValueError, match="frame: found 'excel'"):
        shearq.compare({}, simulation, frame="excel")


@pytest.mark.parametrize(
    "arguments, message",
    [
        (dict(set=25), "set: found 25; expected a whole number from 1 to 24"),
        (dict(grid=7), "grid: found 7; expected a whole number from 8 to 400"),
        (dict(seed=-1), "seed: found -1"),
        (dict(images=0), "images: found 0"),
        (dict(amplitude=np.inf), "amplitude: found inf"),
        (dict(amplitude=1e9, grid=8), "the largest shear is"),
    ],
)
def test_simulations_that_cannot_be_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        shearq.simulate(**arguments)


def _images(n=32, images=4, noise=0.01):
    """A shear field and noisy images of it."""
    g1, g2 = _field(n)
    rng = np.random.default_rng(7)
    e1, e2 = (np.stack([g + rng.normal(0, noise, (n, n)) for _ in range(images)]) for g in (g1, g2))
    return e1, e2, g1, g2


def test_sound_ellipticities_are_scored_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert shearq.score(*_images()).notes == []


def test_probable_faults_are_warned_of():
    e1, e2, g1, g2 = _images()
    copies = [np.concatenate([e[:1]] * 4) for e in (e1, e2)]
    for faulty, expected in (
        ((2 * e1, 2 * e2), "seem to be distortions"),
        ((np.roll(e1, 1, 2), np.roll(e2, 1, 2)), r"shifted by \(\+1, \+0\) cells"),
        ((e2, e1), "e1 and e2 seem to be swapped"),
        ((0.5 * e1, 0.5 * e2), "expected .m. below 0.1"),
        (copies, "image 2 has the ellipticities of image 1, and 2 more likewise"),
        ((0 * e1, 0 * e2), r"image 1: 1024 of 1024 galaxies have repeated values, most often \(e1, e2\) = \(0, 0\)"),
    ):
        with pytest.warns(UserWarning, match=expected):
            shearq.score(*faulty, g1, g2)
    with pytest.warns(UserWarning, match='Try: truth_sign="challenge"'):
        shearq.score(e1, e2, g1, -g2, truth_sign="standard")


# What commands say of the choice of a convention, which Python words with the names of its arguments.
OF_CONVENTIONS = ("the leaderboard uses", "cannot determine the sign", "match the truth in convention")


@pytest.mark.parametrize("convention", ["5", "best", "matched"])
@pytest.mark.parametrize("fault", ["constant", "copied", "exchanged"])
def test_findings_are_those_of_the_command_line(command, tmp_path, fault, convention):
    e1, e2, g1, g2 = _images()
    if fault == "constant":
        # Of most images, so that m is far from zero.
        e1[:3], e2[:3] = 0.1, 0.2
    elif fault == "copied":
        e1[1:], e2[1:] = e1[0], e2[0]
    else:
        e1[2], e2[2] = e2[2].copy(), e1[2].copy()
    y, x = 48 * np.indices(g1.shape) + 24.5

    def write(name, header, *columns):
        np.savetxt(tmp_path / name, np.stack(columns).reshape(4, -1).T, "%.17g", ",", header=header, comments="")
        return tmp_path / name

    truth = write("truth.csv", "x,y,g1,g2", x, y, g1, g2)
    paths = [write(f"{k}.csv", "x,y,e1,e2", x, y, *e) for k, e in enumerate(zip(e1, e2), 1)]
    options = ("--truth-sign", "standard", "--convention", convention, "--format", "csv")
    said = command("score", "--truth", truth, *paths, *options, stream="stderr")
    for k, path in enumerate(paths, 1):
        said = said.replace(str(path), f"image {k}")

    def findings(lines):
        return [line for line in lines if line.startswith("warning: ") and not any(words in line for words in OF_CONVENTIONS)]

    with pytest.warns(UserWarning):
        scored = shearq.score(e1, e2, g1, g2, truth_sign="standard", convention=convention)
    assert findings(scored.notes) == findings(said.splitlines()) != []


def test_nothing_to_score_is_an_error_and_a_constant_truth_is_noted():
    e1, e2, g1, g2 = _images()
    with pytest.raises(ValueError, match="no galaxy has an ellipticity"):
        shearq.score(np.full_like(e1, np.nan), e2, g1, g2)
    with pytest.raises(ValueError, match="expected less than 1"):
        shearq.score(e1, e2, 100 * g1, 100 * g2)
    constant = np.full_like(g1, 0.01)
    scored = shearq.score(e1 - g1 + constant, e2 - g2 + constant, constant, constant)
    assert np.isnan(scored["q"]) and any("the true shear is the same everywhere" in note for note in scored.notes)


def test_aperture_masses_are_those_of_treecorr():
    case = CASES / "great3/p7_aperture_weights_holes"
    expected = json.loads((case / "expected.json").read_text())
    with gzip.open(case / "catalogue.txt.gz", "rt") as file:
        rows = np.array([line.split() for line in file if not line.startswith("#")], dtype=float)
    number = rows[:, 0].astype(int)
    g = np.where((rows[:, 3:5] < 10).all(axis=1)[:, None], rows[:, 3:5], np.nan)
    found = shearq.aperture_mass(*g.T, nodes=(number // 1000 % 1000, number % 1000), weights=rows[:, 5], side=700)
    assert found["pairs"].tolist() == expected["pairs"]
    # TreeCorr keeps shears in 32 bits.
    assert found["xi_plus"] == pytest.approx(np.array(expected["xi_plus"]), abs=1e-11)
    largest = np.abs(expected["map_E"]).max()
    assert found["map_e"] == pytest.approx(np.array(expected["map_E"]), abs=1e-8 * largest)
    assert found["map_b"] == pytest.approx(np.array(expected["map_B"]), abs=1e-8 * largest)


def test_a_lattice_is_its_grid_and_faults_are_named(wave):
    g1, g2 = wave
    y, x = np.indices(g1.shape)
    plain = shearq.aperture_mass(g1, g2)
    same_bits(plain, shearq.aperture_mass(g1.ravel(), g2.ravel(), nodes=(x, y), side=16))
    # All pairs are between 0.02 and 10 degrees but those of nearly opposite corners.
    lags = np.hypot(*(np.subtract.outer(index.ravel(), index.ravel()) for index in (x, y)))
    assert plain["pairs"].sum() == ((lags > 0) & (lags < 16)).sum() / 2
    for arguments, argument in [
        ({"nodes": (x, y)}, "side"),
        ({"nodes": (x - 1, y), "side": 16}, "nodes"),
        ({"nodes": (x, y), "side": 15}, "lattice"),
        ({"weights": [1.0]}, "lengths"),
        ({"weights": np.full(256, np.inf)}, "finite"),
    ]:
        with pytest.raises(ValueError, match=argument):
            shearq.aperture_mass(g1, g2, **arguments)


COLUMNS = sorted((pathlib.Path(__file__).parents[2] / "tests/data/columns").glob("*.txt"))


def recognised(path):
    """A catalogue of 144 galaxies with the columns of a public catalogue, and the columns by role that this has."""
    lines = path.read_text().splitlines()
    used = next(line for line in lines if line.startswith("# used: ")).split("): ")[1].rstrip(".")
    roles = {name: role for role, names in (pair.split("=") for pair in used.split(", ")) for name in names.split("+")}
    given = [line.removeprefix("# given: ").split() for line in lines if line.startswith("# given: ")]
    given = dict(text.split("=") for texts in given for text in texts)
    rng, side = np.random.default_rng(7), 12
    versions = ["noshear", "1p", "1m", "2p", "2m"] if "version" in roles.values() else ["noshear"]
    y, x = np.mgrid[:side, :side] * 48 + 24.5
    galaxies = np.repeat(np.arange(side * side), len(versions))
    table = {"x": x.ravel()[galaxies], "y": y.ravel()[galaxies]}
    e = 0.02 + 0.1 * rng.standard_normal((2, side * side))
    step = {"1p": (0, 0.01), "1m": (0, -0.01), "2p": (1, 0.01), "2m": (1, -0.01)}
    sheared = np.tile(versions, side * side)
    for name in [name for line in lines if not line.startswith("#") for name in line.split()]:
        role = roles.get(name, "")
        number = rng.uniform(0.5, 1.5, side * side)[galaxies]
        if role.startswith(("e1", "e2", "ksb_e")):
            k = int("2" in role[:2] or role == "ksb_e2")
            change = [0.7 * g if of == k else 0.0 for of, g in (step.get(label, (k, 0.0)) for label in (role[3:], *sheared))]
            number = e[k][galaxies] + change[0] + np.array(change[1:])
        elif role == "flag":
            number = (galaxies % 31 == 7).astype(float)
        elif role == "w":
            number = np.where(galaxies % 29 == 3, 0.0, number)
        elif role == "id":
            number = 1000.0 + galaxies
        elif role == "version":
            number = sheared.tolist()
        elif role.startswith("psf_e") or role in ("R12", "R21", "dw1", "dw2"):
            number = 0.02 * (number - 1)
        elif role == "rms_e":
            number = 0.35 * np.ones(len(galaxies)) + 0.01 * number
        elif "flag" in name.lower():
            number = np.zeros(len(galaxies))
        table[name] = number
    if "g1" in roles.values():
        # Then c is the mean shear.
        given |= {"g1": "none", "g2": "none"}
    return table, given


@pytest.mark.parametrize("path", COLUMNS, ids=lambda path: path.stem)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_any_catalogue_is_calibrated_as_bias_does(path):
    table, given = recognised(path)
    bias = shearq.bias(table, columns=given, units="rows")
    found = shearq.galaxies(table, columns=given)
    g = np.full(144, 0.02), np.full(144, 0.01)
    scored = shearq.score(
        found.e1, found.e2, *g, weights=found.weights, positions=found.positions, images=found.images, stamp=48, truth_sign="standard"
    )  # fmt: skip
    np.testing.assert_allclose(scored.mean["e"], [bias["c1"], bias["c2"]], rtol=0, atol=1e-12)
    assert np.isfinite(found.e1).sum() == bias["n"]
    assert found.notes[0].startswith("Columns: ")


@pytest.mark.parametrize("fault", ["constant", "copied", "exchanged", "none"])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_python_finds_the_faults_that_the_command_line_finds(fault, command, tmp_path):
    rng, n = np.random.default_rng(5), 32
    truth = np.array(_field(n))
    images = truth + rng.normal(0, 0.003, (4, 2, n, n))
    if fault == "constant":
        images[2] = 0.01
    if fault == "copied":
        images[2] = images[1]
    if fault == "exchanged":
        images[2] = images[2, ::-1]
    y, x = np.mgrid[:n, :n] * 48 + 24.5

    def write(name, header, values):
        rows = np.transpose([x.ravel(), y.ravel(), *values.reshape(2, -1)])
        np.savetxt(tmp_path / name, rows, fmt="%.17g", delimiter=",", header=header, comments="")
        return tmp_path / name

    paths = [write(f"{k}.csv", "x,y,e1,e2", image) for k, image in enumerate(images, 1)]
    of_truth = write("truth.csv", "x,y,g1,g2", truth)
    printed = json.loads(command("score", "--truth", of_truth, "--truth-sign", "standard", "--convention", 5, "--format", "json", *paths))
    scored = shearq.score(images[:, 0], images[:, 1], *truth, truth_sign="standard")
    expected = [text for text in printed["warnings"] if text.startswith("warning: ")]
    for k, path in enumerate(paths, 1):
        expected = [text.replace(str(path), f"image {k}") for text in expected]
    assert scored.notes == expected
    assert bool(expected) == (fault != "none")
    assert scored["q"] == pytest.approx(printed["metrics"]["q"], rel=1e-12)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_weights_have_the_rule_of_the_command_line(command, tmp_path):
    *images, g1, g2 = _images()
    n, truth = 32, np.array([g1, g2])
    rng = np.random.default_rng(3)
    weights = rng.uniform(0.2, 3, (4, n * n))
    weights[:, ::50] = -1
    y, x = (part.ravel() for part in np.mgrid[:n, :n] * 48 + 24.5)
    e1, e2 = (np.asarray(part).reshape(4, -1) for part in images)

    def write(name, header, columns):
        np.savetxt(tmp_path / name, np.transpose(columns), "%.17g", ",", header=header, comments="")
        return str(tmp_path / name)

    given = write("truth.csv", "x,y,g1,g2", [x, y, *truth.reshape(2, -1)])
    paths = [write(f"{k}.csv", "x,y,e1,e2,w", [x, y, e1[k], e2[k], weights[k]]) for k in range(4)]
    line = ["score", "--truth", given, *paths, "--truth-sign", "standard", "--convention", "5", "--format", "json"]
    expected = json.loads(command(*line))["metrics"]["q"]
    scored = shearq.score(e1, e2, *truth, weights=weights, truth_sign="standard")
    assert scored["q"] == pytest.approx(expected, rel=1e-9)
    shuffled = np.random.default_rng(1).permutation(4 * n * n)
    numbers, x, y = np.repeat(np.arange(4), n * n), np.tile(x, 4), np.tile(y, 4)
    parts = [own.ravel()[shuffled] for own in (e1, e2, weights, numbers, x, y)]
    other = shearq.score(
        *parts[:2], *truth, weights=parts[2], images=parts[3], positions=parts[4:], stamp=48, truth_sign="standard"
    )  # fmt: skip
    assert other["q"] == pytest.approx(expected, rel=1e-9)
    weights[0, 1] = np.nan
    with pytest.raises(ValueError, match="weights: found one that is not finite"):
        shearq.score(e1, e2, *truth, weights=weights, truth_sign="standard")


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_an_empty_catalogue_is_an_image():
    *images, g1, g2 = _images()
    y, x = (part.ravel() for part in np.mgrid[:32, :32] * 48 + 24.5)
    tables = [{"x": x, "y": y, "e1": np.ravel(e1), "e2": np.ravel(e2)} for e1, e2 in zip(*images)]
    tables[2] = {name: column[:0] for name, column in tables[2].items()}
    found = shearq.galaxies(tables)
    scored = shearq.score(
        found.e1, found.e2, g1, g2, weights=found.weights, positions=found.positions, images=found.images, stamp=48,
        truth_sign="standard",
    )  # fmt: skip
    assert scored.images == 4
