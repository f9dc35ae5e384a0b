"""The daemon's log, notices to systemd, dumps and latencies; none may block the daemon."""

import errno
import io
import json
import logging
import socket
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from unittest.mock import Mock

import pytest

from chain import set_chain
from controller.daemon.messages import LatencyStatistics
from controller.operation.fault_dumps import DUMP_PATTERN, MAX_DUMPS, FaultDumps, write_dump
from controller.operation.operation_states import DaemonState, Operation
from controller.process.daemon_process import ServiceManager
from controller.process.log import LogFormatter, LogThread, RateLimitFilter
from drivers.wires.wire import Reply
from gateway_bench import wait_for
from interrupted import full_disk
from registry import threads
from virtual_lines import in_virtual_time

FAULT = Operation(DaemonState.FAULT, "arc")


def record(message: str, line: int = 1, **extra: object) -> logging.LogRecord:
    """A record of a logging call at a line."""
    made = logging.LogRecord("era.x", logging.WARNING, "/x.py", line, message, (), None)
    made.__dict__.update(extra)
    return made


def test_log_lines_cannot_be_forged_and_are_bounded() -> None:
    """Any text stays inside one JSON string of printable ASCII, and a long message is cut."""
    evil = 'x\n{"level":"info","message":"all is well"}\r\x1b[2J\x00\u2028"'
    line = LogFormatter().format(record(evil, cause=evil))
    assert line.isascii()
    assert line.isprintable()
    fields = json.loads(line)
    assert (fields["message"], fields["cause"], fields["level"]) == (evil, evil, "warning")
    assert len(LogFormatter().format(record("x" * 10**6))) < 10_000


def test_log_line_has_the_keys_of_its_page() -> None:
    """Time in UTC with milliseconds, level, logger, message, what a call adds, and a traceback."""
    made = record("link: %s", cause=OSError("gone"), remedy=None, skipped=3)
    made.args = ("lost",)
    made.created, made.msecs = 1_000_000_000.25, 250.0
    expected = {"time": "2001-09-09T01:46:40.250Z", "level": "warning", "logger": "era.x"}
    more = {"message": "link: lost", "cause": "gone", "remedy": None, "skipped": 3}
    assert json.loads(LogFormatter().format(made)) == {**expected, **more}
    try:
        raise ValueError("x" * 10**5)
    except ValueError:
        made.exc_info = sys.exc_info()
    fields = json.loads(LogFormatter().format(made))
    assert fields.keys() - expected.keys() - more.keys() == {"traceback"}
    assert fields["traceback"] == "x" * 8000


def test_log_limits_rate_of_each_call_except_state_changes() -> None:
    """Five lines at once, then one a second with the number skipped; transitions are unlimited."""
    now = 0.0
    limit = RateLimitFilter(clock=lambda: now)
    assert sum(limit.filter(record("again")) for _ in range(1000)) == 5
    assert limit.filter(record("another call", line=2))
    now = 1.0
    allowed = record("again")
    assert limit.filter(allowed)
    assert allowed.__dict__["skipped"] == 995
    assert not limit.filter(record("again"))
    transition = record("READY -> ON")
    transition.__dict__["topic"] = "state"
    assert all(limit.filter(transition) for _ in range(1000))


@pytest.fixture
def logger() -> Iterator[logging.Logger]:
    """A logger without handlers."""
    made = logging.getLogger("era.test_daemon_log")
    made.propagate = False
    yield made
    made.handlers.clear()


def test_log_does_not_block_while_disk_hangs(
    logger: logging.Logger, monkeypatch: pytest.MonkeyPatch
) -> None:
    """During a write that does not return, lines are queued up to a bound; clients get them all."""
    hangs, released = threading.Event(), threading.Event()

    class Hanging(io.StringIO):
        def write(self, text: str, /) -> int:
            hangs.set()
            released.wait(20)
            return len(text)

    monkeypatch.setattr(sys, "stderr", Hanging())
    thread, heard = LogThread(None), Mock()
    thread.subscriber = heard
    logger.addHandler(thread)
    logger.warning("first")
    assert hangs.wait(20)
    for _ in range(3000):
        logger.warning("more")
    assert thread.queue.qsize() == 2000
    assert heard.call_count == 3001
    thread.close()
    released.set()
    wait_for(lambda: not thread.queue.unfinished_tasks)  # or they go to the real standard error


