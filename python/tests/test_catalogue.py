"""Catalogues keep their calibration in any table, file and process."""

import copy
import json
import pickle
import subprocess
import sys

import numpy as np
import pytest
from conftest import same_bits

import shearq

hypothesis = pytest.importorskip("hypothesis", reason="random sequences of operations need hypothesis")
strategies = pytest.importorskip("hypothesis.strategies")

FILES = (".parquet", ".fits", ".npy", ".ecsv")


def _galaxies(seed, set, first, **options):
    image = shearq.simulate(set=set, seed=seed, grid=8)[0]
    count = len(image.stamps)
    ids = np.arange(first, first + count)
    x, y = np.random.default_rng(seed).uniform(0, 1000, (2, count))
    stamps = image.stamps.copy()
    # One galaxy is flagged.
    stamps[5] = np.nan
    return shearq.measure(stamps, image.psf, ids=ids, x=x, y=y, noise=image.noise, **options)


@pytest.fixture(scope="module")
def two():
    """Catalogues whose mean responses differ by some ten per cent."""
    return _galaxies(3, 8, 0), _galaxies(4, 5, 1000)


def expected(rows):
    """(ΣR)⁻¹Σe of rows without flags, with the 2 × 2 responses R."""
    good = rows[rows["flags"] == 0]
    response = [[good[f"R{j}{k}"].sum() for k in (1, 2)] for j in (1, 2)]
    return np.linalg.solve(response, [good[f"e{k}"].sum() for k in (1, 2)]).tolist()


def test_joined_tables_have_the_mean_shear_of_all_rows(two):
    table = pytest.importorskip("astropy.table", reason="tables of astropy need it")
    a, b = two
    assert abs(a["R11"][a.good].mean() / b["R11"][b.good].mean() - 1) > 0.01
    whole = expected(np.concatenate([part.view(np.ndarray) for part in two]))
    stacked = shearq.Catalogue.from_table(table.vstack([a.to_astropy(), b.to_astropy()]))
    joined = shearq.concatenate([a, b])
    for both in (stacked, joined, np.concatenate([a, b]), np.hstack([a, b]), np.append(a, b)):
        assert type(both) is shearq.Catalogue
        shear = both.mean_shear()
        assert list(shear) == pytest.approx(whole, rel=1e-12) and shear.galaxies == 126 and shear.flagged == 2
        sums = {name: column[both.good].sum(axis=0) for name, column in {**both.columns("anacal"), **both.columns("ngmix")}.items()}
        for e, responses in (
            ([sums["e1"], sums["e2"]], ("de1_dg1", "de1_dg2", "de2_dg1", "de2_dg2")),
            (sums["g"], ("R11", "R12", "R21", "R22")),
        ):
            matrix = np.reshape([sums[name] for name in responses], (2, 2))
            assert np.linalg.solve(matrix, e).tolist() == pytest.approx(whole, rel=1e-12)
        # The estimate of Rust: c without a true shear is the mean shear. Its sums are in another order.
        for names in ("anacal", "ngmix"):
            found = shearq.bias(both.columns(names), g1=0.0, g2=0.0)
            assert [found["c1"], found["c2"]] == pytest.approx(whole, rel=1e-9), names
    assert str(shearq.mean_shear(iter(two))) == str(joined.mean_shear())
    weights = np.arange(128.0)
    assert shearq.mean_shear(two, weights).g1 == pytest.approx(joined.mean_shear(weights).g1, rel=1e-12)
    assert joined.attrs["submission"] == "48/linear/star"


def test_catalogues_of_other_columns_or_types_are_not_joined(two):
    a, b = two
    with pytest.raises(ValueError, match="do not share the columns id, x, y"):
        shearq.concatenate([a, b[[name for name in b.dtype.names if name not in ("id", "x", "y")]]])
    other = b.copy()
    other.attrs["ellipticity"] = "distortion"
    with pytest.raises(ValueError, match="found shears and distortions"):
        np.concatenate([a, other])
    with pytest.raises(ValueError, match="catalogues: found none"):
        shearq.concatenate([])
    with pytest.raises(ValueError, match="catalogues: found none"):
        shearq.mean_shear([])
    with pytest.raises(TypeError, match="number 1 is of type ndarray"):
        shearq.concatenate([a, np.zeros(3)])


