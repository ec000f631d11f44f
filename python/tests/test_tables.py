"""Tables of other packages."""

import numpy as np
import pytest

import shearq
from shearq import _tables

RNG = np.random.default_rng(11)
E = RNG.normal(0, 0.2, (500, 2))
COLUMNS = {"e1": E[:, 0] + 0.02, "e2": E[:, 1], "w": RNG.uniform(0.5, 1, 500)}
TRUTH = {"g1": 0.02, "g2": 0.0}


@pytest.fixture(scope="module")
def expected():
    return shearq.bias(COLUMNS, **TRUTH)


def equal(found, expected):
    assert found["m1"] == pytest.approx(expected["m1"], abs=1e-12) and found["m1_error"] == pytest.approx(expected["m1_error"])


def test_streams_and_datasets_of_arrow(expected, tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="needs pyarrow")
    import pyarrow.dataset
    import pyarrow.parquet

    table = pyarrow.table(COLUMNS)
    equal(shearq.bias(table, **TRUTH), expected)
    equal(shearq.bias(pyarrow.RecordBatchReader.from_batches(table.schema, table.to_batches(100)), **TRUTH), expected)
    for k, part in enumerate((table[:200], table[200:])):
        pyarrow.parquet.write_table(part, tmp_path / f"{k}.parquet")
    equal(shearq.bias(pyarrow.dataset.dataset(tmp_path), **TRUTH), expected)


def test_objects_that_make_tables_say_how(tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="needs pyarrow")
    import pyarrow.dataset
    import pyarrow.parquet

    pyarrow.parquet.write_table(pyarrow.table(COLUMNS), tmp_path / "a.parquet")
    wrong = {r"Scanner .* Try: .to_table\(\)": pyarrow.dataset.dataset(tmp_path).scanner(), r"ParquetFile .* Try: .read\(\)": pyarrow.parquet.ParquetFile(tmp_path / "a.parquet")}
    try:
        import duckdb
    except ImportError:
        pass
    else:
        wrong[r"DuckDBPyConnection .* Try: connection.sql\(QUERY\)"] = duckdb.connect().execute("SELECT 1 AS e1, 2 AS e2")
    for message, table in wrong.items():
        with pytest.raises(ValueError, match=f"catalogue 1: found {message}"):
            shearq.bias(table, **TRUTH)


def test_streams_of_arrow_keep_only_needed_columns():
    pyarrow = pytest.importorskip("pyarrow", reason="needs pyarrow")
    rows = 4000
    shapes = {"e1": RNG.normal(0.02, 0.2, rows), "e2": RNG.normal(0, 0.2, rows)}
    batch = pyarrow.record_batch({**shapes, **{f"band{k}": np.zeros(rows) for k in range(64)}})
    reader = pyarrow.RecordBatchReader.from_batches(batch.schema, [batch] * 3)
    table, unread = _tables.narrowed(reader, lambda names: ["e1", "e2"])
    assert table.column_names == ["e1", "e2"] and table.num_rows == 3 * rows and len(unread) == 64


def test_frames_of_polars_and_datasets_read_only_needed_columns(tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="needs pyarrow")
    polars = pytest.importorskip("polars", reason="needs polars")
    import pyarrow.dataset
    import pyarrow.parquet

    table = pyarrow.table({**COLUMNS, "band": np.zeros(500), "name": ["a"] * 500})
    pyarrow.parquet.write_table(table, tmp_path / "0.parquet")
    frame = polars.DataFrame(table.to_pydict())
    dataset = pyarrow.dataset.dataset(tmp_path)
    for one in (table, table.to_batches()[0], dataset, frame, frame.lazy(), polars.scan_parquet(tmp_path / "0.parquet")):
        found, unread = _tables.narrowed(one, lambda names: ["e1", "e2"])
        # Texts are kept: they may name sheared catalogues.
        assert unread == ["w", "band"] and [name for name, _ in _tables.named_columns(found)] == ["e1", "e2", "name"]
        assert len(_tables.named_columns(one)) == 5


