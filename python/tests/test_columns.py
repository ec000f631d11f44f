"""Columns of any shape, formulas, signs and long integers: m and c of numpy, or a message."""

import numpy as np
import pytest

import shearq

G = (0.02, 0.01)
SHEARS = {"g1": [G[0], -G[0]], "g2": [G[1], -G[1]]}
STEPS = {"noshear": (0, 0), "1p": (0.01, 0), "1m": (-0.01, 0), "2p": (0, 0.01), "2m": (0, -0.01)}
N = 2000
RNG = np.random.default_rng(3)
SHAPES = RNG.normal(0, 0.2, (2, N))
WEIGHT = RNG.uniform(0.5, 1.5, N)
BAD = np.arange(N) % 7 == 0
BOTH = (1, -1)


def shapes(sign, response=np.eye(2), shift=0.0):
    return SHAPES + (response @ np.array(G) * sign)[:, None] + shift


def table(sign, **more):
    e = shapes(sign)
    return {"id": np.arange(N), "e1": e[0], "e2": e[1], **more}


def tables(**more):
    return [table(sign, **more) for sign in BOTH]


def m(found):
    return [found["m1"], found["m2"]]


def test_columns_of_any_shape_are_read_or_refused():
    expected = shearq.bias(tables(w=WEIGHT, flag=BAD * 1, R11=np.full(N, 0.9), R22=np.full(N, 0.9)), **SHEARS)
    assert expected["n"] == 2 * (~BAD).sum()
    assert abs(expected["m1"] - (1 / 0.9 - 1)) < 0.02
    matrix = np.tile(0.9 * np.eye(2), (N, 1, 1))
    for more, columns in [
        ({"w": WEIGHT[:, None], "flag": BAD[:, None] * 1, "R11": 0.9, "R22": 0.9}, {}),
        ({"w": [[one] for one in WEIGHT], "flag": BAD, "R": matrix}, {}),
    ]:
        assert m(shearq.bias(tables(**more), columns=columns, **SHEARS)) == pytest.approx(m(expected), abs=1e-12)
    # What has no role is listed.
    found = shearq.bias(tables(stamps=np.zeros((N, 8, 8)), R=matrix[:, 0]), **SHEARS)
    notes = " ".join(found.notes)
    assert "not known: stamps" in notes and "Not used: R[0]" in notes
    for more, message in [
        ({"flags": np.zeros((N, 9))}, r"catalogue 1: column `flags` has the shape \(2000, 9\).* Try: .*flag=none"),
        ({"w": WEIGHT + 0j}, "column `w` has values of type complex128"),
        ({"R11": np.full(N, np.timedelta64(1)), "R22": np.ones(N)}, "column `R11` has values of type timedelta64"),
        ({"w": np.array([1.0, "a"] * (N // 2), dtype=object)}, "column `w` has values of type float, str"),
        ({"my_weight": [[1.0], [1.0, 2.0]] * (N // 2)}, "column `my_weight` has .*different shapes"),
    ]:
        if "my_weight" in more:
            lists = np.empty(N, dtype=object)
            lists[:] = more["my_weight"]
            more = {"my_weight": lists}
        with pytest.raises(ValueError, match=message):
            shearq.bias(tables(**more), **SHEARS)
        with pytest.raises(ValueError, match=message.replace("catalogue 1: ", "")):
            shearq.galaxies(table(1, x=np.arange(N), y=np.arange(N), **more))
    # A true shear of all rows.
    constant = [table(sign, g1=sign * G[0], g2=sign * G[1], none=None) for sign in BOTH]
    assert m(shearq.bias(constant)) == m(shearq.bias(tables(), **SHEARS))


def test_columns_of_some_groups_are_refused(tmp_path):
    h5py = pytest.importorskip("h5py", reason="HDF5 files are read by h5py")
    paths = []
    for sign in BOTH:
        paths.append(tmp_path / f"{sign}.h5")
        with h5py.File(paths[-1], "w") as file:
            for name, step in STEPS.items():
                e = shapes(sign) + np.array(step)[:, None]
                for key, values in {"e_1": e[0], "e_2": e[1]}.items():
                    file[f"cat/{name}/{key}"] = values
    expected = shearq.bias(paths, **SHEARS)
    for key, role in [("flags", "flag"), ("weight", "w"), ("flags_select", "flag")]:
        for path in paths:
            with h5py.File(path, "a") as file:
                file[f"cat/noshear/{key}"] = BAD * 1
        with pytest.raises(ValueError, match=f"column `{key}` is not in the groups of 1p, 1m, 2p, 2m .*{role}=none"):
            shearq.bias(paths, **SHEARS)
        assert shearq.bias(paths, columns={role: "none"}, **SHEARS).rows == expected.rows
        for path in paths:
            with h5py.File(path, "a") as file:
                del file[f"cat/noshear/{key}"]


def mean(signed, choice, weight):
    """m of metacal columns: the response of shapes and of the choice and weights, by numpy."""
    found = []
    for own in signed:
        def of(k, step, chosen="noshear"):
            return np.average(own[f"e{k + 1}_{step}"][choice(own, chosen)], weights=weight(own, chosen)[choice(own, chosen)])

        response = [
            [
                (of(k, f"{j}p") - of(k, f"{j}m") + of(k, "noshear", f"{j}p") - of(k, "noshear", f"{j}m")) / 0.02
                for j in (1, 2)
            ]
            for k in (0, 1)
        ]
        found.append(np.linalg.solve(response, [of(k, "noshear") for k in (0, 1)]))
    return (found[0] - found[1]) / 2 / np.array(G) - 1


def metacal():
    found = []
    base = 20 * np.exp(0.3 * np.random.default_rng(4).normal(size=N))
    for sign in BOTH:
        own = {"id": np.arange(N)}
        for name, step in STEPS.items():
            e = shapes(sign) + np.array([[0.8, 0.03], [0.05, 0.75]]) @ np.array(step)[:, None]
            own[f"e1_{name}"], own[f"e2_{name}"] = e
            own[f"s2n_{name}"] = base * (1 - (e**2).sum(0))
        found.append(own)
    return found


def named(own):
    return {name.replace("_noshear", ""): values for name, values in own.items()}


def test_formulas_of_weights_and_flags_have_a_selection_response():
    signed = metacal()
    all_rows = lambda own, step: np.ones(N, bool)
    equal = lambda own, step: np.ones(N)
    for columns, choice, weight in [
        ({"w": "s2n^2"}, all_rows, lambda own, step: own[f"s2n_{step}"] ** 2),
        ({"w": "1/(0.07 + e1^2 + e2^2)"}, all_rows, lambda own, step: 1 / (0.07 + own[f"e1_{step}"] ** 2 + own[f"e2_{step}"] ** 2)),
        ({"flag": "s2n < 18"}, lambda own, step: own[f"s2n_{step}"] >= 18, equal),
    ]:
        found = shearq.bias(list(map(named, signed)), columns=columns, **SHEARS)
        # Each catalogue has its own response here, and shearq has one of both.
        assert m(found) == pytest.approx(mean(signed, choice, weight), abs=5e-3), columns
        assert any("Selection response: from" in note for note in found.notes)
        unused = any("Not used" in note and "s2n" in note for note in found.notes)
        assert unused == ("s2n" not in str(columns)), found.notes
    # With responses of galaxies, sheared columns of a cut give its response, too.
    rows = [{"e1": own["e1_noshear"], "e2": own["e2_noshear"], "R11": 0.8, "R22": 0.75, **{f"snr_{step}": own[f"s2n_{step}"] for step in STEPS if step != "noshear"}, "snr": own["s2n_noshear"]} for own in signed]
    by_flag = shearq.bias(rows, columns={"flag": "snr < 18"}, **SHEARS)
    assert m(by_flag) == pytest.approx(m(shearq.bias(rows, where="snr >= 18", **SHEARS)), abs=1e-12)


def conjugate(own):
    """The same in a frame with the other sign of e2 and g2."""
    other = {"1p": "1p", "1m": "1m", "2p": "2m", "2m": "2p", "noshear": "noshear"}
    found = {"id": own["id"]}
    for step, name in other.items():
        found[f"e1_{name}"], found[f"e2_{name}"] = own[f"e1_{step}"], -own[f"e2_{step}"]
        found[f"s2n_{name}"] = own[f"s2n_{step}"]
    return found


def test_responses_follow_the_sign_of_e2():
    signed = metacal()
    turned = list(map(conjugate, signed))
    signs = {"e1": "e1_noshear", "e2": "-e2_noshear"}
    for options in ({}, {"where": "s2n > 18"}):
        expected = shearq.bias(signed, **options, **SHEARS)
        found = shearq.bias(turned, columns=signs, **options, **SHEARS)
        assert m(found) == pytest.approx(m(expected), abs=1e-12)
        assert any("the artificial shear of 2p and 2m" in note for note in found.notes)
    # Rows of sheared catalogues.
    def rows(own):
        parts = [{"e1": own[f"e1_{step}"], "e2": own[f"e2_{step}"], "version": [step] * N} for step in STEPS]
        return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}

    expected = shearq.bias(list(map(rows, signed)), **SHEARS)
    found = shearq.bias(list(map(rows, turned)), columns={"e2": "-e2"}, **SHEARS)
    assert m(found) == pytest.approx(m(expected), abs=1e-12)
    # Responses of galaxies; a formula is taken as it is.
    response = {"R11": 0.8, "R12": 0.03, "R21": 0.05, "R22": 0.75}
    matrix = np.array([[0.8, 0.03], [0.05, 0.75]])
    def plain(sign, e2, cross):
        e = shapes(sign, matrix)
        return {"e1": e[0], "e2": e2 * e[1], **response, "R12": cross * 0.03, "R21": cross * 0.05}

    expected = m(shearq.bias([plain(sign, 1, 1) for sign in BOTH], **SHEARS))
    given = [plain(sign, -1, -1) for sign in BOTH]
    for columns, tables in [({}, given), ({"R12": "R12", "R21": "R21"}, given), ({"R12": "1*R12", "R21": "1*R21"}, [plain(sign, -1, 1) for sign in BOTH])]:
        found = shearq.bias(tables, columns={"e2": "-e2", **columns}, **SHEARS)
        assert m(found) == pytest.approx(expected, abs=1e-12)


FIRST = 37_484_563_299_062_823


def test_long_integers_are_compared_and_binned_as_integers():
    ids = FIRST + np.arange(N)
    given = tables(object_id=ids, sky_tile=300_000_000_000_000_000 + np.arange(N) % 3)
    for text, kept in [("object_id < {}", 100), ("object_id <= {}", 101), ("{} == object_id", 1), ("object_id != {}", N - 1)]:
        found = shearq.bias(given, where=text.format(FIRST + 100), unsheared="object_id", drop_missing=True, **SHEARS) if kept > 1 else None
        if found is not None:
            assert found["n"] == 2 * kept, text
    bins = shearq.bias(given, bins="sky_tile", unsheared="sky_tile", **SHEARS).rows
    assert [row["bin"] for row in bins[1:]] == [f"sky_tile 30000000000000000{k}" for k in range(3)]
    assert sum(row["n"] for row in bins[1:]) == 2 * N
    for options in ({"where": "object_id > sky_tile"}, {"bins": ("object_id", 4)}):
        with pytest.raises(ValueError, match="column `object_id` has integers of 2⁵³ or more"):
            shearq.bias(given, **options, **SHEARS)


def test_numbers_stand_for_columns_of_responses():
    expected = m(shearq.bias(tables(R11=0.9, R22=0.8), **SHEARS))
    assert m(shearq.bias(tables(), columns={"R11": "0.9", "R22": "0.8"}, **SHEARS)) == expected
    both = m(shearq.bias(tables(), columns={"R11": "0.9", "R22": "0.9"}, **SHEARS))
    assert both[0] == expected[0]
    with pytest.raises(ValueError, match="no column `3`"):
        shearq.bias(tables(), columns={"e1": "3"}, **SHEARS)


def test_formulas_of_presets_ignore_case(tmp_path):
    preset = tmp_path / "own.toml"
    preset.write_text('[[survey]]\nname = "Own"\n[survey.columns]\ne1 = "g_1"\ne2 = "-g_2"\nflag = "fl & 4"\n')
    e = [shapes(sign) for sign in BOTH]
    given = [{"G_1": own[0] + BAD, "G_2": -own[1], "FL": BAD * 4 + 2} for own in e]
    found = shearq.bias(given, preset=preset, **SHEARS)
    assert found["n"] == 2 * (~BAD).sum()
    expected = shearq.bias([{"e1": own[0], "e2": own[1], "flag": BAD * 1} for own in e], **SHEARS)
    assert m(found) == pytest.approx(m(expected), abs=1e-12)


def test_texts_of_numbers_are_bins_and_lists_of_one_are_named(tmp_path):
    polars = pytest.importorskip("polars", reason="writes the files")
    paths = []
    for sign in BOTH:
        paths.append(tmp_path / f"{sign}.parquet")
        polars.DataFrame(table(sign, tile=np.where(BAD, "10", "9"))).write_parquet(paths[-1])
    for given in (paths, [polars.read_parquet(path) for path in paths]):
        bins = shearq.bias(given, bins="tile", unsheared="tile", **SHEARS).rows
        assert {row["bin"]: row["n"] for row in bins[1:]} == {"tile 10": 2 * BAD.sum(), "tile 9": 2 * (~BAD).sum()}
    truth = tmp_path / "truth.csv"
    lines = [f"{path},{sign * G[0]},{sign * G[1]}" for path, sign in zip(paths, BOTH)]
    truth.write_text("\n".join(["catalogue,g1,g2", *lines]))
    assert m(shearq.bias(paths, truth=truth)) == m(shearq.bias(paths, **SHEARS))
    lists = polars.DataFrame(table(1)).with_columns(w=polars.Series([[one] for one in WEIGHT]))
    lists.write_parquet(tmp_path / "lists.parquet")
    with pytest.raises(ValueError, match="column `w`: found a vector of 1 numbers.*Try: a column of numbers") as raised:
        shearq.bias(tmp_path / "lists.parquet", g1=0.02, g2=0)
    assert "damaged" not in str(raised.value)
