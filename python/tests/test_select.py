"""Selections of galaxies keep the mean shear calibrated, and agree with the command line."""

import json

import numpy as np
import pytest

import shearq


@pytest.fixture(scope="module")
def galaxies():
    image = shearq.simulate(set=2, seed=3, grid=12)[0]
    return shearq.measure(image.stamps, image.psf)


def test_a_selection_of_all_changes_nothing_but_rounding(galaxies):
    plain, all_of_them = galaxies.mean_shear(), galaxies.mean_shear(where="step(snr, -1e6)")
    assert all_of_them.galaxies == plain.galaxies
    # Sums of doubles in another order.
    assert np.allclose([all_of_them.g1, all_of_them.g2], [plain.g1, plain.g2], rtol=0, atol=1e-14)


def test_a_selection_has_weights_and_another_response(galaxies):
    middle = np.median(galaxies["size"])
    chosen = galaxies.select(where=f"step(size, {middle})", weight="snr^2/(snr^2 + 100)")
    # The step reaches 0.3 px below the median.
    assert len(chosen) == np.count_nonzero(galaxies["size"] > middle - 0.3) < len(galaxies)
    sure = galaxies[galaxies["size"] > middle + 0.3]
    assert set(sure["size"]) <= set(chosen["size"])
    assert not np.allclose(chosen["R11"], galaxies[np.isin(galaxies["size"], chosen["size"])]["R11"])
    with pytest.raises(ValueError, match="linear configuration"):
        chosen.select(where="step(snr, 3)")


def test_the_command_line_finds_the_same_shear(galaxies, command, tmp_path):
    command("simulate", "--sets", "2", "--images", "1", "--grid", "12", "--seed", "3", "--out", tmp_path / "data")
    command("measure", "--submission", "48/linear/star", "--data", tmp_path / "data", "--out", tmp_path / "out")
    where = f"step(size, {np.median(galaxies['size'])})"
    printed = command("mean", "--measured", tmp_path / "out", "--where", where, "--format", "json")
    row = json.loads(printed)["rows"][0]
    mean = shearq.read(tmp_path / "out/set02/catalogue-001.parquet").mean_shear(where=where)
    assert (mean.galaxies, mean.g1, mean.g2) == (row["galaxies"], pytest.approx(row["g1"], rel=1e-9), pytest.approx(row["g2"], rel=1e-9))


def test_bias_selects_as_the_command_line_does(command, tmp_path):
    shear = ("--constant-shear", "0.02,0.02", "--opposite")
    size = ("--sets", "2", "--images", "1", "--grid", "40", "--seed", "5")
    command("simulate", *size, *shear, "--out", tmp_path / "data")
    folders = []
    for sign in "+-":
        data, out = tmp_path / "data" / f"g1_{sign}0.02_g2_{sign}0.02", tmp_path / f"out{sign}"
        command("measure", "--submission", "48/linear/star", "--data", data, "--out", out)
        folders.append(out)
    where = "step(snr, 15) and step(size, 2)"
    row = json.loads(command("bias", *folders, "--where", where, "--format", "json"))["rows"][0]
    found = shearq.bias(folders, where=where)
    assert (found["m1"], found["m2"]) == (pytest.approx(row["m1"], rel=1e-9), pytest.approx(row["m2"], rel=1e-9))
    # Selected rows find the same galaxy under the other shear, although rows are left out.
    catalogues = [shearq.read(out / "set02/catalogue-001.parquet") for out in folders]
    chosen = [catalogue.select(where) for catalogue in catalogues]
    assert [len(catalogue) for catalogue in chosen] != [1600, 1600]
    again = shearq.bias(chosen, g1=[0.02, -0.02], g2=[0.02, -0.02])
    # A jackknife of 800 pairs knows the error to 3 %; the mean response is that of each catalogue here.
    assert again["m1_error"] == pytest.approx(found["m1_error"], rel=0.1)
    assert again["m1"] == pytest.approx(found["m1"], abs=0.1 * found["m1_error"])
    # What was measured changes with shear: another m, and a note that says why.
    other = shearq.bias(folders, where="snr > 15 and size > 2")
    assert other["m1"] + other["m2"] < found["m1"] + found["m2"] - 0.1
    assert any("effect of shear on a selection" in note for note in other.notes)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"where": "step(R11, 0.3)"}, "response to shear is not known"),
        ({"where": "snr > 10"}, "is a condition"),
        ({"where": "step(snr, 1e9)"}, "no galaxy is left"),
        ({"weight": "abs(snr)"}, "not smooth"),
        ({"weight": "e1"}, "cannot depend"),
    ],
)
def test_selections_that_cannot_be_corrected_are_refused(galaxies, options, reason):
    with pytest.raises(ValueError, match=reason):
        galaxies.mean_shear(**options)