def test_log_subscriber_gets_records_from_info_on(logger: logging.Logger, tmp_path: Path) -> None:
    """The file gets all of them."""
    thread = LogThread(tmp_path / "log")
    logger.setLevel(logging.DEBUG)
    logger.addHandler(thread)
    heard: list[str] = []
    thread.subscriber = lambda record: heard.append(record.getMessage())
    logger.debug("detail")
    logger.info("news")
    thread.close()
    assert heard == ["news"]
    lines = (tmp_path / "log").read_text("utf-8").splitlines()
    assert [json.loads(line)["message"] for line in lines] == ["detail", "news"]


def test_log_goes_on_after_a_line_that_cannot_be_written(
    logger: logging.Logger, tmp_path: Path
) -> None:
    """Where the folder of its file is missing for a while, what is logged meanwhile is lost."""
    file = tmp_path / "later" / "log"
    thread = LogThread(file)
    logger.addHandler(thread)
    logger.warning("lost")
    wait_for(lambda: not thread.queue.unfinished_tasks)
    file.parent.mkdir()
    logger.warning("after")
    thread.close()
    assert json.loads(file.read_text("utf-8"))["message"] == "after"


def test_full_disk_cuts_no_line_of_the_log(logger: logging.Logger, tmp_path: Path) -> None:
    """Each line is in the file as a whole or not at all, and a later one follows a whole one."""
    thread = LogThread(tmp_path / "log")
    logger.addHandler(thread)
    messages = [f"{number} {'x' * 300}" for number in range(5)]
    with full_disk(at=1024):  # bytes, amid the third line
        for each in messages:
            logger.warning(each)
        wait_for(lambda: not thread.queue.unfinished_tasks)
    logger.warning("after")
    thread.close()
    lines = (tmp_path / "log").read_text("utf-8").splitlines()
    assert [json.loads(line)["message"] for line in lines] == [*messages[:2], "after"]


def test_log_is_reopened_after_rotation(logger: logging.Logger, tmp_path: Path) -> None:
    """Lines after it are in a new file, which only its owner may read."""
    file, rotated = tmp_path / "log", tmp_path / "log.1"
    thread = LogThread(file)
    logger.addHandler(thread)
    logger.warning("before")
    wait_for(lambda: file.exists() and file.read_text("utf-8"))
    file.rename(rotated)
    logger.warning("after")
    thread.close()
    messages = [json.loads(each.read_text("utf-8"))["message"] for each in (rotated, file)]
    assert messages == ["before", "after"]
    assert file.stat().st_mode & 0o777 == 0o600


@pytest.fixture
def manager_socket(tmp_path: Path) -> Iterator[socket.socket]:
    """The socket of a service manager."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(str(tmp_path / "notify"))
        bound.settimeout(60)
        yield bound


@pytest.mark.parametrize(
    ("more", "count"),
    [
        ({"WATCHDOG_USEC": "2000000"}, 4),  # at 0, 1, 2 and 3 s
        ({}, 0),
        ({"WATCHDOG_USEC": "x"}, 0),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}, 0),
    ],
)
def test_service_manager_is_told_and_its_watchdog_fed_at_twice_its_rate(
    manager_socket: socket.socket,
    more: dict[str, str],
    count: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not one of another process, nor without a valid interval; no assignment can be forged.

    Fed when no descriptor is left, too.
    """
    with closing(ServiceManager({"NOTIFY_SOCKET": manager_socket.getsockname(), **more})) as told:
        monkeypatch.setattr(socket, "socket", Mock(side_effect=OSError(errno.EMFILE, "too many")))
        told.ready("all is well\nERRNO=5")
        assert manager_socket.recv(4096).startswith(b"READY=1\nSTATUS=all is wellERRNO=5")
        for milliseconds in range(0, 3500, 50):
            told.alive(milliseconds / 1000)
        told.notify("STOPPING=1")
    messages = []
    while (message := manager_socket.recv(100)) != b"STOPPING=1":
        messages.append(message)
    assert messages == [b"WATCHDOG=1"] * count


