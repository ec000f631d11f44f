"""m and c from tables of other packages: the numbers of the command line."""

import json
import pathlib
import pickle
import shutil
import sys

import numpy as np
import pytest

import shearq

pandas = pytest.importorskip("pandas")
polars = pytest.importorskip("polars")
pyarrow = pytest.importorskip("pyarrow")
Table = pytest.importorskip("astropy.table").Table

M, C = (0.02, -0.03), (1e-3, -2e-3)


def catalogue(g, seed=1, n=2000, scatter=0.1):
    """The same galaxies under a shear, with a response of 0.8."""
    random = np.random.default_rng(seed)
    e = random.normal(0, scatter, (2, n))
    response = 0.8 + 0.1 * random.normal(size=(2, n))
    table = {"id": np.arange(n), "w": random.uniform(0.5, 1.5, n), "snr": random.uniform(5, 50, n)}
    for k in (0, 1):
        table[f"e{k + 1}"] = e[k] + 0.8 * ((1 + M[k]) * g[k] + C[k])
        table[f"R{k + 1}{k + 1}"] = response[k]
    return table


@pytest.fixture(scope="module")
def pair():
    return [catalogue((0.02, 0.01)), catalogue((-0.02, -0.01))]


def test_tables_of_all_packages_and_the_command_line_agree(pair, tmp_path, command):
    shears = {"g1": [0.02, -0.02], "g2": [0.01, -0.01], "bins": ("snr", [5, 20, 50])}
    expected = shearq.bias(pair, **shears)
    assert len(expected.rows) == 3 and "pairs" in expected.notes[0]
    # The scatter of the responses is all that pairs leave.
    assert abs(expected["m1"] - M[0]) < 5 * expected["m1_error"] < 0.05
    assert abs(expected["m2"] - M[1]) < 5 * expected["m2_error"]
    for kind in (
        Table,
        pandas.DataFrame,
        polars.DataFrame,
        pyarrow.table,
        pyarrow.RecordBatch.from_pydict,
        lambda table: np.rec.fromarrays(list(table.values()), names=list(table)),
    ):
        assert shearq.bias([kind(table) for table in pair], **shears).rows == expected.rows
    paths = []
    for name, table in zip(("plus", "minus"), pair):
        paths.append(tmp_path / f"{name}.parquet")
        polars.DataFrame(table).write_parquet(paths[-1])
    truth = tmp_path / "shears.csv"
    truth.write_text("catalogue,g1,g2\nplus.parquet,0.02,0.01\nminus.parquet,-0.02,-0.01\n")
    shown = json.loads(command("bias", *paths, "--truth", truth, "--bins", "snr:5,20,50", "--format", "json"))
    assert shown["rows"] == expected.rows
    assert shearq.bias(paths, **shears).rows == expected.rows


def same(found, expected):
    """Sums of other parts have other rounding errors: 10⁻¹⁶ times the number of additions, 4000."""
    assert found.notes[0] == expected.notes[0]
    for own, row in zip(found.rows, expected.rows):
        assert own.keys() == row.keys()
        for key, value in row.items():
            assert own[key] == (pytest.approx(value, rel=1e-11) if isinstance(value, float) else value), key


def test_sums_add_up_and_travel(pair):
    whole = shearq.bias(pair, g1=[0.02, -0.02], g2=[0.01, -0.01])
    parts = [shearq.bias_sums(table, g1=s * 0.02, g2=s * 0.01) for table, s in zip(pair, (1, -1))]
    found = sum(pickle.loads(pickle.dumps(part)) for part in parts).result()
    same(found, whole)
    same(shearq.BiasSums.merge(parts).result(), whole)
    with pytest.raises(ValueError, match="different options"):
        parts[0] + shearq.bias_sums(pair[1], g1=0.02, g2=0, bins=("snr", [5, 50]))


