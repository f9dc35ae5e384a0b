"""What a reload applies and refuses."""

from pathlib import Path

import pytest

from controller.daemon.config import DaemonConfig, load_daemon_config
from controller.daemon.reload import changed_keys, reload_problem
from model.rig.file import example_rig_path

DEFAULTS = {
    "rig": "rig.yaml",
    "level_db_sl": "20",
    "touch": '[{name: a, url: "tuio:3333"}]',
    "longest_lease": "60 s",
    "log": "{level: info}",
    "socket": "s",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with two rigs, two layouts and a table."""
    rig = example_rig_path().read_text("utf-8")
    (tmp_path / "rig.yaml").write_text(rig, "utf-8")
    (tmp_path / "other.yaml").write_text(rig.replace("level: 1.0", "level: 0.5"), "utf-8")
    for level in ("10", "neighbours"):
        layout = (
            f"effects: {{hum: {{kind: buzz, level: {level}}}}}\nregions: {{}}\nelsewhere: hum\n"
        )
        (tmp_path / f"{level}.yaml").write_text(layout, "utf-8")
    (tmp_path / "t.npz").touch()
    return tmp_path


def config(folder: Path, **changes: str) -> DaemonConfig:
    """The default configuration with other values at some keys."""
    path = folder / "daemon.yaml"
    text = "".join(f"{key}: {value}\n" for key, value in (DEFAULTS | changes).items())
    path.write_text(text, "utf-8")
    return load_daemon_config(path)


def problem(old: DaemonConfig, new: DaemonConfig, *, is_armed: bool) -> str | None:
    """Why a change is not applied."""
    return reload_problem(old, new, changed_keys(old, new), is_armed=is_armed)


@pytest.mark.parametrize("is_armed", [False, True])
@pytest.mark.parametrize("change", [{}, {"level_db_sl": "19"}, {"layout": "10.yaml"}])
def test_reload_applies_a_layout(folder: Path, change: dict[str, str], is_armed: bool) -> None:
    """Armed or not, one that is not stronger."""
    assert problem(config(folder), config(folder, **change), is_armed=is_armed) is None


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("rig", "other.yaml"),
        ("table", "t.npz"),
        ("mode", "switched"),
        ("serial_numbers", "{main: A1}"),
        ("touch", "[]"),
        ("longest_lease", "5 s"),
        ("log", "{level: debug}"),
        ("dumps", "{folder: d}"),
        ("socket", "t"),
        ("dashboard", "127.0.0.1:1"),
    ],
)
def test_reload_is_refused_when_anything_else_changes(folder: Path, key: str, value: str) -> None:
    """A layout that changed with it is not applied either; the key is named."""
    new = config(folder, level_db_sl="10", **{key: value})
    assert key in (problem(config(folder), new, is_armed=False) or "")


def test_reload_is_refused_when_rig_file_was_edited(folder: Path) -> None:
    """The file's content counts, not its name, for limits may have changed in it."""
    old = config(folder)
    text = (folder / "rig.yaml").read_text("utf-8")
    (folder / "rig.yaml").write_text(text.replace("level: 1.0", "level: 0.9"), "utf-8")
    assert problem(old, config(folder), is_armed=False) is not None


@pytest.mark.parametrize("change", [{"level_db_sl": "21"}, {"layout": "neighbours.yaml"}])
def test_reload_raises_no_level_while_armed(folder: Path, change: dict[str, str]) -> None:
    """From 20 dB SL to 21, or to whatever the neighbours allow, only once disarmed."""
    old, new = config(folder), config(folder, **change)
    assert problem(old, new, is_armed=True) is not None
    assert problem(old, new, is_armed=False) is None
