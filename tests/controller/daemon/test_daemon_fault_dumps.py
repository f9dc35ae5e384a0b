"""When dumps are written, and what a disk that hangs costs."""

import logging
import threading
from pathlib import Path

import pytest

from controller.daemon.fault_dumps import DUMP_PATTERN, FaultDumps
from controller.daemon.message_recorder import Recorder
from drivers import clock


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time [s] that the dumps see."""
    times = [0.0]
    monkeypatch.setattr(clock, "now", lambda: times[0])
    return times


def _writers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "dump"]


def test_faults_in_company_are_one_dump(tmp_path: Path, now: list[float]) -> None:
    """Within a second of a dump there is no other; after it there is."""
    dumps = FaultDumps(Recorder())
    for now[0], files in ((0.0, 1), (0.5, 1), (1.0, 2)):
        dumps.write(tmp_path, cause="arc", keep=5)
        for thread in _writers():
            thread.join(20)
        assert len(list(tmp_path.glob(DUMP_PATTERN))) == files


def test_a_disk_that_hangs_holds_one_thread_however_many_faults_come(
    tmp_path: Path,
    now: list[float],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Nobody waits for it, the log tells of dumps left out, and it goes on once the disk does."""
    begun, over = threading.Event(), threading.Event()

    def hang(*args: object, **kwargs: object) -> Path:
        begun.set()
        over.wait(20)
        return tmp_path

    dumps = FaultDumps(Recorder())
    with monkeypatch.context() as patched, caplog.at_level(logging.WARNING):
        patched.setattr("controller.daemon.fault_dumps.write_dump", hang)
        for now[0] in (0.0, 10.0, 20.0):
            dumps.write(tmp_path, cause="arc", keep=5)
        assert begun.wait(20)
        (writing,) = _writers()
        assert len(caplog.messages) == 2
        over.set()
        writing.join(20)
    now[0] = 30.0
    dumps.write(tmp_path, cause="arc", keep=5)
    for thread in _writers():
        thread.join(20)
    assert len(list(tmp_path.glob(DUMP_PATTERN))) == 1
