"""How-to pages for extensions: their commands, executed in order."""

import re
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from typed_page import Reader, Typed, read_steps

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "how-to"
PIP = ROOT / "tests" / "support" / "built_pip.py"
NAMES = [
    "a-plate-for-a-weekend",
    "add-a-content-format",
    "add-a-material",
    "add-a-touch-source",
    "add-an-effect",
    "bring-your-own-method",
    "drive-a-signal-generator",
    "design-a-layout",
    "play-content",
    "your-own-application",
]
WITH_CONFORMANCE = ["write-an-amplifier"]
"""It runs the whole of it."""
SHORT = {"add-a-material", "bring-your-own-method"}
"""Executed by every run of the tests; the others by `make test-long`."""


@pytest.fixture
def reader(tmp_path: Path, installed: Path) -> Iterator[Reader]:
    """A reader in a checkout with examples and firmware alone; `pip` installs prebuilt packages."""
    home = Path(tempfile.mkdtemp(prefix="era"))
    folder, site, programs = tmp_path / "checkout", home / "site", home / "bin"
    folder.mkdir()
    programs.mkdir()
    for part in ("examples", "firmware"):
        shutil.copytree(ROOT / part, folder / part)
    pip = programs / "pip"
    words = [sys.executable, str(PIP), str(installed), str(site)]
    pip.write_text(f'#!/bin/sh\nexec {shlex.join(words)} "$@"\n', encoding="utf-8")
    pip.chmod(0o755)
    with Reader(folder, home=home, programs=programs, site=site) as made:
        yield made
    shutil.rmtree(home)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in SHORT else [pytest.mark.long, pytest.mark.alone])
        for name in [*NAMES, *WITH_CONFORMANCE]
    ],
)
def test_page_commands_print_what_is_shown(name: str, reader: Reader) -> None:
    """Commands, run in order, print the output on the page."""
    steps = read_steps(PAGES / f"{name}.md")
    assert sum(isinstance(step, Typed) and step.shown is not None for step in steps) >= 2
    for step in steps:
        reader.follow(step)


@pytest.mark.parametrize("name", [*NAMES, *WITH_CONFORMANCE])
def test_page_includes_code_from_files(name: str) -> None:
    """Page and file cannot differ."""
    text = (PAGES / f"{name}.md").read_text("utf-8")
    included = re.findall(r"^```\{literalinclude\} (\S+)$", text, re.MULTILINE)
    assert included
    assert [path for path in included if not (PAGES / path).is_file()] == []
    assert "```python" not in text