def add(table, sign):
    """For a worker."""
    return shearq.bias_sums(table, g1=sign * 0.02, g2=sign * 0.01)


def test_workers_of_dask_sum_their_own_catalogues(pair):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        with distributed.Client(cluster) as client:
            found = sum(client.gather(client.map(add, pair, [1, -1]))).result()
    same(found, shearq.bias(pair, g1=[0.02, -0.02], g2=[0.01, -0.01]))


def test_measured_catalogues_are_calibrated_by_their_responses(image):
    measured = shearq.measure(image.stamps, image.psf)
    for part in (measured, measured[20:90]):
        found, mean = shearq.bias(part, g1=0.0, g2=0.0), part.mean_shear()
        # c of unsheared galaxies is the mean shear, also of a part, whose mean response is another.
        assert found["c1"] == pytest.approx(mean.g1, rel=1e-9) and found["c2"] == pytest.approx(mean.g2, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"g1": None}, "expected both or none"),
        ({"g1": 2.0}, "modulus below 1"),
        ({"g1": [0.1, 0.2, 0.3]}, "one per catalogue"),
        ({"bins": "snr"}, "`snr` has more than 400 different values"),
        ({"bins": [3]}, "bins: found"),
        ({"bins": ("snr", [3, 2])}, "increasing edges"),
        ({"bins": ("size", 3)}, "there is no column `size`"),
        ({"where": "snr >"}, "cannot read the expression"),
        ({"where": "snr > 20", "unsheared": "z"}, "unsheared: `z` is not used"),
        ({"design": "pair"}, "design: found \"pair\""),
        ({"columns": {"e1": "shape"}}, "there is no column `shape`"),
        ({"columns": {"e9": "shape"}}, "unknown role"),
        ({"ellipticity": "e"}, 'ellipticity: found "e"'),
        ({"columns": {"e1": "g1", "e2": "g2"}}, "there is no column `g1`"),
        ({"truth": "absent.csv"}, "expected one of them"),
        ({"truth_sign": "challenge"}, "follows minus the true g2"),
    ],
)
def test_what_cannot_be_estimated_is_named(pair, change, message):
    options = {"g1": [0.02, -0.02], "g2": [0.01, -0.01], **change}
    with pytest.raises(ValueError, match=message):
        shearq.bias(pair, **options)


@pytest.mark.parametrize("options", [{"where": "snr > 20"}, {"bins": ("snr", 2)}])
def test_choices_by_unsheared_columns_have_no_warning(pair, options):
    options = {"g1": [0.02, -0.02], "g2": [0.01, -0.01], **options}
    measured, unsheared = shearq.bias(pair, **options), shearq.bias(pair, unsheared="snr", **options)
    assert any("selection by `snr`" in note for note in measured.notes)
    assert not any("selection by `snr`" in note for note in unsheared.notes)
    assert unsheared.rows == measured.rows and shearq.bias(pair, unsheared=["snr"], **options).notes == unsheared.notes


def test_odd_tables_are_refused():
    table = catalogue((0.02, 0.01))
    with pytest.raises(ValueError, match="there are no columns of ellipticities"):
        shearq.bias({"name": [["a"]]}, g1=0, g2=0)
    with pytest.raises(ValueError, match="found none"):
        shearq.bias([], g1=0, g2=0)
    with pytest.raises(ValueError, match="parts: found none; expected the sums of one or more catalogues"):
        shearq.BiasSums.merge([])
    with pytest.raises(ValueError, match=r"catalogue 1: found an array of shape \(9, 2\) .* Try: {'e1': array\[:, 0\]"):
        shearq.bias(np.zeros((9, 2)), g1=0, g2=0)
    with pytest.raises(ValueError, match=r"catalogue 1: found a dict of one row .* Try: pandas.DataFrame\(rows\)"):
        shearq.bias([{"e1": 0.1, "e2": 0.2}, {"e1": 0.1, "e2": 0.1}], g1=0, g2=0)
    twice = pandas.DataFrame(np.zeros((9, 3)), columns=["e1", "e2", "e1"])
    for function in (shearq.Catalogue.from_table, lambda table: shearq.bias(table, g1=0, g2=0)):
        with pytest.raises(ValueError, match="column e1 is there several times"):
            function(twice)
    with pytest.raises(FileNotFoundError, match="absent.fits"):
        shearq.bias("absent.fits", g1=0, g2=0)
    table["e1"] = np.ma.masked_array(table["e1"], mask=table["id"] == 5)
    with pytest.raises(ValueError, match="row 6: e1 is NaN"):
        shearq.bias(table, g1=0.02, g2=0.01)
    assert shearq.bias(table, g1=0.02, g2=0.01, drop_missing=True)["n"] == 1999


