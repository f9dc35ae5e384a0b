"""Imports of the example plug-ins."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PLUGINS = ROOT / "examples" / "plugins"
MODULES = sorted(PLUGINS.glob("*/*.py"))


@pytest.mark.parametrize("path", MODULES, ids=[path.stem for path in MODULES])
def test_example_plugin_imports_stable_names_only(path: Path) -> None:
    """Of this project plug-ins import `era_haptics` only."""
    imported = re.findall(r"^\s*(?:from|import) ([\w.]+)", path.read_text("utf-8"), re.MULTILINE)
    homes = {name.partition(".")[0] for name in imported}
    assert homes & {"registry", "controller", "drivers", "model", "sim"} == set()
