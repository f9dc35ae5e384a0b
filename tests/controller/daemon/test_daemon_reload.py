"""What a reload applies and refuses, read in another process, and what it costs the loop."""

import asyncio
import itertools
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from controller.daemon.children import read_in_child
from controller.daemon.config import DaemonConfig, load_daemon_config
from controller.daemon.layouts import config_change
from controller.process.child import child_command
from daemons import ENABLED, ready_daemon
from model.errors import InputError
from model.rig.rig_file import example_rig_path
from virtual_lines import in_virtual_time

FREQUENCIES = np.arange(60.0, 301.0, 20.0)  # Hz; of a table

MOST_EVENTS = 4000
"""Of a callback that handles input of clients or files: 2000 calls and returns, about 1 ms."""


DEFAULTS = {
    "rig": "rig.yaml",
    "level_db_sl": "20",
    "touch": '[{name: a, url: "tuio:3333"}]',
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


def problem(old: DaemonConfig, new: DaemonConfig, *, is_armed: bool) -> str:
    """Why a change is not applied."""
    return "; ".join(config_change(old, new).refusals(is_armed=is_armed))


@pytest.mark.parametrize("is_armed", [False, True])
@pytest.mark.parametrize("change", [{}, {"level_db_sl": "19"}, {"layouts": "{a: 10.yaml}"}])
def test_reload_applies_a_layout(folder: Path, change: dict[str, str], is_armed: bool) -> None:
    """Armed or not, one that is not stronger."""
    assert not problem(config(folder), config(folder, **change), is_armed=is_armed)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("rig", "other.yaml"),
        ("table", "t.npz"),
        ("mode", "switched"),
        ("serial_numbers", "{main: A1}"),
        ("touch", "[]"),
        ("log", "{level: debug}"),
        ("dumps", "{folder: d}"),
        ("socket", "t"),
        ("dashboard", "127.0.0.1:1"),
    ],
)
def test_reload_is_refused_when_anything_else_changes(folder: Path, key: str, value: str) -> None:
    """A layout that changed with it is not applied either; the key is named."""
    new = config(folder, level_db_sl="10", **{key: value})
    assert key in problem(config(folder), new, is_armed=False)


def test_reload_is_refused_when_rig_file_was_edited(folder: Path) -> None:
    """The file's content counts, not its name, for limits may have changed in it."""
    old = config(folder)
    text = (folder / "rig.yaml").read_text("utf-8")
    (folder / "rig.yaml").write_text(text.replace("level: 1.0", "level: 0.9"), "utf-8")
    assert problem(old, config(folder), is_armed=False)


@pytest.mark.parametrize(
    "change", [{"level_db_sl": "21"}, {"layouts": "{a: 10.yaml, b: neighbours.yaml}"}]
)
def test_reload_raises_no_level_while_armed(folder: Path, change: dict[str, str]) -> None:
    """From 20 dB SL to 21, or to whatever the neighbours allow, in use or not, once disarmed."""
    old, new = config(folder), config(folder, **change)
    assert problem(old, new, is_armed=True)
    assert not problem(old, new, is_armed=False)


REGIONS = 64  # as many as a layout may have


def write_layout(path: Path) -> None:
    """A layout of many regions, each with an effect of its own."""
    lines = ["effects:"]
    lines += [f"  e{each}: {{kind: buzz, level: {10 + each % 10}}}" for each in range(REGIONS)]
    lines += ["regions:"]
    for each in range(REGIONS):
        x, y = 0.01 * (each % 20), 0.01 * (each // 20)
        corners = f"start: [{x}, {y}], end: [{x + 0.009:g}, {y + 0.009:g}]"
        lines.append(f"  r{each}: {{rectangle: {{{corners}}}, on_press: e{each}}}")
    path.write_text("\n".join([*lines, "elsewhere: null", ""]), encoding="utf-8")


@in_virtual_time
async def test_reload_costs_the_loop_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A large layout, added while armed and subscribed, is read in another process.

    No thread of the daemon holds the interpreter's lock for it; problems come back as text. Calls
    are counted: unlike a time they are the same on every machine.
    """
    events: list[int] = []
    run = asyncio.Handle._run

    def counted(handle: asyncio.Handle) -> None:
        count = itertools.count()
        sys.setprofile(lambda *_: next(count))
        try:
            run(handle)
        finally:
            sys.setprofile(None)
        events.append(next(count))

    def fail(*arguments: object, **options: object) -> None:
        raise AssertionError("read in the daemon's process")

    write_layout(tmp_path / "large.yaml")
    async with ready_daemon(tmp_path, "level_db_sl: 20\n") as (bench, era):
        await era.subscribe("layout", "log")
        await era.arm("me", lease_s=60)
        for name in ("controller.daemon.config", "controller.effects.layout"):
            monkeypatch.setattr(f"{name}.read_document", fail)
        with (tmp_path / "daemon.yaml").open("a", encoding="utf-8") as file:
            file.write("layouts: {large: large.yaml}\n")
        with monkeypatch.context() as counting:
            counting.setattr(asyncio.Handle, "_run", counted)
            await asyncio.create_task(bench.daemon.reload())
            await asyncio.sleep(0.2)  # until all is as the layout says
        assert len(bench.daemon._config.layouts["large"].regions) == REGIONS
        assert len(events) > 10
        assert max(events) <= MOST_EVENTS
        assert (await era.status()).state == ENABLED
    with pytest.raises(InputError, match=r"missing\.yaml"):
        read_in_child(tmp_path / "missing.yaml", FREQUENCIES)


def test_reading_a_configuration_in_a_child_is_bounded_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error of the system, as if the child had failed; a child cannot start in no time."""
    monkeypatch.setattr("controller.daemon.children._TIMEOUT", 0.0)
    with pytest.raises(OSError, match="took longer"):
        read_in_child(tmp_path / "daemon.yaml", FREQUENCIES)


def test_plugin_installed_meanwhile_needs_a_restart(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the child reads by a plug-in that this process cannot load is bad input."""
    package = tmp_path / "installed"
    info = package / "late_effect-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: late-effect\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[era_haptics.effects]\nlate = late_effect:Late\n")
    (package / "late_effect.py").write_text(
        "from controller.effects.kinds import Click\nclass Late(Click):\n    kind = 'late'\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(package))  # of children started from now on
    (folder / "layout.yaml").write_text("effects: {tap: {kind: late}}\nelsewhere: null\n")
    (folder / "daemon.yaml").write_text("rig: rig.yaml\nlayouts: {panel: layout.yaml}\n")
    with pytest.raises(InputError, match="restart the daemon"):
        read_in_child(folder / "daemon.yaml", FREQUENCIES)


def test_child_ends_by_none_of_the_daemons_own_signals() -> None:
    """A signal to the whole service reopens the log or does nothing; SIGTERM ends a child."""
    command = child_command("http.server", "0")
    quick = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=quick) as child:
        assert child.stdout is not None
        child.stdout.readline()  # it serves
        for number in (signal.SIGHUP, signal.SIGUSR1, signal.SIGTERM):
            child.send_signal(number)
        assert child.wait(20) == -signal.SIGTERM
