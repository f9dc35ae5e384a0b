"""The example effect."""

import re
from importlib import util
from pathlib import Path

import pytest

HEARTBEAT = Path(__file__).parents[2] / "examples" / "plugins" / "effect" / "heartbeat.py"


def test_heartbeat_has_no_end() -> None:
    """It lasts as long as the finger, so a layout refuses it under `on_release`."""
    spec = util.spec_from_file_location("heartbeat", HEARTBEAT)
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.Heartbeat().has_end is False


ROOT = Path(__file__).parents[2]
PLUGINS = ROOT / "examples" / "plugins"
MODULES = sorted(PLUGINS.glob("*/*.py"))


@pytest.mark.parametrize("path", MODULES, ids=[path.stem for path in MODULES])
def test_example_plugin_imports_stable_names_only(path: Path) -> None:
    """Of this project plug-ins import `era_haptics` only."""
    imported = re.findall(r"^\s*(?:from|import) ([\w.]+)", path.read_text("utf-8"), re.MULTILINE)
    homes = {name.partition(".")[0] for name in imported}
    assert homes & {"registry", "controller", "drivers", "model", "sim"} == set()
