"""The how-to pages for extensions, typed in order, and what plug-ins import."""

import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from packages import PACKAGES
from processes.typed_page import Reader, read_steps

ROOT = Path(__file__).parents[2]
PLUGINS = ROOT / "examples" / "plugins"


MODULES = sorted(PLUGINS.glob("*/*.py"))


@pytest.mark.parametrize("path", MODULES, ids=[path.stem for path in MODULES])
def test_example_plugin_imports_stable_names_only(path: Path) -> None:
    """Of this project plug-ins import `era_haptics` only."""
    imported = re.findall(r"^\s*(?:from|import) ([\w.]+)", path.read_text("utf-8"), re.MULTILINE)
    homes = {name.partition(".")[0] for name in imported}
    assert homes & (set(PACKAGES) - {"era_haptics"}) == set()


PAGES = ROOT / "docs" / "how-to"
PIP = ROOT / "tests" / "examples" / "built_pip.py"
NAMES = [
    "a-plate-for-a-weekend",
    "bring-your-own-method",
    "drive-a-signal-generator",
    "design-a-layout",
    "play-content",
    "plug-ins",
    "your-own-application",
]
WITH_CONFORMANCE = ["write-an-amplifier"]
"""It runs the whole of it."""
WITHOUT_CODE = ["design-a-plate", "measure-your-plate"]
"""Commands alone, without a file of the examples."""
SHORT = "plug-ins"
"""Executed by every run of the tests; the others by `make test-long`, and when they change."""


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all example plug-ins, built by pip without a package index."""
    target = tmp_path_factory.mktemp("site")
    options = ["--no-deps", "--no-build-isolation", "--disable-pip-version-check", "--quiet"]
    subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, "--target", target]
        + [str(path.parent) for path in PLUGINS.glob("*/pyproject.toml")],
        check=True,
    )
    return target


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == SHORT else [pytest.mark.long, pytest.mark.alone])
        for name in [*NAMES, *WITH_CONFORMANCE, *WITHOUT_CODE]
    ],
)
def test_page_commands_print_what_is_shown(name: str, tmp_path: Path, installed: Path) -> None:
    """Commands, run in order, print the output on the page.

    In a checkout with examples and firmware alone; `pip` installs prebuilt packages.
    """
    steps, folder = read_steps(PAGES / f"{name}.md"), tmp_path / "checkout"
    assert any(step.shown is not None for step in steps)
    for part in ("examples", "firmware"):
        shutil.copytree(ROOT / part, folder / part)
    with tempfile.TemporaryDirectory(prefix="era") as short:
        home = Path(short)
        site, programs = home / "site", home / "bin"
        programs.mkdir()
        words = [sys.executable, str(PIP), str(installed), str(site)]
        pip = programs / "pip"
        pip.write_text(f'#!/bin/sh\nexec {shlex.join(words)} "$@"\n', "utf-8")
        pip.chmod(0o755)
        with Reader(folder, home=home, programs=programs, site=site) as reader:
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