def vectors(table):
    """The ellipticities as one column of vectors of two."""
    rest = {name: column for name, column in table.items() if name not in ("e1", "e2")}
    return {**rest, "g": np.stack([table["e1"], table["e2"]], axis=1)}


def test_vectors_of_two_are_ellipticities_in_any_table(pair):
    shears = {"g1": [0.02, -0.02], "g2": [0.01, -0.01]}
    expected = shearq.bias(pair, **shears).rows

    def structured(table):
        kinds = [(name, column.dtype, column.shape[1:]) for name, column in table.items()]
        found = np.empty(len(table["id"]), dtype=kinds)
        for name, column in table.items():
            found[name] = column
        return found

    def with_list(make):
        return lambda table: make({**table, "g": table["g"].tolist()})

    def fixed(table):
        flat = pyarrow.array(table["g"].ravel())
        return pyarrow.table({**table, "g": pyarrow.FixedSizeListArray.from_arrays(flat, 2)})

    lists = (pandas.DataFrame, polars.DataFrame, polars.LazyFrame, pyarrow.table, pyarrow.RecordBatch.from_pydict)
    for make in (dict, Table, lambda t: Table(t, masked=True), structured, polars.DataFrame, fixed, *map(with_list, lists)):
        tables = [make(vectors(table)) for table in pair]
        assert shearq.bias(tables, **shears).rows == expected, make
        assert shearq.bias(tables, columns={"e1": "g[0]", "e2": "g[1]"}, **shears).rows == expected, make
    renamed = [{("v" if name == "g" else name): column for name, column in vectors(table).items()} for table in pair]
    assert shearq.bias(renamed, columns={"e1": "v[0]", "e2": "v[1]"}, **shears).rows == expected


LONG = 10**18


@pytest.mark.parametrize("first", [LONG, 2**63], ids=["int64", "uint64"])
def test_long_identifiers_and_texts_are_units(first):
    # Ten rows for each of 200 galaxies that share their noise: merged galaxies would make the errors too small.
    random = np.random.default_rng(5)
    own = np.repeat(np.arange(200), 10)
    e = random.normal(0, 0.1, (2, 200))[:, own]
    table = {"e1": e[0] + 0.02, "e2": e[1] + 0.01}

    def error(units, make=dict):
        found = shearq.bias(make({**table, "unit": units}), g1=0.02, g2=0.01, units="unit")
        # Units in another order have other rounding errors, 10⁻¹⁶ times the number of additions.
        return found.rows[0]["units"], pytest.approx(found["m1_error"], rel=1e-12)

    expected = error(own)
    assert expected == (200, pytest.approx(0.1 / np.sqrt(200) / 0.02, rel=0.2))
    expected = (200, expected[1].expected)
    long = np.array([first + int(k) for k in own], dtype=np.int64 if first < 2**63 else np.uint64)
    for make in (dict, Table, pandas.DataFrame, polars.DataFrame, polars.LazyFrame, pyarrow.table):
        assert error(long, make) == expected, make
    masked = np.ma.masked_array(long, mask=np.zeros(len(long), dtype=bool))
    assert error(masked) == error(masked, Table) == expected
    nullable = "Int64" if first < 2**63 else "UInt64"
    assert error(pandas.array(long, dtype=nullable), pandas.DataFrame) == expected
    names = np.array([f"tile {k}" for k in own])
    latin = np.array([b"\xe9 %d" % k for k in own])
    for texts in (names, names.astype("S"), latin, names.astype(object), np.ma.masked_array(names, mask=False)):
        assert error(texts) == expected
    for make in (Table, pandas.DataFrame, polars.DataFrame, pyarrow.table):
        assert error(names, make) == expected
    assert error(pandas.array(names, dtype="string"), pandas.DataFrame) == error(pandas.Categorical(names), pandas.DataFrame) == expected


