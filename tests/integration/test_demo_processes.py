"""Demonstrations as a user starts them: their processes end together."""

import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

import controller.demo.demonstration
import controller.demo.simulated_plate
import live_demonstration
from controller.api.client import Client
from controller.demo.recorder import TouchRecorder
from era_haptics.command import run_era
from kit.fingers import write_schedule
from processes.daemons import (
    READY,
)
from processes.gateways import (
    wait_for,
    wait_for_state,
)
from processes.installed import ERA
from processes.patient_daemon import wait_long

ENABLED = "OPERATION_ENABLED"


# (id, down [s], up [s], x, y in TUIO's coordinates): one finger, then a second beside it, a pause,
# and a third one alone.
SCHEDULE = [
    (1, 0.1, 1.2, 0.30, 0.35),
    (2, 0.6, 1.2, 0.80, 0.70),
    (3, 1.4, 2.0, 0.65, 0.20),
]


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A TUIO capture of the schedule."""
    return write_schedule(tmp_path_factory.mktemp("touches") / "touches.tuio", SCHEDULE, 2.1)


@pytest.fixture
def demo(table_cache, tmp_path, monkeypatch, capsys):
    """Run `era demo --json` in this process; returns exit status, output and errors."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(table_cache))
    monkeypatch.chdir(tmp_path)

    def run_demo(*arguments):
        status = run_era(["demo", *map(str, arguments), "--out", str(tmp_path), "--json"])
        printed = capsys.readouterr()
        return status, printed.out, printed.err

    return run_demo


@pytest.mark.real_time
def test_demo_reports_a_far_end_that_ended(capture, demo, monkeypatch):
    """Killing the amplifiers' process midway ends the run with status 3 and one paragraph."""
    wait_long(monkeypatch)
    far_ends = []

    async def start(*arguments, **options):
        far_ends.append(await start_far_end(*arguments, **options))
        return far_ends[-1]

    def killing(*arguments, on_row):
        return TouchRecorder(*arguments, on_row=lambda row: far_ends[0].kill())

    start_far_end = controller.demo.simulated_plate.start_simulation
    monkeypatch.setattr(controller.demo.simulated_plate, "start_simulation", start)
    monkeypatch.setattr(controller.demo.demonstration, "TouchRecorder", killing)
    status, out, errors = demo("--real-time", "--touches", capture)
    assert status == 3, errors
    assert len(errors.strip().split("\n\n")) == 1
    assert out == ""


def test_far_end_ends_when_the_demo_is_killed(capture, table_cache, tmp_path):
    """After SIGKILL of the command, the amplifiers' process ends by itself."""
    with subprocess.Popen(
        [str(ERA), "demo", "--real-time", "--touches", str(capture), "--out", str(tmp_path)],
        env=os.environ | {"XDG_CACHE_HOME": str(table_cache)},
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
    ) as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        far_end = int(wait_for(lambda: children.read_text().split(), timeout=60)[0])
        process.kill()
    try:
        wait_for(lambda: not is_running(far_end), timeout=60)
    finally:
        with suppress(ProcessLookupError):
            os.kill(far_end, signal.SIGKILL)


def is_running(pid):
    """Whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.long
def test_page_and_daemon(tmp_path: Path) -> None:
    """It prints the page's URL with its token, its daemon is disarmed; Ctrl-C leaves nothing."""
    environment = os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)}
    socket = tmp_path / "era-haptics" / "daemon.sock"
    with subprocess.Popen(
        [sys.executable, live_demonstration.__file__],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            line = process.stdout.readline()
            assert re.fullmatch(r"dashboard: http://127\.0\.0\.1:\d+/#token=[\w-]{22,}\n", line)
            with Client.connect(socket, timeout=60) as daemon:
                assert wait_for_state(daemon, READY, ENABLED) == READY
                assert daemon.hello("test").rig.simulated
                assert daemon.status().watchdog_s == 2.0
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        finally:
            process.kill()
    assert not socket.exists()
