"""What plug-ins import: complete, documented, and no more loaded than the kind needs."""

import ast
import re
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

import era_haptics.plugins

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "plugins.md").read_text("utf-8")
PACKAGE = Path(era_haptics.plugins.__file__).parent
KINDS = sorted(path.stem for path in PACKAGE.glob("[!_]*.py"))


def test_each_kind_is_named_as_its_entry_points() -> None:
    """What `examples/plugins` registers under `era_haptics.X` is written with the names of `X`."""
    groups = {
        group.removeprefix("era_haptics.")
        for path in (ROOT / "examples" / "plugins").glob("*/pyproject.toml")
        for group in tomllib.loads(path.read_text("utf-8"))["project"]["entry-points"]
    }
    assert groups == set(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_every_name_is_there_and_on_the_page(kind: str) -> None:
    """What is imported is exported, and documented on the page under its kind, nothing else."""
    tree = ast.parse((PACKAGE / f"{kind}.py").read_text("utf-8"))
    brought = {
        alias.name for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    module = import_module(f"era_haptics.plugins.{kind}")
    assert brought == set(module.__all__)
    told = re.findall(rf"^\.\. (?:auto|py:)\w+:: era_haptics\.plugins\.{kind}\.(\w+)", PAGE, re.M)
    assert sorted(told) == sorted(module.__all__)


@pytest.mark.parametrize(
    ("kind", "never"),
    [
        ("backends", {"model", "controller", "sim", "numpy", "scipy", "pymodbus", "can", "serial"}),
        ("touch_sources", {"sim", "numpy", "scipy", "matplotlib", "pythonosc"}),
        ("effects", {"sim", "scipy", "matplotlib", "drivers.backend"}),
        ("materials", {"sim", "controller", "drivers", "numpy"}),
        ("elements", {"sim", "controller", "drivers", "scipy", "matplotlib"}),
    ],
)
def test_a_kind_brings_nothing_that_it_does_not_need(kind: str, never: set[str]) -> None:
    """A backend is loaded without the model, a touch source without linear algebra."""
    program = f"import sys, era_haptics.plugins.{kind}; print(*sys.modules)"
    said = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.split()
    assert set(said) & never == set()