def test_missing_values_of_all_packages_do_not_count(pair):
    table = pair[0]
    shear = {"g1": 0.02, "g2": 0.01}
    gone = table["id"] == 5
    values = [None if missing else value for missing, value in zip(gone, table["e1"].tolist())]
    # Integers with missing ones must not become floats, which merge the other identifiers.
    long = [None if missing else LONG + k for k, missing in enumerate(gone)]
    for make in (
        polars.DataFrame,
        pyarrow.table,
        lambda columns: pandas.DataFrame({**columns, "e1": pandas.array(columns["e1"], dtype="Float64"), "id": pandas.array(long, dtype="Int64")}),
    ):
        odd = make({**table, "e1": values, "id": long})
        with pytest.raises(ValueError, match="row 6: e1 is NaN.*Try: drop_missing=True"):
            shearq.bias(odd, **shear)
        found = shearq.bias(odd, drop_missing=True, **shear)
        assert found["n"] == found["units"] == 1999
        assert "Left out: 1 rows with missing numbers." in found.notes


def test_an_index_with_a_name_is_a_column():
    table = {**catalogue((0.02, 0.01)), "g1": np.full(2000, 0.02), "g2": np.full(2000, 0.01)}
    expected = shearq.bias(table, units="id").rows
    frame = pandas.DataFrame(table)
    for indexed in (frame.set_index("id"), frame.set_index(["id", "w"]), frame.set_index("id", drop=False)):
        assert shearq.bias(indexed, units="id").rows == expected


def test_masked_true_shears_are_refused():
    table = {**catalogue((0.02, 0.01)), "g2": np.full(2000, 0.01)}
    masked = np.ma.masked_array(np.full(2000, 0.02), mask=np.arange(2000) == 7)
    with pytest.raises(ValueError, match=r"row 8: this is no shear \(found g1 NaN"):
        shearq.bias(Table({**table, "g1": masked}))
    with pytest.raises(ValueError, match="found masked values"):
        shearq.bias([table, table], g1=masked[7:9], g2=[0.01, 0.01])


@pytest.mark.parametrize("column, value", [("e1", -10.0), ("e2", -99.0), ("e1", 1e30), ("R11", -9999.0), ("w", 1e30)])
def test_failure_values_are_refused_or_dropped_and_counted(column, value):
    table = catalogue((0.02, 0.01))
    shears = {"g1": 0.02, "g2": 0.01}
    wrong = {**table, column: np.where(np.isin(table["id"], (5, 9)), value, table[column])}
    with pytest.raises(ValueError, match=f"row 6: column `{column}` is .* failed measurement .*Try: drop_missing=True"):
        shearq.bias(wrong, **shears)
    found = shearq.bias(wrong, drop_missing=True, **shears)
    good = {name: values[~np.isin(table["id"], (5, 9))] for name, values in table.items()}
    expected = shearq.bias(good, **shears)
    same_values = {key: value for key, value in found.rows[0].items() if key != "bin"}
    assert same_values == {key: expected.rows[0][key] for key in same_values}
    assert "Left out: 2 rows with numbers that stand for failed measurements." in found.notes


