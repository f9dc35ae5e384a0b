"""What the daemon's commands tell their users, beyond what the daemon itself says."""

import asyncio
import re
import socket
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import pytest
import typer

from controller.api.client_protocol import Notification
from controller.cli.daemon import show_event, show_status, status, touch
from controller.daemon.run import run_daemon
from controller.metrics.__main__ import serve
from daemon_bench import running_daemon, until_state, write_daemon
from model.errors import InputError
from sim.faults.fault_window import FaultWindow


def test_an_event_is_told_by_the_clock_on_the_wall_and_without_what_is_not_known() -> None:
    """On the second day of 1970 at 0:01:05.25 here; digits that no finger has are left out."""
    finger = {"source": "panel", "id": 1, "x_m": 0.1 + 0.2, "role": None, "effect": "buzz"}
    midnight = datetime(1970, 1, 2).timestamp()
    event = Notification("contacts", 5.25, 3, {"contacts": [finger, finger | {"id": 2}]})
    assert show_event(event, ahead=midnight + 60.0) == (
        "00:01:05.250  contacts   contacts source panel, id 1, x_m 0.3, effect buzz; "
        "source panel, id 2, x_m 0.3, effect buzz  (3 lost)"
    )
    drive = {"SW": {"frequency_hz": 110.0, "level": 0.05}}
    pattern = Notification("pattern", 0.0, 0, {"contacts": [finger], "drive": drive})
    assert show_event(pattern, ahead=midnight) == (
        "00:00:00.000  pattern    contacts source panel, id 1, x_m 0.3, effect buzz, "
        "drive (SW (frequency_hz 110, level 0.05))"
    )
    nobody = Notification("contacts", 0.0, 0, {"contacts": []})
    assert show_event(nobody, ahead=midnight) == "00:00:00.000  contacts   contacts none"


async def test_a_touch_beyond_the_plate_is_refused(tmp_path: Path) -> None:
    """With the plate's size, though the daemon itself only counts such touches."""

    def beyond(place: str) -> None:
        touch([place], duration=0.0, socket=tmp_path / "era.sock")

    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, "READY_TO_SWITCH_ON")
        for place in ("0.31,0.1", "0.1,-0.001"):
            with pytest.raises(InputError, match=r"0\.3048 m by 0\.2286 m"):
                await asyncio.to_thread(beyond, place)
        await asyncio.to_thread(beyond, "0.3048,0")
        with pytest.raises(InputError, match="era touch 'a' is not X,Y"):
            beyond("a")


async def test_a_status_says_that_touches_wait_for_somebody_to_arm(tmp_path: Path) -> None:
    """Only where a finger is down and nobody has armed: the command that helps."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, "READY_TO_SWITCH_ON")
        assert "era arm" not in show_status(await era.status())
        for _ in range(500):
            await era.touch([(0.1, 0.1)])
            status = await era.status()
            if status.contacts:
                break
            await asyncio.sleep(0.01)
        assert "  silent: not armed; arm with era arm\n" in show_status(status)
        await era.arm("me", lease_s=30)
        assert "era arm does" not in show_status(await era.status())


async def test_a_status_says_why_touches_begin_along_plain_ramps(tmp_path: Path) -> None:
    """Where that is for a while only, and not otherwise."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        told = await era.status()
    assert "plain ramps" not in show_status(told)
    slow = told.model_copy(update={"plain_because": "it took 50 ms"})
    assert "  plain ramps: it took 50 ms\n" in show_status(slow)


async def test_a_status_that_was_told_is_done_whatever_it_tells(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In COMM_LOST and in FAULT the command ends as ever: scripts look at what it says."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, "READY_TO_SWITCH_ON")
        bench.far.device.inject_fault(FaultWindow("hang"))
        await until_state(era, "COMM_LOST")
        await asyncio.to_thread(status, socket=bench.socket)  # another status is an exception
        await era.stop()  # latches: without it the link would come back to no fault
        bench.far.device.recover()
        await until_state(era, "FAULT")
        await asyncio.to_thread(status, socket=bench.socket)
    told = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in told if line[0] != " "] == ["COMM_LOST", "FAULT"]


async def test_a_status_says_what_is_known_of_a_lost_amplifier(tmp_path: Path) -> None:
    """How long it is lost, its watchdog time and its last answer's age, but not how it was then."""
    async with running_daemon(tmp_path) as bench, await bench.client() as era:
        await until_state(era, "READY_TO_SWITCH_ON")
        before = show_status(await era.status())
        bench.far.device.inject_fault(FaultWindow("hang"))
        await until_state(era, "COMM_LOST")
        lost = await era.status()
    assert "READY_TO_SWITCH_ON" in before
    assert "unreachable" not in before
    (line,) = [line for line in show_status(lost).splitlines() if "serial://" in line]
    assert re.search(r"\): LOST, last reply [\d.]+ s ago$", line)
    watchdog = "its watchdog silences it after 0.25 s without commands"
    for is_energised, told in (
        (
            True,
            f"  ASSUME ENERGISED: a lost amplifier may still be playing; {watchdog}\n",
        ),
        (False, f"  unreachable for 12.0 s: {watchdog}, unconfirmed\n"),
    ):
        update = {"lost_for_s": 12.0, "assume_energised": is_energised}
        assert told in show_status(lost.model_copy(update=update))


def test_a_log_that_cannot_be_written_keeps_the_daemon_from_beginning(tmp_path: Path) -> None:
    """Before it drives anything, with the key in its file; a socket is no file to write to."""
    path = write_daemon(tmp_path, {"main": "sim://"}, "log: {file: taken}\n")
    with socket.socket(socket.AF_UNIX) as taken:
        taken.bind(str(tmp_path / "taken"))
        with pytest.raises(InputError, match=r"daemon\.yaml: log\.file: .*taken"):
            run_daemon(path, dashboard=None)
    assert not (tmp_path / "era.sock").exists()


def test_a_port_for_metrics_that_is_taken(capsys: pytest.CaptureFixture[str]) -> None:
    """One line that names the port and the key, and no traceback."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(typer.Exit) as caught:
            serve(port)
    assert caught.value.exit_code == 2
    said = capsys.readouterr().err
    assert f"127.0.0.1 port {port} (Address already in use)" in said
    assert "`metrics`" in said


def test_a_daemon_loads_nothing_that_only_others_compute_with() -> None:
    """Not for the exact search, the nulls of maps or pictures: no start waits for these."""
    program = "import sys, controller.daemon.run; print(*sys.modules)"
    said = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "scipy.linalg" in said
    assert set(said) & {"scipy.optimize", "scipy.ndimage", "matplotlib", "starlette"} == set()