def test_relations_of_duckdb(expected):
    duckdb = pytest.importorskip("duckdb", reason="needs duckdb")
    pytest.importorskip("pyarrow", reason="needs pyarrow")
    pandas = pytest.importorskip("pandas", reason="needs pandas")
    frame = pandas.DataFrame(COLUMNS)
    assert len(frame) == 500
    equal(shearq.bias(duckdb.sql("SELECT e1, e2, w FROM frame"), **TRUTH), expected)


def test_hdus_of_astropy(expected):
    fits = pytest.importorskip("astropy.io.fits", reason="needs astropy")
    hdu = fits.BinTableHDU.from_columns([fits.Column(name, "D", array=column) for name, column in COLUMNS.items()])
    equal(shearq.bias(hdu, **TRUTH), expected)
    equal(shearq.bias(hdu.data, **TRUTH), expected)
    equal(shearq.bias(fits.HDUList([fits.PrimaryHDU(), hdu]), **TRUTH), expected)
    with pytest.raises(TypeError, match="an HDUList with 2 tables; expected one"):
        shearq.bias(fits.HDUList([fits.PrimaryHDU(), hdu, hdu.copy()]), **TRUTH)


def test_catalogues_of_galsim_and_treecorr(expected, tmp_path):
    galsim = pytest.importorskip("galsim", reason="needs galsim")
    output = galsim.OutputCatalog(["e1", "e2", "w"], [float, float, float])
    for row in zip(*COLUMNS.values()):
        output.addRow(list(map(float, row)))
    equal(shearq.bias(output, **TRUTH), expected)
    treecorr = pytest.importorskip("treecorr", reason="needs treecorr")
    x, y = RNG.uniform(0, 1, (2, 500))
    catalogue = treecorr.Catalog(x=x, y=y, g1=COLUMNS["e1"], g2=COLUMNS["e2"], w=COLUMNS["w"])
    equal(shearq.bias(catalogue, **TRUTH), expected)


def test_frames_of_dask_say_how(expected):
    pandas = pytest.importorskip("pandas", reason="needs pandas")
    dask = pytest.importorskip("dask.dataframe", reason="needs dask")
    frame = dask.from_pandas(pandas.DataFrame(COLUMNS), npartitions=3)
    with pytest.raises(TypeError, match="a DataFrame of dask in 3 partitions; expected one in memory. Try: parts"):
        shearq.bias(frame, **TRUTH)
    import dask as engine

    parts = engine.compute(*[engine.delayed(shearq.bias_sums)(part, **TRUTH) for part in frame.to_delayed()])
    assert shearq.BiasSums.merge(parts).result()["m1"] == pytest.approx(expected["m1"], abs=1e-12)


def test_tables_that_cannot_be_read_name_a_remedy():
    dask = pytest.importorskip("dask", reason="needs dask")
    pandas = pytest.importorskip("pandas", reason="needs pandas")
    for given in (dask.delayed(COLUMNS), [dask.delayed(COLUMNS)]):
        with pytest.raises(TypeError, match=r"catalogue 1: .* a Delayed\w* of dask; expected a table in memory. Try: table.compute\(\)"):
            shearq.bias(given, **TRUTH)
    frame = pandas.DataFrame({("shape", "e1"): COLUMNS["e1"], ("shape", "e2"): COLUMNS["e2"]})
    with pytest.raises(TypeError, match=r"columns of 2 levels, such as \('shape', 'e1'\); expected names. Try: (.*)") as raised:
        shearq.bias(frame, **TRUTH)
    exec(str(raised.value).split("Try: ")[1], {"frame": frame})
    assert list(frame.columns) == ["shape_e1", "shape_e2"]


def test_the_block_of_dask_runs(tmp_path, capsys):
    pytest.importorskip("dask", reason="needs dask")
    from test_survey import DOCS, blocks

    paths = []
    for k, sign in enumerate((1, -1)):
        rows = zip(E[:, 0] + sign * 0.02, E[:, 1])
        path = tmp_path / f"{k}.csv"
        path.write_text("e1,e2,g1,g2\n" + "".join(f"{a},{b},{sign * 0.02},0\n" for a, b in rows))
        paths.append(str(path))
    (block,) = [one for one in blocks((DOCS / "large-jobs.md").read_text(), "python") if "dask" in one]
    exec(block, {"paths": paths})
    assert "m1" in capsys.readouterr().out