def test_a_column_has_one_role():
    table = {**catalogue((0.02, 0.01)), "g1": np.full(2000, 0.02), "g2": np.full(2000, 0.01)}
    with pytest.raises(ValueError, match="`g1`") as raised:
        shearq.bias(table, columns={"e1": "g1", "e2": "g2"})
    assert "--" not in str(raised.value)


def test_the_response_is_a_matrix_and_the_mean_shear_agrees():
    # (ΣwR)⁻¹Σwe, solved by numpy; with R11 and R22 alone, the true m of 0 would be 0.1/0.8 = 0.125.
    random = np.random.default_rng(8)
    w = random.uniform(0.5, 1.5, 2000)
    matrix = np.array([[0.8, 0.1], [0.1, 0.7]]) + 0.05 * random.normal(size=(2000, 2, 2))
    e = matrix @ [0.02, 0.02] + random.normal(0, 1e-4, (2000, 2))
    shear = np.linalg.solve(np.einsum("i,ijk->jk", w, matrix), w @ e)
    table = {"e1": e[:, 0], "e2": e[:, 1], "w": w, "a": matrix[:, 0, 1], "b": matrix[:, 1, 0]}
    table |= {"R11": matrix[:, 0, 0], "R22": matrix[:, 1, 1]}
    found = shearq.bias(table, g1=0.0, g2=0.0, columns={"R12": "a", "R21": "b"})
    # Sums of 2000 numbers in another order.
    assert [found["c1"], found["c2"]] == pytest.approx(shear.tolist(), rel=1e-11)
    known = shearq.bias(table, g1=0.02, g2=0.02, columns={"R12": "a", "R21": "b"})
    assert abs(known["m1"]) < 1e-3 and shearq.bias(table, g1=0.02, g2=0.02, columns={"R12": "none", "R21": "none"})["m1"] > 0.1
    own = {"R12": table["a"], "R21": table["b"], "flags": np.zeros(2000)}
    rows = shearq.Catalogue.from_table({**{name: table[name] for name in ("e1", "e2", "R11", "R22")}, **own})
    assert list(rows.mean_shear(w)) == pytest.approx(shear.tolist(), rel=1e-12)


@pytest.mark.parametrize("role", ["rms_e", "sigma_e"])
def test_responsivity_uses_its_columns(role):
    # Mandelbaum et al. 2018, equation 10: ⟨χ⟩/2ℛ with ℛ = 1 − ⟨w e_rms²⟩/⟨w⟩ and e_rms² = ⟨χ²⟩/2 without the noise.
    random = np.random.default_rng(2)
    w, scatter = random.uniform(0.5, 1.5, 4000), random.uniform(0.3, 0.4, 4000)
    e = random.normal(0.02, 0.1, (2, 4000))
    table = {"e1": e[0], "e2": e[1], "w": w, "scatter": scatter}
    found = shearq.bias(table, g1=0.0, g2=0.0, ellipticity="responsivity", columns={role: "scatter"})
    squares = scatter**2 if role == "rms_e" else (e**2).sum(axis=0) / 2 - scatter**2
    expected = e @ w / (2 * (w @ (1 - squares)))
    # Sums of 4000 numbers in another order.
    assert [found["c1"], found["c2"]] == pytest.approx(expected.tolist(), rel=1e-11)
    assert any("scatter" in note and "ℛ" in note for note in found.notes)


