"""Parts of a far end: terminals, delays of lines, programs of the firmware.

Delays are by the numbers of their standards and data sheets.
"""

import os
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.playing import AmplifierTone
from kit.wires import WIRES, make_bench
from model.errors import InputError
from model.rig.rig import Rig
from registry import threads
from sim import simulation
from sim.far_ends.wire_assignment import open_wires
from sim.faults import FaultWindow
from sim.transport.simulated_line import LINE_KINDS, Latency, LineKind
from sim.transport.terminal_links import linked_urls, links_by_amplifier

HALF_STROKE = AmplifierTone(0, 110.0, 0.5)


PROMPT = Latency()
FRAME_ERROR = 50e-6  # of a frame's length, relative


def test_usb_moves_bytes_in_the_next_frame() -> None:
    """Either way 0 to 1 ms later, 0.5 ms on average, at whole frames from each other.

    1 500 bytes at 12 Mbit/s take 1 ms.
    """
    delays = LineKind(PROMPT, PROMPT, frame=1e-3).delays(1)
    times = [number * 1.3717e-3 for number in range(2000)]
    for shift in (delays.leave, delays.arrive):
        moved = [shift(time, 10) for time in times]
        late = np.subtract(moved, times)
        assert min(late) >= 0
        assert max(late) <= 1e-3 * (1 + FRAME_ERROR)
        assert statistics.mean(late) == pytest.approx(0.5e-3, rel=0.05)
        frames = np.subtract(moved, moved[0]) / 1e-3
        np.testing.assert_allclose(frames, np.round(frames), rtol=FRAME_ERROR, atol=1e-6)
    delays = LineKind(PROMPT, PROMPT, usb_byte=8 / 12e6).delays(1)
    assert [delays.leave(2.0, 1500), delays.arrive(3.0, 1500)] == pytest.approx([2.001, 3.001])


def test_ftdi_holds_small_replies_until_its_timer_has_run() -> None:
    """10 bytes wait for 8 ms on average, at most 16; 62 leave immediately and restart the timer."""
    delays = LineKind(PROMPT, PROMPT, latency_timer=16e-3).delays(1)
    times = [0.1 + number * 0.0371 for number in range(2000)]
    late = [delays.arrive(time, 10) - time for time in times]
    assert 0 < min(late) <= max(late) <= 16e-3
    assert statistics.mean(late) == pytest.approx(8e-3, rel=0.05)
    assert delays.arrive(100.0, 62) == 100.0
    assert delays.arrive(100.001, 10) == pytest.approx(100.016)
    assert delays.arrive(100.002, 10) == pytest.approx(100.016)  # in the same packet
    assert delays.arrive(200.0, 100) == pytest.approx(200.016)  # all but the first 62


@pytest.mark.parametrize("name", LINE_KINDS)
def test_delays_keep_the_order_and_are_those_of_their_seed(name: str) -> None:
    """Bytes leave in order in each direction and in time; another seed has other delays."""

    def drawn(seed: object) -> list[float]:
        delays = LINE_KINDS[name].delays(seed)
        return [delays.leave(n * 1e-4, 30) for n in range(300)] + [
            delays.arrive(n * 1e-4, 30) for n in range(300)
        ]

    times = drawn(("line", 1))
    spent = [time - n % 300 * 1e-4 for n, time in enumerate(times)]
    assert max(spent[:300]) + max(spent[300:]) <= LINE_KINDS[name].max_delay + 1e-3
    assert times[:300] == sorted(times[:300])
    assert times[300:] == sorted(times[300:])
    assert times == drawn(("line", 1)) != drawn(("line", 2))


@pytest.fixture
def terminal() -> Iterator[str]:
    """The path of a pseudo-terminal."""
    near, far = os.openpty()
    yield os.ttyname(far)
    os.close(near)
    os.close(far)