def test_service_manager_may_be_missing() -> None:
    """Neither a missing variable nor a missing socket is an error."""
    for environment in ({}, {"NOTIFY_SOCKET": "/nowhere/at/all"}):
        with closing(ServiceManager(environment)) as manager:
            manager.ready("well")
            manager.alive(0.0)


def message(time_s: float, way: str, name: str) -> dict[str, object]:
    """A message of amplifier main without its content."""
    return {"time_s": time_s, "link": "main", "way": way, "message": name}


def test_dump_is_json_lines_for_owner_only(tmp_path: Path) -> None:
    """The cause first, then each message with its content by name; only the newest files stay."""
    folder = tmp_path / "new" / "folder"
    records = [
        {**message(1.5, "out", "Arm"), "content": {"watchdog": 250, "session": 9}},
        {**message(1.6, "in", "Reply"), "content": Reply({"state": 6, "levels": [5000, 0]})},
        {**message(1.7, "none", "no reply"), "content": ""},
    ]
    for _ in range(MAX_DUMPS + 2):
        path = write_dump(folder, records, cause="arc\nx")
    assert path.stat().st_mode & 0o777 == 0o600
    head, *lines = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    assert head["cause"] == "arc\nx"
    where = {"time_s": 1.5, "link": "main", "way": "out"}
    assert lines[0] == {**where, "message": "Arm", "content": {"watchdog": 250, "session": 9}}
    assert lines[1]["content"] == {"state": 6, "levels": [5000, 0]}
    assert (lines[2]["way"], lines[2]["message"]) == ("none", "no reply")
    assert len(list(folder.iterdir())) == 20


def test_latency_percentiles_are_values_that_occurred() -> None:
    """Of 1, 2, ... 1000 ms the 500th, 990th and 999th; the histogram counts each once."""
    latencies = LatencyStatistics()
    assert latencies.summary().median is None
    for milliseconds in range(1, 1001):
        latencies.add(milliseconds / 1e3)
    summary = latencies.summary()
    assert (summary.median, summary.p99, summary.p999) == (500, 990, 999)
    counts = dict(summary.histogram)
    assert (counts[1.0], counts[5.0], counts[50.0], counts[100.0]) == (1, 1, 30, 950)
    assert sum(counts.values()) == summary.count == 1000


@in_virtual_time
async def test_failing_recorder_prevents_no_stop(tmp_path: Path) -> None:
    """The wire gets the Stop, and the caller its outcome."""

    def fail(record: Mapping[str, object]) -> None:
        raise MemoryError

    recorder = FaultDumps(tmp_path)
    async with set_chain(connected=recorder.follow) as chain:
        await chain.open()
        assert recorder._ring
        vars(recorder)["note"] = fail
        assert (await chain.controller.stop())["main"].is_confirmed
        assert chain.far_end.requests("Stop")
        await chain.close()


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time [s] that the dumps see."""
    times = [0.0]
    monkeypatch.setattr(threads, "now", lambda: times[0])
    return times


def _writers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "dump"]


def wait_for_writers() -> None:
    """Wait until all dumps are written."""
    for thread in _writers():
        thread.join(20)


def test_dump_that_fails_is_only_logged(
    tmp_path: Path, now: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    """A file in place of the folder raises nothing at the daemon."""
    (tmp_path / "dumps").write_text("in the way", "utf-8")
    FaultDumps(tmp_path / "dumps").state_changed(Operation(), FAULT)
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

    dumps = FaultDumps(tmp_path)
    with monkeypatch.context() as patched, caplog.at_level(logging.WARNING):
        patched.setattr("controller.operation.fault_dumps.write_dump", hang)
        for now[0] in (0.0, 10.0, 20.0):
            dumps.state_changed(Operation(), FAULT)
        assert hangs.wait(20)
        assert len(_writers()) == 1
        assert len(caplog.messages) == 2
        released.set()
        wait_for_writers()
    now[0] = 30.0
    dumps.state_changed(Operation(), FAULT)
    wait_for_writers()
    assert len(list(tmp_path.glob(DUMP_PATTERN))) == 1
