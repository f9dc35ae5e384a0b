"""What a reload costs the control loop: nothing is read, built or parsed there."""

from pathlib import Path

import pytest

from callback_times import measured_callbacks
from controller.daemon.config_reader import read_in_child
from controller.sources.capture import HEADER
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram
from daemon_bench import ENABLED, ready_daemon, until
from model.errors import InputError

REGIONS = 64  # as many as a layout may have


def write_recording(path: Path, *, seconds: float) -> None:
    """A recording of a moving finger at 60 Hz."""
    lines = [HEADER]
    for number in range(int(60 * seconds)):
        frame = TouchFrame("panel", 0.0, (Touch(1, 0.2 + number % 60 / 100, 0.5),))
        lines.append(f"{number / 60:.6f} {tuio_datagram(frame, number + 1).hex()}")
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


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
    """A recording of 100 s and a large layout, added while armed and subscribed."""
    write_recording(tmp_path / "long.tuio", seconds=100)
    write_layout(tmp_path / "large.yaml")
    async with ready_daemon(tmp_path, "level_db_sl: 20\n") as (bench, era):
        await era.subscribe("layout", "contacts", "log")
        await era.arm("me", lease_s=60)
        with (tmp_path / "daemon.yaml").open("a", encoding="utf-8") as file:
            url = f"replay:{tmp_path}/long.tuio"
            file.write(f'layout: large.yaml\ntouch: [{{name: long, url: "{url}"}}]\n')
        with measured_callbacks() as times:
            await bench.daemon.reload()
            await until(lambda: bench.daemon._publisher.view.contacts)
        assert bench.daemon._config.layout is not None
        times.assert_short()
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