def test_amplifiers_of_one_line_share_its_link(tmp_path: Path, terminal: str) -> None:
    """The rest of each URL stays; the link leads to the terminal, and goes at the end."""
    link = tmp_path / "line"
    urls = {
        "a": f"serial://{terminal}?address=1",
        "b": f"serial://{terminal}?address=2",
        "c": "modbus+tcp://127.0.0.1:502/1",
    }
    with linked_urls(urls, links_by_amplifier([str(link)], amplifiers=list(urls))) as moved:
        assert moved == {
            "a": f"serial://{link}?address=1",
            "b": f"serial://{link}?address=2",
            "c": "modbus+tcp://127.0.0.1:502/1",
        }
        assert str(link.readlink()) == terminal
    assert not link.is_symlink()


@pytest.mark.parametrize("options", [["d=/tmp/x"], ["a="], ["a=/tmp/x", "/tmp/y"]])
def test_options_that_name_no_line_are_refused(options: list[str]) -> None:
    """An unknown amplifier, no path, and two paths for one amplifier."""
    with pytest.raises(InputError, match="--link"):
        links_by_amplifier(options, amplifiers=["a", "b"])


@pytest.mark.parametrize(
    ("urls", "text"),
    [
        (["serial://{}?address=1", "serial://{}?address=2"], "one per line"),
        (["modbus+tcp://127.0.0.1:502/1"], "pseudo-terminal"),
    ],
)
def test_a_line_has_one_link_and_a_network_none(
    urls: list[str], text: str, tmp_path: Path, terminal: str
) -> None:
    """Nothing is linked then."""
    named = {name: url.format(terminal) for name, url in zip("ab", urls, strict=False)}
    links = {name: tmp_path / name for name in named}
    with pytest.raises(InputError, match=text), linked_urls(named, links):
        pass
    assert [path for path in tmp_path.iterdir() if path.is_symlink()] == []


def open_files() -> list[Path]:
    """The file descriptors of this process."""
    return sorted(Path("/proc/self/fd").iterdir())


@pytest.mark.parametrize("scheme", WIRES)
async def test_far_end_leaves_its_device_when_it_ends(scheme: str, coarse_rig: Rig) -> None:
    """An unplugged and restarted device opens no line of a far end that has ended."""
    _, devices = make_bench(coarse_rig)
    device = devices["main"]
    async with open_wires({"main": WIRES[scheme]}, [device]):
        pass
    present = open_files()
    for fault in ("unplug", "reboot"):
        device.inject_fault(FaultWindow(fault=fault))
        device.recover()
    assert open_files() == present
    assert not [*device.plug_listeners, *device.boot_listeners, *device.listeners]


def test_missing_firmware_is_told_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a checkout the command that builds it, elsewhere that a checkout is needed."""
    monkeypatch.setattr(simulation, "FIRMWARE_FOLDER", tmp_path / "out" / "firmware")
    with pytest.raises(InputError, match="checkout"):
        simulation.find_firmware()
    (tmp_path / "firmware").mkdir()
    with pytest.raises(InputError, match="make firmware"):
        simulation.find_firmware()


PARENT = """
import asyncio, pathlib, sys
from sim.simulation import running_firmware
async def main():
    async with running_firmware(pathlib.Path(sys.argv[1]), "main") as url:
        print(url, flush=True)
        await asyncio.sleep(60)
asyncio.run(main())
"""
PROGRAM = """#!/bin/sh
echo serial:///dev/pts/7
cat
echo ended >&3
"""


def test_firmware_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    """Its standard input is at its end then; its URL is the line that it has printed."""
    program, notes = tmp_path / "era-firmware", tmp_path / "notes"
    program.write_text(PROGRAM.replace("&3", str(notes)))
    program.chmod(0o755)
    with subprocess.Popen([sys.executable, "-c", PARENT, program], stdout=-1) as parent:
        assert parent.stdout.readline() == b"serial:///dev/pts/7\n"
        parent.send_signal(signal.SIGKILL)
    until = threads.now() + 10
    while not notes.exists() and threads.now() < until:
        time.sleep(0.02)
    assert notes.exists()