def test_integers_above_those_of_floats_are_flags_and_weights(pair):
    n = len(pair[0]["e1"])
    bad = np.arange(n) % 10 == 0
    shears = {"g1": [0.02, -0.02], "g2": [0.01, -0.01]}
    good = [{name: column[~bad] for name, column in table.items()} for table in pair]
    for kind in (np.int64, np.uint64):
        bits = (np.arange(n) % 2).astype(kind) << kind(60) | (5 * bad).astype(kind)
        flagged = [{**table, "bits": bits} for table in pair]
        found = shearq.bias(flagged, columns={"flag": "bits & 4"}, **shears)
        assert found.rows == shearq.bias(good, **shears).rows
        # All odd rows have a bit.
        assert shearq.bias(flagged, columns={"flag": "bits"}, **shears)["n"] == 0.8 * n
    weights = [{**table, "w": np.full(n, 2**60 + 1)} for table in pair]
    equal = [{**table, "w": np.ones(n)} for table in pair]
    assert shearq.bias(weights, **shears)["m1"] == pytest.approx(shearq.bias(equal, **shears)["m1"], abs=1e-9)


def test_rows_without_an_identifier_or_a_flag_are_left_out(pair, tmp_path):
    n, paths = len(pair[0]["e1"]), []
    for k, table in enumerate(pair):
        ids = [None if number < 10 else number for number in range(n)]
        flags = [None if 20 <= number < 30 else 0 for number in range(n)]
        paths.append(tmp_path / f"{k}.parquet")
        polars.DataFrame({**table, "id": ids, "flag": flags}).write_parquet(paths[-1])
    shears = {"g1": [0.02, -0.02], "g2": [0.01, -0.01]}
    with pytest.raises(ValueError, match=f"no identity in 10 of {n} rows; expected one in each. Try: drop_missing"):
        shearq.bias(paths, **shears)
    assert shearq.bias(paths, drop_missing=True, **shears)["n"] == 2 * (n - 20)


def test_sums_of_other_surveys_do_not_add_up(pair):
    def sums(table, g, low):
        survey = {"snr": np.linspace(low, 50, 500)}
        return shearq.bias_sums(table, g1=g, g2=g / 2, bins=("snr", [5, 20, 50.1]), like=survey)

    both = sums(pair[0], 0.02, 5) + sums(pair[1], -0.02, 5)
    assert len(both.result().rows) == 2
    with pytest.raises(ValueError, match="different surveys of like"):
        sums(pair[0], 0.02, 5) + sums(pair[1], -0.02, 25)


def test_results_are_shown(pair):
    found = shearq.bias(pair, g1=[0.02, -0.02], g2=[0.01, -0.01], bins=("snr", 3))
    assert "Shear bias" in str(found) and repr(found).startswith("<shearq.Bias m1 = +0.0")
    assert found._repr_html_().count("<tr>") == 5 and list(found.to_frame()["n"]) == [row["n"] for row in found.rows]
    pytest.importorskip("matplotlib").use("Agg")
    ax = found.plot()
    assert ax.get_xlabel() == "snr" and ax.get_ylabel() == "m"
    ax.figure.canvas.draw()
    # A number per bin, and the labels inside of the figure.
    places = ax.containers[0].lines[0].get_xdata()
    assert len(places) == 3 and (np.diff(places) > 0).all() and places[0] > 5
    assert ax.get_tightbbox().x0 >= 0 and shearq.bias(pair, g1=[0.02, -0.02], g2=[0.01, -0.01]).plot().get_xlabel() == "all galaxies"
    with pytest.raises(ValueError, match="expected 'm' or 'c'"):
        found.plot("q")


def test_the_sign_of_g2_in_a_table_is_stated_significant_or_refused(tmp_path):
    random = np.random.default_rng(4)
    g = random.normal(0, 0.03, (2, 400))
    truth = tmp_path / "truth.csv"

    def bias(noise, comment="", **options):
        # The table has the challenge's sign.
        rows = "".join(f"{k},{a},{-b}\n" for k, (a, b) in enumerate(g.T))
        truth.write_text(f"id,g1,g2\n{comment}{rows}")
        e = g + random.normal(0, noise, g.shape)
        return shearq.bias({"id": np.arange(400.0), "e1": e[0], "e2": e[1]}, truth=truth, **options)

    for noise, comment, options, why in (
        (0.01, "", {}, "challenge, which e2 of the catalogues follows"),
        (0.3, "", {"truth_sign": "challenge"}, "challenge, as specified"),
        (0.3, "# g2sign: challenge\n", {}, "challenge, as the file states"),
    ):
        assert any(why in note for note in bias(noise, comment, **options).notes), why
    with pytest.raises(ValueError, match='cannot determine the sign of g2.*Try: truth_sign="standard"'):
        bias(0.3)
    with pytest.raises(ValueError, match="truth_sign: \"other\""):
        bias(0.3, truth_sign="other")


