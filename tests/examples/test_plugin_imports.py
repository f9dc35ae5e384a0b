"""What the example plug-ins import."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PLUGINS = ROOT / "examples" / "plugins"
MODULES = sorted(PLUGINS.glob("*/*.py"))


@pytest.mark.parametrize("path", MODULES, ids=[path.stem for path in MODULES])
def test_a_plug_in_imports_stable_names_only(path: Path) -> None:
    """Of this project `era_haptics` alone, whose names stay while modules move."""
    brought = re.findall(r"^\s*(?:from|import) ([\w.]+)", path.read_text("utf-8"), re.MULTILINE)
    homes = {name.partition(".")[0] for name in brought}
    assert homes & {"registry", "controller", "drivers", "model", "sim"} == set()
