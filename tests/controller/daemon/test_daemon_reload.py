from pathlib import Path

import pytest

from controller.daemon.config import DaemonConfig, load_daemon_config
from controller.daemon.reload import ReloadPlan, plan_reload
from model.rig.file import example_rig_path

USUAL = {
    "rig": "rig.yaml",
    "level_db_sl": "20",
    "touch": '[{name: a, url: "tuio:3333"}]',
    "longest_lease": "60 s",
    "log": "{level: info}",
    "socket": "s",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with two rigs and a table."""
    rig = example_rig_path().read_text("utf-8")
    (tmp_path / "rig.yaml").write_text(rig, "utf-8")
    (tmp_path / "other.yaml").write_text(rig.replace("level: 1.0", "level: 0.5"), "utf-8")
    (tmp_path / "t.npz").touch()
    return tmp_path


def config(folder: Path, **changes: str) -> DaemonConfig:
    """The usual configuration with other values at some keys."""
    path = folder / "daemon.yaml"
    text = "".join(f"{key}: {value}\n" for key, value in (USUAL | changes).items())
    path.write_text(text, "utf-8")
    return load_daemon_config(path)


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
        ({"socket": "t", "touch": "[]"}, ReloadPlan(("touch",), ("socket",))),
        ({"metrics": "9400"}, ReloadPlan((), ("metrics",))),
        ({"dashboard": "127.0.0.1:1"}, ReloadPlan((), ("dashboard",))),
    ],
)
def test_what_is_safe_is_taken_over_and_the_rest_waits(
    folder: Path, changes: dict[str, str], plan: ReloadPlan, is_armed: bool
) -> None:
    """Armed or not: touch sources, leases, log level, dumps and a lower level; no more."""
    assert plan_reload(config(folder), config(folder, **changes), is_armed=is_armed) == plan


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
def test_where_the_basis_changes_nothing_is_taken_over(
    folder: Path, key: str, value: str, is_armed: bool
) -> None:
    """Neither limits nor amplifiers nor the plate, nor anything else that came with them."""
    changed = config(folder, touch="[]", **{key: value})
    plan = plan_reload(config(folder), changed, is_armed=is_armed)
    assert plan.apply == ()
    assert key in (plan.refused or "")


def test_a_rig_that_was_edited_is_another_rig(folder: Path) -> None:
    """The file's content counts, not its name: limits may have changed in it."""
    old = config(folder)
    text = (folder / "rig.yaml").read_text("utf-8")
    (folder / "rig.yaml").write_text(text.replace("level: 1.0", "level: 0.9"), "utf-8")
    assert plan_reload(old, config(folder), is_armed=False).refused is not None


def test_nothing_gets_stronger_while_it_is_armed(folder: Path) -> None:
    """20 dB SL to 21: only once it is disarmed."""
    old, new = config(folder), config(folder, level_db_sl="21", touch="[]")
    assert "21" in (plan_reload(old, new, is_armed=True).refused or "")
    assert plan_reload(old, new, is_armed=True).apply == ()
    assert set(plan_reload(old, new, is_armed=False).apply) == {"layout", "touch"}