def test_columns_that_are_not_needed_are_not_read():
    rng = np.random.default_rng(1)
    columns = {name: rng.normal(0, 0.2, 100) for name in ("e1", "e2", "my_weight_2", "snr", "mag", "peso")}
    columns["my_weight_2"] = np.abs(columns["my_weight_2"]) + 0.1

    class Group(dict):
        """Like a group of h5py, which notes what is read."""

        attrs: dict = {}
        read: set = set()

        def visititems(self, _):
            return None

    class Dataset:
        ndim = 1
        shape = (100,)
        dtype = np.dtype("f8")

        def __init__(self, name):
            self.name = name

        def __len__(self):
            return 100

        def __getitem__(self, _):
            Group.read.add(self.name)
            return columns[self.name]

    group = Group({name: Dataset(name) for name in columns})
    found = shearq.bias(group, columns={"w": "my_weight_2"}, where="snr > -1")
    assert Group.read == {"e1", "e2", "my_weight_2", "snr"}
    assert any("not known: peso" in note for note in found.notes)
    own = shearq.bias(columns, columns={"w": "my_weight_2"}, where="snr > -1")
    assert (found.rows, found.notes) == (own.rows, own.notes)


def test_surveys_of_the_user_are_recognised(tmp_path):
    preset = tmp_path / "own.toml"
    preset.write_text('[[survey]]\nname = "Own"\n[survey.columns]\ne1 = "a"\ne2 = "b"\n')
    rng = np.random.default_rng(1)
    table = {"a": rng.normal(0, 0.2, 100), "b": rng.normal(0, 0.2, 100)}
    assert any("Columns: Own" in note for note in shearq.bias(table, preset=preset).notes)


def test_results_are_compared_and_saved_as_by_the_command_line(pair, tmp_path, command):
    shears = {"g1": [0.02, -0.02], "g2": [0.01, -0.01]}
    other = [{**table, "e1": 1.01 * table["e1"]} for table in pair]
    found = shearq.bias(pair, against=other, **shears)
    paths = []
    for name, table in zip(("plus", "minus", "plus-other", "minus-other"), [*pair, *other]):
        paths.append(tmp_path / f"{name}.parquet")
        polars.DataFrame(table).write_parquet(paths[-1])
    truth = tmp_path / "shears.csv"
    truth.write_text("catalogue,g1,g2\n" + "".join(f"{path.name},{g},{g / 2}\n" for path, g in zip(paths, [0.02, -0.02] * 2)))
    shown = json.loads(command("bias", *paths[:2], "--against", *paths[2:], "--truth", truth, "--format", "json"))
    assert [row["of"] for row in found.rows] == ["catalogues", "against", "difference"]
    assert [row["m1"] for row in found.rows] == [row["m1"] for row in shown["rows"]]
    assert found.rows[2]["m1_error"] < 0.1 * found.rows[0]["m1_error"]
    # Origin: the fingerprints of the files that were read.
    inputs = shown["made_by"]["inputs"]
    assert set(inputs) == {str(path) for path in [*paths, truth]} and "--against" in shown["made_by"]["command"]
    of_files = shearq.bias(paths[:2], truth=truth)
    settings = shown["made_by"]["settings"]
    assert settings["against"] == [str(path) for path in paths[2:]] and settings["format"] == "json" and "quiet" not in settings
    assert shown["made_by"]["columns"] == of_files.made_by["columns"] and of_files.made_by["columns"]["e1"] == "e1"
    assert shown["made_by"]["version"] == of_files.made_by["version"]
    assert of_files.made_by["inputs"] == {str(path): inputs[str(path)] for path in [*paths[:2], truth]}
    assert of_files.made_by["settings"]["truth"] == str(truth) and shown["made_by"]["version"].split()[0] == shearq.__version__
    paths[0].write_bytes(paths[1].read_bytes())
    with pytest.raises(ValueError):
        shearq.bias(paths[:2], truth=truth)
    assert shearq.bias_sums(paths[0], g1=0.02, g2=0.01)._made_by["inputs"][str(paths[0])] == inputs[str(paths[1])]
    for result in (found, of_files, pickle.loads(pickle.dumps(found))):
        assert json.loads(result.to_json())["rows"] == result.rows
        assert "Shear bias" in result._repr_html_() and "±" in result._repr_html_()
    for ending, start in {"json": "{", "csv": "of,", "html": "<!DOCTYPE html>", "svg": "<svg", "md": "Shear bias"}.items():
        path = tmp_path / f"result.{ending}"
        found.save(path)
        assert path.read_text().startswith(start), path.read_text()[:40]
    assert "shearq.bias" in (tmp_path / "result.html").read_text()
    with pytest.raises(ValueError, match="expected a name that ends in .json, .html"):
        found.save(tmp_path / "result.xyz")


