"""When dumps are written, and failing disks."""

import logging
import threading
from pathlib import Path

import pytest

from controller.daemon.fault_dumps import DUMP_PATTERN, FaultDumps
from controller.daemon.message_recorder import MessageRecorder
from drivers import clock


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time [s] that the dumps see."""
    times = [0.0]
    monkeypatch.setattr(clock, "now", lambda: times[0])
    return times


def _writers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "dump"]


def wait_for_writers() -> None:
    """Wait until all dumps are written."""
    for thread in _writers():
        thread.join(20)


def test_dump_is_written_once_per_second(tmp_path: Path, now: list[float]) -> None:
    """Faults within a second of a dump are part of it."""
    dumps = FaultDumps(MessageRecorder())
    for now[0], files in ((0.0, 1), (0.5, 1), (1.0, 2)):
        dumps.write(tmp_path, cause="arc", keep=5)
        wait_for_writers()
        assert len(list(tmp_path.glob(DUMP_PATTERN))) == files


def test_dump_that_fails_is_only_logged(
    tmp_path: Path, now: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    """A file in place of the folder raises nothing at the daemon."""
    (tmp_path / "dumps").write_text("in the way", "utf-8")
    FaultDumps(MessageRecorder()).write(tmp_path / "dumps", cause="arc", keep=5)
    wait_for_writers()
    (warning,) = caplog.messages
    assert str(tmp_path / "dumps") in warning


def test_dumps_use_one_thread_when_disk_hangs(
    tmp_path: Path,
    now: list[float],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Further dumps are skipped with a warning until the disk works again."""
    hangs, released = threading.Event(), threading.Event()

    def hang(*args: object, **kwargs: object) -> Path:
        hangs.set()
        released.wait(20)
        return tmp_path

    dumps = FaultDumps(MessageRecorder())
    with monkeypatch.context() as patched, caplog.at_level(logging.WARNING):
        patched.setattr("controller.daemon.fault_dumps.write_dump", hang)
        for now[0] in (0.0, 10.0, 20.0):
            dumps.write(tmp_path, cause="arc", keep=5)
        assert hangs.wait(20)
        assert len(_writers()) == 1
        assert len(caplog.messages) == 2
        released.set()
        wait_for_writers()
    now[0] = 30.0
    dumps.write(tmp_path, cause="arc", keep=5)
    wait_for_writers()
    assert len(list(tmp_path.glob(DUMP_PATTERN))) == 1
