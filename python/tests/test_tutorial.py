"""Tutorials of the documentation: their commands run, and print what the pages show."""

import runpy
import shlex
from pathlib import Path

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
    follow(page, command, script)


def test_the_page_of_great3_shows_what_its_commands_print(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    follow("great3.md", command)


def follow(page, command, script=None):
    """Runs the commands of a page in the working folder and compares what they print."""
    text = (DOCS / page).read_text()
    for settings in blocks(text, "toml")[:1]:
        Path("hsm.toml").write_text(settings)
    said = ""
    for line in "".join(blocks(text, "sh")).splitlines():
        if line == f"python {script}":
            runpy.run_path(str(DOCS / script))
        else:
            said += command(*shlex.split(line)[1:])
    for line in "".join(blocks(text, "text")).splitlines():
        assert words(line) in words(said), line
