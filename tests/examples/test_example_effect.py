"""The example effect."""

from importlib import util
from pathlib import Path

HEARTBEAT = Path(__file__).parents[2] / "examples" / "plugins" / "effect" / "heartbeat.py"


def test_heartbeat_has_no_end() -> None:
    """It lasts as long as the finger, so a layout refuses it under `on_release`."""
    spec = util.spec_from_file_location("heartbeat", HEARTBEAT)
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.Heartbeat().has_end is False
