"""What a reload costs the control loop: nothing is read, built or parsed there."""

from pathlib import Path

import pytest

from callback_work import counted_callbacks
from controller.daemon.config_reader import read_in_child
from daemon_bench import ENABLED, ready_daemon
from model.errors import InputError

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


async def test_reload_costs_the_loop_nothing(tmp_path: Path) -> None:
    """A large layout, added while armed and subscribed."""
    write_layout(tmp_path / "large.yaml")
    async with ready_daemon(tmp_path, "level_db_sl: 20\n") as (bench, era):
        await era.subscribe("layout", "log")
        await era.arm("me", lease_s=60)
        with (tmp_path / "daemon.yaml").open("a", encoding="utf-8") as file:
            file.write("layout: large.yaml\n")
        with counted_callbacks() as work:
            await bench.daemon.reload()
        assert bench.daemon._config.layout is not None
        assert len(work.calls) > 10
        work.assert_short()
        assert (await era.status()).state == ENABLED


async def test_reload_reads_its_files_in_another_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No thread of the daemon holds the interpreter's lock for it; problems come back as text."""

    def fail(*arguments: object, **options: object) -> None:
        raise AssertionError("read in the daemon's process")

    write_layout(tmp_path / "large.yaml")
    async with ready_daemon(tmp_path) as (bench, _):
        for name in ("controller.daemon.config", "controller.effects.layout_file"):
            monkeypatch.setattr(f"{name}.read_document", fail)
        with (tmp_path / "daemon.yaml").open("a", encoding="utf-8") as file:
            file.write("layout: large.yaml\n")
        await bench.daemon.reload()
        layout = bench.daemon._config.layout
        assert layout is not None
        assert len(layout.regions) == REGIONS
    with pytest.raises(InputError) as raised:
        read_in_child(tmp_path / "missing.yaml")
    assert "missing.yaml" in str(raised.value)


def test_reading_a_configuration_in_a_child_is_bounded_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error of the system, as if the child had failed; a child cannot start in no time."""
    monkeypatch.setattr("controller.daemon.config_reader._TIMEOUT", 0.0)
    with pytest.raises(OSError, match="took longer"):
        read_in_child(tmp_path / "daemon.yaml")
