"""m and c from tables of other packages: the numbers of the command line."""

import json
import pickle

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


def test_measured_catalogues_are_calibrated_by_their_divisors(image):
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
        ({"bins": "snr"}, "bins: found 'snr'"),
        ({"bins": ("snr", [3, 2])}, "increasing edges"),
        ({"bins": ("size", 3)}, "there is no column `size`"),
        ({"select": "snr >"}, "select: "),
        ({"design": "pair"}, "design: found \"pair\""),
        ({"columns": {"e1": "shape"}}, "there is no column `shape`"),
        ({"columns": {"e9": "shape"}}, "unknown role"),
        ({"ellipticity": "e"}, "ellipticity: found 'e'"),
        ({"truth": "absent.csv"}, "expected one of them"),
        ({"flip_g2": True}, "follows minus the true g2"),
    ],
)
def test_what_cannot_be_estimated_is_named(pair, change, message):
    options = {"g1": [0.02, -0.02], "g2": [0.01, -0.01], **change}
    with pytest.raises(ValueError, match=message):
        shearq.bias(pair, **options)


def test_odd_tables_are_refused():
    table = catalogue((0.02, 0.01))
    with pytest.raises(ValueError, match="without columns of numbers"):
        shearq.bias({"name": [["a"]]}, g1=0, g2=0)
    with pytest.raises(ValueError, match="found none"):
        shearq.bias([], g1=0, g2=0)
    with pytest.raises(FileNotFoundError, match="absent.fits"):
        shearq.bias("absent.fits", g1=0, g2=0)
    table["e1"] = np.ma.masked_array(table["e1"], mask=table["id"] == 5)
    with pytest.raises(ValueError, match="row 6: e1 is NaN"):
        shearq.bias(table, g1=0.02, g2=0.01)
    assert shearq.bias(table, g1=0.02, g2=0.01, drop_missing=True)["n"] == 1999


def test_results_are_shown(pair):
    found = shearq.bias(pair, g1=[0.02, -0.02], g2=[0.01, -0.01], bins=("snr", 3))
    assert "Shear bias" in str(found) and repr(found).startswith("<shearq.Bias m1 = +0.0")
    assert found._repr_html_().count("<tr>") == 5 and list(found.to_frame()["n"]) == [row["n"] for row in found.rows]
    pytest.importorskip("matplotlib").use("Agg")
    ax = found.plot()
    assert ax.get_xlabel() == "snr" and ax.get_ylabel().endswith("bias m")
    ax.figure.canvas.draw()
    # A number per bin, and the labels inside of the figure.
    places = ax.containers[0].lines[0].get_xdata()
    assert len(places) == 3 and (np.diff(places) > 0).all() and places[0] > 5
    assert ax.get_tightbbox().x0 >= 0 and shearq.bias(pair, g1=[0.02, -0.02], g2=[0.01, -0.01]).plot().get_xlabel() == "all galaxies"
    with pytest.raises(ValueError, match="expected 'm' or 'c'"):
        found.plot("q")
