"""The whole chain as a user starts it: touches in over UDP, amplifier on a wire, fingertips out."""

import asyncio
import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

import controller.demo.demonstration
import controller.demo.recorder
import live_demonstration
from controller.api.client import Client
from controller.cli.main import run
from controller.demo.demonstration import Scene, layout_of_people
from controller.demo.recorder import TouchRecorder
from controller.sources.tuio import read_capture
from gateway_bench import wait_for
from model.rig.rig_file import example_rig_path, load_rig
from patient_daemon import wait_long
from several_fingers import write_schedule
from typed_page import ERA
from virtual_lines import run_virtual

ERA_NAMES = {"SW", "SE", "NE", "NW"}

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
    path = tmp_path_factory.mktemp("touches") / "touches.tuio"
    return write_schedule(path, SCHEDULE, 2.1)


@pytest.fixture(scope="module")
def environment(table_cache):
    """The tests' own cache folder."""
    return os.environ | {"XDG_CACHE_HOME": str(table_cache)}


@pytest.fixture
def demo(environment, tmp_path, monkeypatch, capsys):
    """Run `era demo --json` in this process; returns exit status, output and errors."""
    monkeypatch.setenv("XDG_CACHE_HOME", environment["XDG_CACHE_HOME"])
    monkeypatch.chdir(tmp_path)

    def run_demo(*arguments):
        status = run(["demo", *map(str, arguments), "--out", str(tmp_path), "--json"])
        printed = capsys.readouterr()
        return status, printed.out, printed.err

    return run_demo


def test_demo_contacts_feel_the_prediction(capture, demo, monkeypatch):
    """Each touch has its row; level within 3 dB of the promise, contrast at least the promised.

    Of the first plate that is drawn, on which these touches keep it. Then the same as two people,
    by another layout of the daemon: both that are down together have a content each. Each
    scene is sent from a port of its own, which is no second program.
    In virtual time; what differs on wires is a far end of its own, see below.
    """
    monkeypatch.setattr(asyncio, "run", run_virtual)
    plate = load_rig(example_rig_path()).plate
    layout = layout_of_people(plate, {"left": None, "right": None})
    recorded = read_capture(capture)
    scenes = [Scene(recorded), Scene(recorded, layout)]
    monkeypatch.setattr(controller.demo.demonstration, "example_scenes", lambda rig: scenes)
    status, out, said = demo("--wire", "sim")
    assert (status, said) == (0, "")  # no hint either
    result = json.loads(out)
    rows, people = result["touches"][: len(SCHEDULE)], result["touches"][len(SCHEDULE) :]
    assert len(people) == len(SCHEDULE)
    assert not any("fingers" in row for row in (*rows, people[2]))
    one, other = people[1]["fingers"]
    assert [one["at_m"]] == people[0]["targets_m"]
    assert [other["at_m"]] == people[1]["targets_m"]
    assert abs(one["frequency_hz"] - other["frequency_hz"]) >= 30
    for finger in (one, other):
        assert finger["verdict"] in ("own", "mixed")
        promised, measured = finger["promised_contrast_db"], finger["measured_contrast_db"]
        assert 6 < promised < measured + 3 < promised + 23  # nine of ten plates keep it
        assert finger["measured_level_db_sl"] == pytest.approx(20, abs=3)
    for row, (_, _, _, x, y) in zip(rows, SCHEDULE, strict=True):
        assert row["targets_m"] == [[pytest.approx(x * 0.3048), pytest.approx((1 - y) * 0.2286)]]
        assert row["mode"] == "phased"
        assert row["drive"].keys() <= ERA_NAMES
        for tone in row["drive"].values():
            assert tone["frequency_hz"] in range(40, 501, 10)
            assert 0 < tone["level"] <= 1
        assert row["steady"]
        assert row["measured_level_db_sl"] == pytest.approx(row["predicted_level_db_sl"], abs=3)
        assert row["latency_ms"] > 0
    alone, beside, last = rows
    assert (alone["quiet_m"], last["quiet_m"]) == ([], [])
    assert alone["predicted_contrast_db"] is None
    # One is alone, and the other one's pattern took the place of another.
    assert alone["predicted_transient_contrast_db"] is None
    assert beside["measured_transient_contrast_db"] is None
    assert beside["quiet_m"] == alone["targets_m"]
    promised, measured = beside["promised_contrast_db"], beside["measured_contrast_db"]
    assert 3 < promised < beside["predicted_contrast_db"]
    assert promised <= measured < promised + 20
    pictures = [*map(Path, result["files"])]
    assert [each.name for each in pictures] == ["touches.png", "contents.png"]
    for picture in pictures:
        assert picture.read_bytes().startswith(b"\x89PNG")


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

    start_far_end = controller.demo.recorder._start
    monkeypatch.setattr(controller.demo.recorder, "_start", start)
    monkeypatch.setattr(controller.demo.demonstration, "TouchRecorder", killing)
    status, out, said = demo("--touches", capture)
    assert status == 3, said
    assert len(said.strip().split("\n\n")) == 1
    assert out == ""


def test_far_end_ends_when_the_demo_is_killed(capture, environment, tmp_path):
    """After SIGKILL of the command, the amplifiers' process ends by itself."""
    with subprocess.Popen(
        [str(ERA), "demo", "--touches", str(capture), "--out", str(tmp_path)],
        env=environment,
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
    ) as process:
        far_end = far_end_of(process.pid)
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


def far_end_of(pid):
    """The process that a running demonstration started for its amplifiers."""
    children = Path(f"/proc/{pid}/task/{pid}/children")
    return int(wait_for(lambda: children.read_text().split(), timeout=60)[0])


def test_page_and_daemon(tmp_path: Path) -> None:
    """It says where its page is, its daemon is disarmed and answers; Ctrl-C leaves nothing."""
    environment = os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)}
    socket = tmp_path / "era-haptics" / "daemon.sock"
    with subprocess.Popen(
        [sys.executable, live_demonstration.__file__],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            told = process.stdout.readline()
            assert told.startswith("dashboard: http://127.0.0.1:")
            assert told.endswith(f" (token in {socket.with_name('dashboard-token')})\n")
            with Client.connect(socket, timeout=60) as daemon:
                daemon.subscribe("state")
                while (state := daemon.status().state) != "READY_TO_SWITCH_ON":
                    assert state != "OPERATION_ENABLED"
                    next(daemon.events(timeout=60))
                assert daemon.hello("test").rig.simulated
                assert daemon.status().watchdog_s == 2.0
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        finally:
            process.kill()
    assert not socket.exists()