def test_calibrated_rows_and_rows_without_calibration_can_be_joined(two):
    image = shearq.simulate(set=8, seed=9, grid=8)[0]
    network = shearq.measure(image.stamps, image.psf, noise=0.0, submission={"extends": "23/raw/star", "shape": {"ellipticity": "shear"}})
    plain = two[0][list(network.dtype.names)]
    both = shearq.concatenate([plain, network])
    good = plain[plain.good]
    # Rows without calibration have the unit matrix as their response.
    e = [good[f"e{k}"].sum() + network[f"e{k}"][network.good].sum() for k in (1, 2)]
    response = [[good[f"R{j}{k}"].sum() + (j == k) * network.good.sum() for k in (1, 2)] for j in (1, 2)]
    assert list(both.mean_shear()) == pytest.approx(np.linalg.solve(response, e).tolist(), rel=1e-12)
    columns = both.columns("ngmix")
    assert (columns["R12"][both.good][-network.good.sum() :] == 0).all()


@pytest.mark.parametrize("ending", FILES)
def test_files_keep_every_bit(two, tmp_path, ending):
    if ending == ".ecsv":
        pytest.importorskip("astropy", reason="ECSV files need astropy")
    path = tmp_path / f"c{ending}"
    for words in (False, ending in (".ecsv", ".npy")):
        rows = two[0]
        if words:
            names = np.array([f"galaxy {k}" for k in range(len(rows))])
            table = {**{name: rows[name] for name in rows.dtype.names}, "id": names}
            rows = shearq.Catalogue.from_table(table)
            rows.attrs = dict(two[0].attrs)
        rows.write(path, overwrite=True)
        back = shearq.read(path)
        assert same_bits(back, rows) and back.dtype == rows.dtype
        assert back.attrs == ({} if ending == ".npy" else rows.attrs)
        assert back.mean_shear() == rows.mean_shear()
    with pytest.raises(FileExistsError, match="overwrite=True"):
        rows.write(path)


def test_tables_of_other_packages_keep_every_bit(two, tmp_path):
    a = two[0]
    for package, make in (("astropy", a.to_astropy), ("pandas", a.to_pandas), ("polars", a.to_polars)):
        pytest.importorskip(package, reason=f"tables of {package} need it")
        back = shearq.Catalogue.from_table(make())
        assert same_bits(back, a) and back.dtype == a.dtype, package
        assert back.attrs == ({} if package == "polars" else a.attrs)
    image = shearq.simulate(grid=8)[0]
    network = shearq.measure(image.stamps, image.psf, noise=image.noise, submission="23/raw/star")
    assert [str(network.to_astropy()[name].unit) for name in ("radius", "size")] == ["pix", "pix2"]
    assert [str(a.to_astropy()[name].unit) for name in ("x", "radius", "size")] == ["pix", "pix", "pix"]
    from astropy.table import Table

    for ending in ("fits", "ecsv"):
        path = tmp_path / f"c.{ending}"
        a.to_astropy().write(path)
        for back in (shearq.read(path), shearq.Catalogue.from_table(Table.read(path))):
            assert same_bits(back, a) and back.attrs == a.attrs, ending


