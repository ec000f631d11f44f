"""The tutorials of the documentation that need GalSim: their commands run, and print what the pages show."""

import runpy
import shlex

import pytest

from test_survey import DOCS, blocks


def words(text):
    """Words with one blank between them, and no rules of tables."""
    return " ".join(word for word in text.split() if word[0] not in "─═")


@pytest.mark.parametrize(("page", "script"), [("tutorial-score.md", "score-hsm.py"), ("own-images.md", "own-images.py")])
def test_a_tutorial_prints_what_its_page_shows(page, script, command, tmp_path, monkeypatch):
    for library in ("galsim", "astropy"):
        pytest.importorskip(library, reason=f"the tutorials need {library}")
    monkeypatch.chdir(tmp_path)
    text = (DOCS / page).read_text()
    (tmp_path / "hsm.toml").write_text(blocks(text, "toml")[0])
    said = ""
    for line in "".join(blocks(text, "sh")).splitlines():
        if line == f"python {script}":
            runpy.run_path(str(DOCS / script))
        else:
            said += command(*shlex.split(line)[1:])
    for line in "".join(blocks(text, "text")).splitlines():
        assert words(line) in words(said), line
