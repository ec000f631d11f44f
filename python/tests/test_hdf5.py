"""Catalogues in HDF5 files, as DES and DESC write them."""

import re
import shlex
import subprocess
import sys

import numpy as np
import pytest

import shearq

h5py = pytest.importorskip("h5py", reason="HDF5 files are read by h5py")


def columns(rng, n, shear, step=(0.0, 0.0), response=0.7):
    e = rng.normal(0, 0.2, (n, 2))
    return {
        "wmom_g_1": e[:, 0] + response * (shear[0] + step[0]),
        "wmom_g_2": e[:, 1] + response * (shear[1] + step[1]),
        "wmom_flags": np.zeros(n, int),
        "wmom_s2n": np.full(n, 50.0),
        "wmom_T_ratio": np.full(n, 2.0),
    }


STEPS = {"ns": (0, 0), "1p": (0.01, 0), "1m": (-0.01, 0), "2p": (0, 0.01), "2m": (0, -0.01)}


def write(path, shear, groups=STEPS, seed=1, inside="shear"):
    with h5py.File(path, "w") as file:
        for name, step in groups.items():
            rng = np.random.default_rng(seed)
            group = file.create_group(f"{inside}/{name}")
            for key, value in columns(rng, 4000, shear, step).items():
                group[key] = value


def test_groups_of_metadetect_are_sheared_catalogues(tmp_path):
    write(tmp_path / "plus.h5", (0.02, 0.0))
    # Known by its first bytes, and one table without a name.
    write(tmp_path / "minus.dat", (-0.02, 0.0))
    paths = [tmp_path / "plus.h5", tmp_path / "minus.dat"]
    found = shearq.bias(paths, g1=[0.02, -0.02], g2=[0, 0])
    # The same shapes under both signs, so that m1 is exact but for their mean in the response.
    assert found["m1"] == pytest.approx(0.0, abs=1e-9)
    named = shearq.bias([f"{path}:shear" for path in paths], g1=[0.02, -0.02], g2=[0, 0])
    assert named["m1"] == found["m1"]
    with h5py.File(paths[0]) as plus, h5py.File(paths[1]) as minus:
        groups = shearq.bias([plus["shear"], minus["shear"]], g1=[0.02, -0.02], g2=[0, 0])
    assert groups["m1"] == found["m1"]


def test_groups_may_repeat_their_step_in_a_column(tmp_path):
    paths = [tmp_path / "plus.h5", tmp_path / "minus.h5"]
    for path, sign in zip(paths, (1, -1)):
        write(path, (0.02 * sign, 0.0))
    plain = shearq.bias(paths, g1=[0.02, -0.02], g2=[0, 0])
    for path in paths:
        with h5py.File(path, "a") as file:
            for name, group in file["shear"].items():
                group["mdet_step"] = np.full(4000, name.encode())
    assert shearq.bias(paths, g1=[0.02, -0.02], g2=[0, 0])["m1"] == plain["m1"]


def test_a_group_is_a_table_of_its_datasets(tmp_path):
    rng = np.random.default_rng(2)
    e = rng.normal(0, 0.2, (1000, 2))
    for name, sign in (("plus", 1), ("minus", -1)):
        with h5py.File(tmp_path / f"{name}.hdf5", "w") as file:
            group = file.create_group("catalog/unsheared")
            group["e_1"], group["e_2"] = e[:, 0] + sign * 0.02 * 0.5, e[:, 1]
            group["R11"], group["R22"] = np.full(1000, 0.5), np.full(1000, 0.5)
            file.create_group("catalog/other")["ra"] = rng.uniform(0, 1, 1000)
    paths = [tmp_path / "plus.hdf5", tmp_path / "minus.hdf5"]
    with pytest.raises(ValueError, match="found 2 tables; expected one. Try: FILE:GROUP with one of catalog/other, catalog/unsheared"):
        shearq.bias(paths, g1=[0.02, -0.02], g2=[0, 0])
    named = {"e1": "e_1", "e2": "e_2"}
    found = shearq.bias([f"{path}:catalog/unsheared" for path in paths], g1=[0.02, -0.02], g2=[0, 0], columns=named)
    assert found["m1"] == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(ValueError, match="has no group catalog/sheared_1p"):
        shearq.bias(f"{paths[0]}:catalog/sheared_1p", g1=0.02, g2=0)