@pytest.mark.parametrize("package", ["astropy", "pandas", "polars"])
def test_packages_that_are_missing_are_named_with_a_remedy(two, package, tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    calls = [getattr(two[0], f"to_{package}")]
    if package == "astropy":
        calls += [
            lambda: two[0].write(tmp_path / "c.ecsv"),
            lambda: shearq.from_meds(tmp_path / "c.meds", coadd="skip"),
            lambda: shearq.from_exposure(str(tmp_path / "c.fits"), [50.0], [50.0]),
        ]
    for call in calls:
        with pytest.raises(ModuleNotFoundError, match=f"needs {package}. Try: pip install {package}"):
            call()


def test_files_of_the_command_line_and_of_python_are_the_same(two, command, tmp_path):
    pandas = pytest.importorskip("pandas", reason="metadata are read by pandas")
    pytest.importorskip("pyarrow", reason="pandas reads Parquet by pyarrow")
    from astropy.table import Table

    command("simulate", "--fixed-psf", "one", "--sets", 8, "--images", 2, "--grid", 8, "--seed", 3, "--out", tmp_path / "data")
    measured = [shearq.measure(image.stamps, image.psf) for image in shearq.simulate(set=8, images=2, grid=8, seed=3)]
    for format in ("parquet", "fits"):
        out = tmp_path / format
        command("measure", "--submission", "48/linear/star", "--data", tmp_path / "data", "--out", out, "--catalogue-format", format)
        for found, own in zip(shearq.read_all(out, sets=8), measured):
            assert same_bits(found[list(own.dtype.names)], own)
            for key in ("submission", "settings", "ellipticity", "version"):
                assert found.attrs[key] == own.attrs[key], (format, key)
            assert found.mean_shear() == own.mean_shear()
        path = out / "set08" / f"catalogue-002.{format}"
        table = Table.read(path)
        assert {key.lower(): value for key, value in table.meta.items()}["submiss"] == "48/linear/star"
        assert shearq.Catalogue.from_table(table).attrs["settings"] == own.attrs["settings"]
    assert pandas.read_parquet(tmp_path / "parquet/set08/catalogue-001.parquet").attrs["image"] == "1"
    with pytest.raises(FileNotFoundError, match="shearq measure"):
        shearq.read_all(tmp_path / "data")
    # The command line scores what Python wrote.
    truth = tmp_path / "data/set08/truth.csv"
    positions = np.loadtxt(truth, delimiter=",", skiprows=1)[:, :2]
    scored = []
    for k, own in enumerate(measured):
        table = {"x": positions[:, 0], "y": positions[:, 1], **own.columns()}
        shearq.Catalogue.from_table(table).write(tmp_path / f"own-{k}.parquet")
    arguments = [tmp_path / "own-0.parquet", tmp_path / "own-1.parquet", "--truth", truth, "--stamp", 48, "--format", "json"]
    scored = json.loads(command("score", *arguments))
    simulation = shearq.simulate(set=8, images=2, grid=8, seed=3)
    joined = shearq.concatenate(measured)
    e1, e2 = (np.stack([own[f"e{k}"] for own in measured]) / joined[f"R{k}{k}"].mean() for k in (1, 2))
    mine = shearq.score(e1, e2, simulation.g1, simulation.g2)
    assert scored["Q"] == pytest.approx(mine["q"], rel=1e-12)


def test_tables_of_other_codes_are_taken_by_their_names():
    table = {"g1_meas": [0.1, np.nan], "g2_meas": [0.2, 0.3], "redshift": [1.0, 2.0]}
    found = shearq.Catalogue.from_table(table, columns={"e1": "g1_meas", "e2": "g2_meas"})
    assert found["flags"].tolist() == [0, shearq.Flag.NotFinite] and found["redshift"].tolist() == [1.0, 2.0]
    assert tuple(found.mean_shear()) == pytest.approx((0.1, 0.2)) and found.mean_shear().response is None
    for wrong, message in (
        ({"e1": [0.1], "x": [1.0]}, "table: no columns e2"),
        ({"e1": [0.1], "e2": [0.1, 0.2]}, "expected columns of one length"),
        ({"e1": [0.1], "e2": [0.1], "R11": [1.0]}, "only one of R11 and R22"),
        ({"e1": [0.1], "e2": [0.1], "R11": [1.0], "R22": [1.0], "divisor1": [0.5], "divisor2": [0.5]}, "an earlier version of shearq"),
        ({"e1": ["a"], "e2": [0.1]}, "expected numbers"),
        ({"e1": [0.1, 0.1, 0.2], "e2": [0.1, -10, -10]}, r"row 1 \(from 0\) has e2 = -10, which stands for a failed.*2 rows"),
    ):
        with pytest.raises(ValueError, match=message):
            shearq.Catalogue.from_table(wrong)
    with pytest.raises(ValueError, match="columns: no g in the table"):
        shearq.Catalogue.from_table(table, columns={"e1": "g"})
    with pytest.raises(TypeError, match="without fields"):
        shearq.Catalogue.from_table(np.zeros(3))


def test_vectors_indices_and_lazy_frames_become_catalogues():
    pandas, polars, pyarrow = (pytest.importorskip(name) for name in ("pandas", "polars", "pyarrow"))
    g, ids = np.array([[0.1, 0.2], [0.3, 0.4]]), [2**60 + 1, 2**60 + 2]
    rows = {"id": ids, "g": g.tolist()}
    structured = np.array(list(zip(ids, g)), dtype=[("id", "i8"), ("g", "f8", 2)])
    tables = [structured, pyarrow.table(rows), polars.DataFrame(rows), polars.LazyFrame(rows)]
    for table in [*tables, pandas.DataFrame(rows), pandas.DataFrame(rows).set_index("id")]:
        found = shearq.Catalogue.from_table(table, columns={"e1": "g[0]", "e2": "g[1]"})
        assert found["e1"].tolist() == [0.1, 0.3] and found["e2"].tolist() == [0.2, 0.4], type(table)
        assert found["id"].tolist() == ids and found["id"].dtype == np.int64, type(table)
    nullable = pandas.DataFrame({"e1": pandas.array([0.1, None], dtype="Float64"), "e2": [0.1, 0.2]})
    assert shearq.Catalogue.from_table(nullable)["flags"].tolist() == [0, shearq.Flag.NotFinite]


def test_damaged_files_raise_and_print_nothing(two, tmp_path, capfd):
    path = tmp_path / "bad.parquet"
    two[0].write(path)
    whole = path.read_bytes()
    raised = 0
    # The header of the first page, where some bytes make polars panic, and every 7th byte of the footer.
    for at in [*range(4, 100), *range(len(whole) - 2000, len(whole) - 8, 7)]:
        damaged = bytearray(whole)
        damaged[at] ^= 0x7F
        path.write_bytes(damaged)
        try:
            shearq.read(path)
        except ValueError as error:
            assert "bad.parquet" in str(error)
            raised += 1
    assert raised > 50
    assert capfd.readouterr().err == ""


def test_wrong_files_are_named(two, tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no file"):
        shearq.read(tmp_path / "none.fits")
    for call in (shearq.read, two[0].write):
        with pytest.raises(ValueError, match="ends in .parquet, .fits, .ecsv or .npy"):
            call(tmp_path / "c.csv")
    (tmp_path / "bad.parquet").write_bytes(b"PAR1")
    with pytest.raises(ValueError, match="bad.parquet"):
        shearq.read(tmp_path / "bad.parquet")
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file: cannot make the folder"):
        two[0].write(tmp_path / "file" / "c.fits")
    large = shearq.Catalogue.from_table({"id": [2**60 + 1], "e1": [0.0], "e2": [0.0]})
    large.write(tmp_path / "large.parquet")
    assert shearq.read(tmp_path / "large.parquet")["id"].tolist() == [2**60 + 1]
    large.write(tmp_path / "large.fits")
    with pytest.raises(ValueError, match="large.fits: table: a number of id is above 2.53"):
        shearq.read(tmp_path / "large.fits")
    named = shearq.Catalogue.from_table({"id": ["a", "b"], "e1": [0.0, 0.1], "e2": [0.0, 0.1]})
    with pytest.raises(ValueError, match="found words in id.*ecsv"):
        named.write(tmp_path / "named.fits")


OPERATIONS = ("slice", "mask", "sort", "concatenate", "pickle", "copy", "astropy", "pandas", "polars", *FILES)


@hypothesis.settings(max_examples=60, deadline=None, suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(strategies.lists(strategies.sampled_from(OPERATIONS), max_size=6), strategies.integers(0, 2**32))
def test_no_sequence_of_operations_changes_the_mean_shear_of_its_rows(two, tmp_path, operations, seed):
    for package in ("astropy", "pandas", "polars"):
        pytest.importorskip(package, reason=f"a sequence may contain tables of {package}")
    rng = np.random.default_rng(seed)
    origin = {int(row["id"]): row for part in two for row in part}
    rows = two[0]
    for operation in operations:
        if operation == "slice":
            first = int(rng.integers(0, len(rows) // 4 + 1))
            rows = rows[first : first + len(rows) * 3 // 4 : int(rng.integers(1, 3))]
        elif operation == "mask":
            rows = rows[rng.random(len(rows)) < 0.8]
        elif operation == "sort":
            rows = rows[np.argsort(rows["flux"])] if seed % 2 else np.sort(rows, order="x")
        elif operation == "concatenate":
            rows = np.concatenate([rows, two[1]])
        elif operation == "pickle":
            rows = pickle.loads(pickle.dumps(rows, protocol=int(rng.integers(2, 6))))
        elif operation == "copy":
            rows = copy.deepcopy(rows)
        elif operation.startswith("."):
            rows.write(tmp_path / f"c{operation}", overwrite=True)
            rows = shearq.read(tmp_path / f"c{operation}")
        else:
            rows = shearq.Catalogue.from_table(getattr(rows, f"to_{operation}")())
        assert type(rows) is shearq.Catalogue
    # The same rows, from the catalogues as they were measured.
    same = np.array([origin[int(number)] for number in rows["id"]], dtype=two[0].dtype)
    assert same_bits(rows, same)
    if not rows.good.any():
        return
    shear = rows.mean_shear()
    # To the rounding of sums of some hundred numbers.
    assert list(shear) == pytest.approx(expected(same), rel=1e-12, abs=1e-15)


def test_results_are_short_to_read(two):
    shear = shearq.MeanShear(0.0201234, -0.1, 0.00094, 0.0123, ((1.0, 0.0), (0.0, 1.0)), None, 12, 3)
    assert str(shear) == "g1 = +0.0201 ± 0.0009, g2 = -0.100 ± 0.012 (12 galaxies, 3 flagged)"
    assert repr(shear) == f"<shearq.MeanShear {shear}>"
    assert str(two[0]) == repr(two[0]) == f"<shearq.Catalogue of 64 galaxies, 1 flagged: {', '.join(two[0].dtype.names)}>"
    page = two[0]._repr_html_()
    assert page.count("<tr>") == 9 and "1 flagged, the first 8 shown" in page and "<th>R11</th>" in page
    assert two[0]._ipython_key_completions_() == list(two[0].dtype.names)


def test_a_catalogue_without_a_good_row_says_so(two):
    a = two[0]
    with pytest.raises(ValueError, match="catalogue: found no galaxies; expected one or more"):
        a[:0].mean_shear()
    with pytest.raises(ValueError, match="catalogue: each of the 1 galaxies has a flag; expected one without"):
        a[~a.good].mean_shear()
    with pytest.raises(ValueError, match="catalogue: no columns R11"):
        a[["e1", "e2", "flags"]].mean_shear()
    wrong = a.copy()
    wrong["e1"][0] = np.nan
    with pytest.raises(ValueError, match="without a flag is not finite"):
        wrong.mean_shear()


def test_flags_are_those_of_the_library():
    from shearq import _shearq

    assert {flag.name: flag.value for flag in shearq.Flag} == {name: bit for name, bit, _ in _shearq.flags()}
    assert str(shearq.Flag(3)) == "Flag.BadPsf|NotFinite" or "NotFinite" in repr(shearq.Flag(3))


def test_blocks_are_measured_like_images(two):
    image = shearq.simulate(set=8, seed=3, grid=12)[0]
    seen = []
    columns = dict(ids=np.arange(144), x=np.arange(144.0), y=np.zeros(144), noise=np.full(144, image.noise))

    class Lazy:
        """A dataset that is read by slices."""

        shape = image.stamps.shape

        def __getitem__(self, part):
            seen.append(part)
            return image.stamps[part]

    blocks = shearq.measure_blocks(Lazy(), image.psf, block=60, **columns)
    assert seen == []
    found = list(blocks)
    assert [len(block) for block in found] == [48, 48, 48] and len(seen) == 3
    for k, block in enumerate(found):
        part = slice(48 * k, 48 * (k + 1))
        own = {name: value[part] for name, value in columns.items()}
        assert same_bits(block, shearq.measure(image.stamps[part], image.psf, **own))
    assert shearq.mean_shear(found).galaxies == 144
    with pytest.raises(ValueError, match="noise: found 3 rows; expected 144"):
        shearq.measure_blocks(image.stamps, image.psf, noise=np.ones(3))
    stamps = image.stamps.copy()
    stamps[72:] = np.nan
    blocks = shearq.measure_blocks(stamps, image.psf, block=72)
    next(blocks)
    with pytest.raises(ValueError, match=r"no galaxy could be measured.* \(stamps 72 to 143\)"):
        next(blocks)


def test_plots_show_what_they_promise(two):
    matplotlib = pytest.importorskip("matplotlib", reason="plots need matplotlib")
    matplotlib.use("Agg")
    from matplotlib import pyplot

    axes = two[0].plot()
    assert axes.get_title() == str(two[0].mean_shear())
    ax = pyplot.subplots()[1]
    assert two[0].plot("map", ax=ax) is ax and ax.get_xlabel() == "x (px)"
    with pytest.raises(ValueError, match="expected columns x and y"):
        two[0][[name for name in two[0].dtype.names if name != "x"]].plot("map")
    simulation = shearq.simulate(set=8, images=2, grid=12)
    e = [np.stack([image.observed[:, k] for image in simulation]) for k in (0, 1)]
    scored = shearq.score(*e, simulation.g1, simulation.g2)
    assert scored.plot().get_xlabel().startswith("ℓ")
    frame = scored.to_frame("list")
    assert [row["metric"] for row in frame] == list(scored.metrics) and frame[0]["value"] == scored["q"]


def test_warnings_point_to_the_line_that_called(image):
    with pytest.warns(shearq.DataWarning) as caught:
        shearq.measure(image.stamps, image.psf, noise=2 * image.noise)
    assert caught[0].filename == __file__ and not str(caught[0].message).lower().startswith("warning")
    script = "import sys, warnings, shearq\nimage = shearq.simulate(grid=8)[0]\nshearq.measure(image.stamps, image.psf, noise=2.0)\n"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "<string>:3: DataWarning: the given noise disagrees" in done.stderr


def _behind(star_seed, images):
    """Catalogues of images whose one star has a S/N of 100."""
    found = []
    for image in images:
        psf = image.psf.astype(float)
        noise = np.sqrt((psf**2).sum()) / 100
        noisy = psf + noise * np.random.default_rng(star_seed).standard_normal(psf.shape)
        found.append(shearq.measure(image.stamps, noisy, noise=image.noise))
    return found


def test_errors_contain_the_noise_of_stars_that_galaxies_share(tmp_path):
    images = shearq.simulate(set=2, images=2, grid=8, seed=6)
    (a, b), (c,) = _behind(1, images), _behind(2, images[1:])
    m, c_noise = a["psf_m"][0], a["psf_c"][0]
    # docs/limitations.md; the noise of the star is known from its border, 170 pixels, to 5 %.
    assert m == pytest.approx(0.023, rel=0.2) and c_noise == pytest.approx(0.012, rel=0.2)
    assert (a["psf_id"] == b["psf_id"][0]).all() and a["psf_id"][0] not in (0.0, c["psf_id"][0])

    def without(rows):
        return rows[[name for name in rows.dtype.names if not name.startswith("psf_")]]

    def more(rows):
        """What the noise of stars adds to the variances."""
        with_stars, plain = rows.mean_shear(), without(rows).mean_shear()
        assert with_stars.g1 == plain.g1 and with_stars.covariance[0][1] == plain.covariance[0][1]
        assert with_stars.g1_error == pytest.approx(np.sqrt(with_stars.covariance[0][0]))
        return [with_stars.covariance[k][k] - plain.covariance[k][k] for k in (0, 1)], plain

    for rows in (a, shearq.concatenate([a, b])):
        added, plain = more(rows)
        for variance, g in zip(added, plain):
            # m·g is a hundredth of it; variances of the shear are a hundred times larger.
            assert variance == pytest.approx((m * g) ** 2 + c_noise**2, rel=1e-9)
    # Of two stars each adds a quarter, by its own noise, up to the responses of their galaxies.
    added, plain = more(shearq.concatenate([a, c]))
    stars = [(rows["psf_m"][0], rows["psf_c"][0]) for rows in (a, c)]
    for variance, g in zip(added, plain):
        expected = sum((m * g) ** 2 + c_noise**2 for m, c_noise in stars) / 4
        assert variance == pytest.approx(expected, rel=0.1)
    both = shearq.mean_shear([a, c])
    assert both.g1_error == shearq.concatenate([a, c]).mean_shear().g1_error
    # A star for each galaxy, and a formula, have no noise that is shared.
    other = shearq.measure(images[0].stamps, np.stack([images[0].psf] * 64), noise=images[0].noise)
    assert (other["psf_m"] == 0).all() and more(shearq.concatenate([other]))[0] == [0.0, 0.0]
    for name in ("a.parquet", "a.fits", "a.npy"):
        path = tmp_path / name
        a.write(path)
        assert same_bits(shearq.read(path)["psf_m"], a["psf_m"])
        assert shearq.read(path).mean_shear().g1_error == a.mean_shear().g1_error


def test_files_of_the_command_line_state_the_noise_of_their_star(tmp_path):
    images = shearq.simulate(set=2, images=1, grid=8, seed=6)
    (catalogue,) = _behind(1, images)
    plain = catalogue[[name for name in catalogue.dtype.names if not name.startswith("psf_")]]
    columns = [(name, np.ascontiguousarray(plain[name], dtype=float)) for name in plain.dtype.names]
    stated = {"psfnoise": "2.30e-2 1.20e-2", "psf": "a fingerprint"}
    for name, metadata in (("a", stated), ("b", {**stated, "psf": "another"}), ("c", stated), ("d", {})):
        shearq._shearq.write_table(str(tmp_path / f"{name}.parquet"), "parquet", columns, metadata)
    a, b, c, d = (shearq.read(tmp_path / f"{name}.parquet") for name in "abcd")
    assert (a["psf_m"] == 0.023).all() and (a["psf_c"] == 0.012).all() and (d["psf_m"] == 0).all()
    assert a["psf_id"][0] == c["psf_id"][0] != b["psf_id"][0] and d["psf_id"][0] == 0
    # One star instead of two of the same effect.
    one, two = (shearq.mean_shear([a, other]).covariance[0][0] for other in (c, b))
    g1 = a.mean_shear().g1
    assert one - two == pytest.approx(((0.023 * g1) ** 2 + 0.012**2) / 2, rel=1e-6)
    for wrong in ("x", "0.1", "nan 0", "-1 5", "inf 0", "0 11", "0  0"):
        shearq._shearq.write_table(str(tmp_path / "e.parquet"), "parquet", columns, {"psfnoise": wrong})
        with pytest.raises(ValueError, match="psfnoise"):
            shearq.read(tmp_path / "e.parquet")


def test_a_star_is_known_again_in_other_cuts(two):
    image = shearq.simulate(set=2, grid=8, seed=6)[0]
    (whole,) = _behind(1, [image])
    cut = {"extends": "48/linear/star", "psf": {"size": 40}}
    noise = np.sqrt((image.psf.astype(float) ** 2).sum()) / 100
    noisy = image.psf + noise * np.random.default_rng(1).standard_normal(image.psf.shape)
    other = shearq.measure(image.stamps, noisy, noise=image.noise, submission=cut)
    assert other["psf_id"][0] == whole["psf_id"][0] != 0
    both = shearq.mean_shear([whole, other])
    plain = shearq.mean_shear([rows[["e1", "e2", "flags", "R11", "R22"]] for rows in (whole, other)])
    c = min(whole["psf_c"][0], other["psf_c"][0])
    assert both.covariance[0][0] - plain.covariance[0][0] > 0.99 * c**2


def test_bias_knows_the_star_of_catalogues_in_memory(tmp_path):
    images = shearq.simulate(set=2, images=2, grid=8, seed=6)
    a, b = _behind(1, images)
    plain = [rows[[name for name in rows.dtype.names if not name.startswith("psf_")]] for rows in (a, b)]
    found, without = (shearq.bias(rows, g1=0.02, g2=0.02) for rows in ([a, b], plain))
    for name, rows in (("a", a), ("b", b)):
        rows.write(tmp_path / f"{name}.parquet")
    files = shearq.bias([tmp_path / "a.parquet", tmp_path / "b.parquet"], g1=0.02, g2=0.02)
    added = found["m1_error"] ** 2 - without["m1_error"] ** 2
    # One shear: c of the star is an error of m, too.
    assert added == pytest.approx(a["psf_m"][0] ** 2 + (a["psf_c"][0] / 0.02) ** 2, rel=1e-6)
    # Files state three digits.
    assert files["m1_error"] == pytest.approx(found["m1_error"], rel=1e-2)


def test_results_become_json_files_and_tables(two, tmp_path):
    mean = two[0].mean_shear()
    found = json.loads(mean.to_json())
    assert found["g1"] == mean.g1 and found["galaxies"] == mean.galaxies and found["made_by"]["version"].split()[0] == shearq.__version__
    assert "Mean shear of" in mean._repr_html_() and f"{mean.g1:+.6f}" in mean._repr_html_()
    simulation = shearq.simulate(set=8, images=2, grid=12)
    e = np.random.default_rng(1).normal(0, 0.1, (2, 2, 144))
    score = shearq.score(e[0], e[1], simulation.g1, simulation.g2)
    found = json.loads(score.to_json())
    # JSON has no NaN.
    expected = {name: None if np.isnan(value) else value for name, value in score.metrics.items()}
    assert found["metrics"] == expected and len(found["spectrum"]["l"]) == 20
    assert "m_cross" in score._repr_html_()
    for result in (mean, score):
        for ending, start in {"json": "{", "csv": "component" if result is mean else "metric", "html": "<!doctype html>"}.items():
            result.save(tmp_path / f"result.{ending}")
            assert (tmp_path / f"result.{ending}").read_text().startswith(start)
        with pytest.raises(ValueError, match="path: found 'result.xyz'; expected a name that ends in .json, .csv, .html"):
            result.save(tmp_path / "result.xyz")
    assert not list(tmp_path.glob(".*"))


def sheared_tables(n=4000):
    """A metacal table and a metadetect table of the same galaxies, with their exact mean shear."""
    rng = np.random.default_rng(5)
    e, response = rng.normal(0, 0.2, (n, 2)) + [0.02, -0.01], rng.normal(0.7, 0.05, (n, 2))
    metacal = {"e1": e[:, 0], "e2": e[:, 1], "flags": np.zeros(n, int), "psf_e1": rng.normal(0.02, 0.01, n), "psf_e2": rng.normal(0, 0.01, n)}
    for k in range(2):
        for other in range(2):
            own = response[:, k] if k == other else 0.0
            for sign, name in ((1, "p"), (-1, "m")):
                metacal[f"e{k + 1}_{other + 1}{name}"] = e[:, k] + sign * 0.01 * own
    steps = {"noshear": e}
    for k in range(2):
        for sign, name in ((1, "p"), (-1, "m")):
            steps[f"{k + 1}{name}"] = e + sign * 0.01 * response * (np.arange(2) == k)
    metadetect = {
        "wmom_g_1": np.concatenate([one[:, 0] for one in steps.values()]),
        "wmom_g_2": np.concatenate([one[:, 1] for one in steps.values()]),
        "mdet_step": np.repeat(list(steps), n),
    }
    return metacal, metadetect, e.mean(axis=0) / response.mean(axis=0)


def test_mean_shear_of_metacal_and_metadetect_tables(command, tmp_path):
    metacal, metadetect, expected = sheared_tables()
    for number, table in enumerate((metacal, metadetect)):
        found = shearq.mean_shear(table)
        assert np.allclose([found.g1, found.g2], expected, rtol=1e-9) and np.allclose(found.response, 0.7, atol=0.01)
        assert found.g1_error == pytest.approx(0.2 / 0.7 / np.sqrt(4000), rel=0.1)
        assert found.galaxies == 4000 and "Try" not in str(found)
        assert found.made_by["columns"]["e1"] == ("e1", "wmom_g_1")[number]
        path = tmp_path / f"{number}.csv"
        np.savetxt(path, np.array(list(table.values())).T, fmt="%s", delimiter=",", header=",".join(table), comments="")
        shown = json.loads(command("mean", path, "--format", "json"))
        (row,) = shown["rows"]
        assert np.allclose([row["g1"], row["g2"], row["g1_error"]], [*expected, found.g1_error], rtol=1e-6)
        # The PSF's ellipticity is not used, by which the estimate would be that of a round PSF.
        assert shown["made_by"]["columns"] == found.made_by["columns"] and "psf_e1" not in found.made_by["columns"]
    with pytest.raises(ValueError, match="weights: found for a table; expected them in a column"):
        shearq.mean_shear(metacal, np.ones(4000))
