"""What a reload applies, defers and refuses."""

from pathlib import Path

import pytest

from controller.daemon.config import DaemonConfig, load_daemon_config
from controller.daemon.reload import ReloadPlan, changed_keys, plan_reload
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


def planned(old: DaemonConfig, new: DaemonConfig, *, is_armed: bool) -> ReloadPlan:
    """The plan of a change."""
    return plan_reload(old, new, changed_keys(old, new), is_armed=is_armed)


@pytest.mark.parametrize("is_armed", [False, True])
@pytest.mark.parametrize(
    ("changes", "plan"),
    [
        ({}, ReloadPlan((), ())),
        ({"touch": "[]"}, ReloadPlan(("touch",), ())),
        ({"longest_lease": "5 s"}, ReloadPlan(("longest_lease",), ())),
        ({"log": "{level: debug}"}, ReloadPlan(("log.level",), ())),
        ({"log": "{file: l}"}, ReloadPlan((), ("log.file",))),
        ({"dumps": "{folder: d}"}, ReloadPlan(("dumps",), ())),
        ({"level_db_sl": "19"}, ReloadPlan(("layout",), ())),
        ({"layout": "10.yaml"}, ReloadPlan(("layout",), ())),
        ({"socket": "t", "touch": "[]"}, ReloadPlan(("touch",), ("socket",))),
        ({"metrics": "9400"}, ReloadPlan((), ("metrics",))),
        ({"dashboard": "127.0.0.1:1"}, ReloadPlan((), ("dashboard",))),
    ],
)
def test_reload_applies_safe_keys_and_defers_others(
    folder: Path, changes: dict[str, str], plan: ReloadPlan, is_armed: bool
) -> None:
    """Armed or not: touch sources, leases, log level, dumps and a lower level."""
    assert planned(config(folder), config(folder, **changes), is_armed=is_armed) == plan


@pytest.mark.parametrize("is_armed", [False, True])
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("rig", "other.yaml"),
        ("table", "t.npz"),
        ("mode", "switched"),
        ("serial_numbers", "{main: A1}"),
    ],
)
def test_reload_is_refused_when_rig_table_mode_or_amplifiers_change(
    folder: Path, key: str, value: str, is_armed: bool
) -> None:
    """Nothing else that changed with them is applied either."""
    changed = config(folder, touch="[]", **{key: value})
    plan = planned(config(folder), changed, is_armed=is_armed)
    assert plan.apply == ()
    assert key in (plan.refused or "")


def test_reload_is_refused_when_rig_file_was_edited(folder: Path) -> None:
    """The file's content counts, not its name, for limits may have changed in it."""
    old = config(folder)
    text = (folder / "rig.yaml").read_text("utf-8")
    (folder / "rig.yaml").write_text(text.replace("level: 1.0", "level: 0.9"), "utf-8")
    assert planned(old, config(folder), is_armed=False).refused is not None


@pytest.mark.parametrize("change", [{"level_db_sl": "21"}, {"layout": "neighbours.yaml"}])
def test_reload_raises_no_level_while_armed(folder: Path, change: dict[str, str]) -> None:
    """From 20 dB SL to 21, or to whatever the neighbours allow, only once disarmed."""
    old, new = config(folder), config(folder, touch="[]", **change)
    plan = planned(old, new, is_armed=True)
    assert plan.refused is not None
    assert plan.apply == ()
    assert set(planned(old, new, is_armed=False).apply) == {"layout", "touch"}