def test_groups_are_listed_beside_datasets_that_are_no_columns(tmp_path):
    with h5py.File(tmp_path / "mixed.h5", "w") as file:
        file["image"] = np.zeros((30, 30))
        file["catalog/e1"] = file["catalog/e2"] = np.zeros(30)
        for source in (file, tmp_path / "mixed.h5"):
            file.flush()
            with pytest.raises(ValueError, match="has no datasets; expected columns of a table. Try: FILE:GROUP with one of catalog"):
                shearq.bias(source, g1=0, g2=0)


def test_rows_with_fields_are_tables(tmp_path):
    path = tmp_path / "rows.h5"
    rng = np.random.default_rng(3)
    rows = np.zeros(1000, dtype=[("e", float, (2,)), ("w", float), ("name", "S4")])
    rows["e"], rows["w"] = rng.normal(0, 0.2, (1000, 2)), rng.uniform(0.5, 1, 1000)
    columns = {"e1": "e[0]", "e2": "e[1]"}
    with h5py.File(path, "w") as file:
        file["tables/shapes"] = rows
        # What astropy writes beside its tables.
        file["tables/shapes.__table_column_meta__"] = np.array([b"datatype:"])
    expected = shearq.bias(rows, g1=0.0, g2=0.0, columns=columns)
    with h5py.File(path) as file:
        for given in (path, f"{path}:tables/shapes", file["tables/shapes"], [file["tables/shapes"]]):
            assert shearq.bias(given, g1=0.0, g2=0.0, columns=columns)["c1"] == expected["c1"]


def test_sheared_catalogues_may_be_rows_with_fields(tmp_path):
    write(tmp_path / "groups.h5", (0.02, 0.0))
    with h5py.File(tmp_path / "groups.h5") as groups, h5py.File(tmp_path / "rows.h5", "w") as file:
        for name, group in groups["shear"].items():
            rows = np.zeros(4000, dtype=[(key, value.dtype) for key, value in group.items()])
            for key, value in group.items():
                rows[key] = value[:]
            file[f"shear/{name}"] = rows
    found, expected = (shearq.bias(tmp_path / name, g1=0.02, g2=0.0) for name in ("rows.h5", "groups.h5"))
    assert found["m1"] == expected["m1"]


def test_layouts_without_columns_name_a_remedy(tmp_path):
    path = tmp_path / "other.h5"
    with h5py.File(path, "w") as file:
        file["image"] = np.zeros((300, 300, 2))
        file.create_group("frame").attrs["pandas_type"] = "frame"
    with pytest.raises(ValueError, match="image: is one dataset without names of columns; expected a group"):
        shearq.bias(f"{path}:image", g1=0.0, g2=0.0)
    with pytest.raises(ValueError, match="frame: is a table of pandas, .* Try: pandas.read_hdf"):
        shearq.bias(f"{path}:frame", g1=0.0, g2=0.0)


def test_columns_of_unlike_lengths_are_refused(tmp_path):
    with h5py.File(tmp_path / "odd.h5", "w") as file:
        file["e1"], file["e2"] = np.zeros(3), np.zeros(4)
    with pytest.raises(ValueError, match="odd.h5: e2 has 4 rows and e1 3; expected one length"):
        shearq.bias(tmp_path / "odd.h5", g1=0.02, g2=0)


def test_the_lines_that_the_shell_names_work(tmp_path, command):
    pytest.importorskip("pyarrow", reason="needs pyarrow")
    pytest.importorskip("pandas", reason="needs pandas")
    write(tmp_path / "plus.h5", (0.02, 0.0))
    said = command("bias", tmp_path / "plus.h5", "--g1", 0.02, "--g2", 0, status=1, stream="stderr")
    of_bias, of_tables = re.findall(r"python3 -c '([^']+)'", said)

    def run(line, *arguments):
        return subprocess.run([sys.executable, "-c", line, *map(str, arguments)], capture_output=True, text=True, check=True).stdout

    assert "m1" in run(of_bias, f"{tmp_path}/plus.h5:shear", 0.02, 0.0)
    table = tmp_path / "table.parquet"
    run(of_tables, tmp_path / "plus.h5", "shear/ns", table)
    assert "m1" in command("bias", table, *shlex.split("--g1 0.02 --g2 0 --columns e1=wmom_g_1,e2=wmom_g_2"))