def test_sums_of_a_part_are_small(pair):
    # A unit for each of 9 tiles, as a worker returns them for its file.
    table = {**pair[0], "tile": np.arange(2000) % 9}
    sums = shearq.bias_sums(table, g1=0.02, g2=0.01, units="tile")
    assert len(pickle.dumps(sums)) < 10_000


def test_workers_of_spark_return_sums(monkeypatch, tmp_path):
    pyspark = pytest.importorskip("pyspark", reason="pyspark is not installed")
    if shutil.which("java") is None:
        pytest.skip("Spark needs Java")
    paths = []
    for number, g in enumerate((0.02, -0.02, 0.02, -0.02)):
        table = {**catalogue((g, g / 2), seed=number // 2), "g1": np.full(2000, g), "g2": np.full(2000, g / 2)}
        table["id"] = table["id"] + 2000 * (number // 2)
        paths.append(str(tmp_path / f"{number}.parquet"))
        polars.DataFrame(table).write_parquet(paths[-1])
    # Sums of one pass differ in their last digits.
    expected = shearq.BiasSums.merge([shearq.bias_sums(path) for path in paths]).result()
    # The workers are of the interpreter that has the package.
    monkeypatch.setenv("PYSPARK_PYTHON", sys.executable)
    settings = pyspark.SparkConf().setMaster("local[2]").set("spark.ui.enabled", "false").set("spark.driver.host", "127.0.0.1")
    with pyspark.SparkContext(conf=settings) as context:
        parts = context.parallelize(paths, 4).map(shearq.bias_sums).collect()
    assert shearq.BiasSums.merge(parts).result().rows == expected.rows


LAYOUTS = pathlib.Path(__file__).parents[2] / "tests/data/layouts"
VALUES = json.loads((LAYOUTS / "layouts.json").read_text())


@pytest.mark.parametrize("name", VALUES)
@pytest.mark.parametrize("read", [lambda path: path, pandas.read_csv], ids=["file", "frame"])
def test_layouts_of_surveys_have_the_values_of_numpy(name, read):
    expected = VALUES[name]
    columns = dict(text.split("=", 1) for text in expected["given"])
    found = shearq.bias(read(LAYOUTS / f"{name}.csv"), columns=columns)
    for key in ("m1", "m2", "c1", "c2"):
        # The files have ten digits, and responses are differences over 0.02.
        assert found[key] == pytest.approx(expected[key], abs=1e-8), key
    assert found["n"] == expected["galaxies"]
