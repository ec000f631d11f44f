"""The package as such: its help, its types, its documents and its examples."""

import ast
import doctest
import inspect
import pathlib
import pydoc
import re
import subprocess
import sys

import pytest

import shearq

ROOT = pathlib.Path(__file__).parents[1]
PUBLIC = [name for name in vars(shearq) if not name.startswith("_") and not inspect.ismodule(getattr(shearq, name))]


def test_help_of_the_package_fits_a_screen():
    text = pydoc.plain(pydoc.render_doc(shearq))
    assert len(text.splitlines()) <= 60
    for name in PUBLIC:
        assert re.search(rf"\b{name}\b", shearq.__doc__), name


@pytest.mark.parametrize("name", [name for name in PUBLIC if getattr(getattr(shearq, name), "__doc__", None)])
def test_examples_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    finder, runner = doctest.DocTestFinder(), doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    for test in finder.find(getattr(shearq, name), name, globs={"shearq": shearq}):
        assert runner.run(test).failed == 0


def test_the_page_of_the_api_is_current():
    done = subprocess.run([sys.executable, ROOT / "api.py", "--check"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_examples_and_package_have_no_errors_of_types(tmp_path):
    pytest.importorskip("mypy", reason="types are checked by mypy")
    # mypy takes files or a package, not both.
    for checked in (["-p", "shearq"], sorted((ROOT / "examples").glob("*.py"))):
        arguments = ["--strict", "--cache-dir", tmp_path, *checked]
        done = subprocess.run([sys.executable, "-m", "mypy", *map(str, arguments)], capture_output=True, text=True, check=False, cwd=ROOT)
        assert done.returncode == 0, done.stdout + done.stderr


def test_stub_of_the_extension_module_has_its_signatures(tmp_path):
    pytest.importorskip("mypy", reason="stubs are checked by mypy")
    # The list of all names, which the stub does not repeat.
    (tmp_path / "allowed").write_text("shearq._shearq.__all__\n")
    options = ["--ignore-disjoint-bases", "--allowlist", "allowed", "--mypy-config-file", str(ROOT / "pyproject.toml")]
    command = [sys.executable, "-m", "mypy.stubtest", *options, "shearq._shearq"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("script", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_scripts_of_the_gallery_end_in_a_plot(script, tmp_path):
    needed = {"galsim": "galsim_stamps", "distributed": "dask_images", "matplotlib": ""}
    for package, part in needed.items():
        if part in script.stem:
            pytest.importorskip(package, reason=f"{script.name} needs {package}")
    arguments = [sys.executable, script, "--quick", "--out", tmp_path / "plot.png"]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False, cwd=tmp_path, timeout=300)
    assert done.returncode == 0 and "Warning" not in done.stderr, done.stderr
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")


def test_modules_import_each_other_in_one_direction():
    folder = pathlib.Path(shearq.__file__).parent
    needs = {}
    for path in folder.glob("*.py"):
        if path.stem in ("__init__", "__main__"):
            continue
        names = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.level == 1:
                names |= {node.module} if node.module else {alias.name for alias in node.names}
        needs[path.stem] = names
    while needs:
        free = {name for name, others in needs.items() if not others & needs.keys()}
        assert free, f"these modules import each other in a circle: {sorted(needs)}"
        needs = {name: others for name, others in needs.items() if name not in free}
