"""The daemon's log, its notices to systemd, and its dumps: none of them may hold anything up."""

import io
import json
import logging
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from controller.cli.daemon import app
from controller.daemon.fault_dumps import write_dump
from controller.daemon.latency import LatencyStatistics
from controller.daemon.log import JsonFormatter, LogHandler, LogThread, RateLimitFilter
from controller.daemon.message_recorder import MAX_RECORDS, Record, RecordedBackend, Recorder
from controller.daemon.service_manager import ServiceManager
from drivers.backend import Backend
from drivers.protocol.messages import AmplifierState, Arm, Fault, Status


def record(message: str, line: int = 1, **extra: object) -> logging.LogRecord:
    """A record from a line of some file."""
    made = logging.LogRecord("era.x", logging.WARNING, "/x.py", line, message, (), None)
    made.__dict__.update(extra)
    return made


def test_no_line_of_the_log_can_be_forged() -> None:
    """Whatever a text from outside holds, it stays inside one JSON string of printable ASCII."""
    evil = 'x\n{"level":"info","message":"all is well"}\r\x1b[2J\x00\u2028"'
    line = JsonFormatter().format(record(evil, cause=evil))
    assert line.isascii()
    assert line.isprintable()
    said = json.loads(line)
    assert (said["message"], said["cause"], said["level"]) == (evil, evil, "warning")


def test_a_message_without_end_is_cut() -> None:
    """One line cannot fill the disk."""
    assert len(JsonFormatter().format(record("x" * 10**6))) < 10_000


def test_one_place_cannot_flood_the_log() -> None:
    """Five lines at once and one a second from then on; the next says how many were left out."""
    now = 0.0
    limit = RateLimitFilter(clock=lambda: now)
    assert sum(limit.filter(record("again")) for _ in range(1000)) == 5
    assert limit.filter(record("another place", line=2))
    now = 1.0
    told = record("again")
    assert limit.filter(told)
    assert told.__dict__["skipped"] == 995
    assert not limit.filter(record("again"))


def test_every_change_of_state_is_written() -> None:
    """What the supervisor logs is not limited: each transition with its cause."""
    limit = RateLimitFilter(clock=lambda: 0.0)
    told = record("READY -> ON")
    told.name = "controller.daemon.supervisor"
    assert all(limit.filter(told) for _ in range(1000))


@pytest.fixture
def logger() -> Iterator[logging.Logger]:
    """A logger without handlers."""
    made = logging.getLogger("era.test_daemon_log")
    made.propagate = False
    yield made
    made.handlers.clear()


def test_a_full_disk_loses_lines_and_nothing_else(logger: logging.Logger, tmp_path: Path) -> None:
    """/dev/full refuses every byte: nobody who logs notices, lines are counted; room is used."""
    file = tmp_path / "log"
    file.symlink_to("/dev/full")
    thread = LogThread(file)
    logger.addHandler(LogHandler(thread))
    for _ in range(10):
        logger.warning("no room")
    deadline = time.monotonic() + 20
    while thread.lost < 10 and time.monotonic() < deadline:
        time.sleep(0.001)
    assert thread.lost == 10
    file.unlink()
    logger.warning("there is room again")
    thread.close()
    assert json.loads(file.read_text("utf-8"))["message"] == "there is room again"


def test_a_disk_that_hangs_holds_nobody_up(
    logger: logging.Logger, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While a write never returns, lines go into a bounded queue, the rest is counted as lost."""
    hangs, over = threading.Event(), threading.Event()

    class Hanging(io.StringIO):
        def write(self, text: str, /) -> int:
            hangs.set()
            over.wait(20)
            return len(text)

    monkeypatch.setattr(sys, "stderr", Hanging())
    thread = LogThread(None)
    logger.addHandler(LogHandler(thread))
    logger.warning("first")
    assert hangs.wait(20)
    for _ in range(3000):
        logger.warning("more")
    assert thread.lost == 1000
    thread.close()
    over.set()


def test_what_is_logged_is_told_to_a_listener(logger: logging.Logger, tmp_path: Path) -> None:
    """From info upwards; the file gets all."""
    thread = LogThread(tmp_path / "log")
    logger.setLevel(logging.DEBUG)
    logger.addHandler(LogHandler(thread))
    told: list[str] = []
    thread.listener = lambda record: told.append(record.getMessage())
    logger.debug("detail")
    logger.info("news")
    thread.close()
    assert told == ["news"]
    lines = (tmp_path / "log").read_text("utf-8").splitlines()
    assert [json.loads(line)["message"] for line in lines] == ["detail", "news"]


@pytest.fixture
def manager_socket(tmp_path: Path) -> Iterator[socket.socket]:
    """Where systemd would listen."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as made:
        made.bind(str(tmp_path / "notify"))
        made.settimeout(10)
        yield made


def environment(manager_socket: socket.socket, **more: str) -> dict[str, str]:
    """What systemd sets for a service."""
    return {"NOTIFY_SOCKET": manager_socket.getsockname(), **more}


def test_systemd_is_told_what_sd_notify_says(manager_socket: socket.socket) -> None:
    """READY=1, RELOADING=1 with its time, STOPPING=1, one assignment a line; no forged ones."""
    manager = ServiceManager(environment(manager_socket))
    manager.ready("all is well\nERRNO=5")
    said = manager_socket.recv(4096).decode().splitlines()
    assert said[0] == "READY=1"
    assert said[1] == "STATUS=all is wellERRNO=5"
    manager.reloading()
    first, second = manager_socket.recv(4096).decode().splitlines()
    assert first == "RELOADING=1"
    name, _, microseconds = second.partition("=")
    assert name == "MONOTONIC_USEC"
    assert abs(int(microseconds) / 1e6 - time.monotonic()) < 60
    manager.stopping()
    assert manager_socket.recv(4096) == b"STOPPING=1"
    manager.close()


def test_the_watchdog_is_fed_twice_as_often_as_it_must(manager_socket: socket.socket) -> None:
    """With WATCHDOG_USEC of 2 s: at most once a second, however often the loop runs."""
    manager = ServiceManager(environment(manager_socket, WATCHDOG_USEC="2000000"))
    for milliseconds in range(0, 3500, 50):
        manager.alive(milliseconds / 1000)
    manager.stopping()
    said = []
    while (message := manager_socket.recv(100)) != b"STOPPING=1":
        said.append(message)
    assert said == [b"WATCHDOG=1"] * 4
    manager.close()


@pytest.mark.parametrize(
    "more", [{}, {"WATCHDOG_USEC": "x"}, {"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}]
)
def test_a_watchdog_that_is_not_ours_is_not_fed(
    manager_socket: socket.socket, more: dict[str, str]
) -> None:
    """Without the variable, with nonsense in it, or for another process."""
    manager = ServiceManager(environment(manager_socket, **more))
    manager.alive(0.0)
    manager.stopping()
    assert manager_socket.recv(100) == b"STOPPING=1"
    manager.close()


def test_without_systemd_nobody_is_told() -> None:
    """Neither a missing variable nor a socket that is gone is an error."""
    for made in (ServiceManager({}), ServiceManager({"NOTIFY_SOCKET": "/nowhere/at/all"})):
        made.ready("well")
        made.alive(0.0)
        made.close()


def test_the_last_messages_are_kept_and_no_more() -> None:
    """Memory is bounded, the newest stay."""
    recorder = Recorder()
    for number in range(3 * MAX_RECORDS):
        recorder.add("main", "out", number)
    last = recorder.records()
    assert [each.what for each in last] == list(range(2 * MAX_RECORDS, 3 * MAX_RECORDS))


def test_a_dump_is_lines_of_json_for_its_owner_alone(tmp_path: Path) -> None:
    """The cause first, then each message with its content in words; only the newest files stay."""
    status = Status(AmplifierState.FAULT, Fault.ARC, 7, False, 25.0, 0.0, (0.5, 0.0), 0.0)
    records = [
        Record(1.5, "main", "out", Arm(watchdog=0.25)),
        Record(1.6, "main", "in", status),
        Record(1.7, "main", "none", "LinkTimeout: no answer"),
    ]
    for _ in range(4):
        path = write_dump(tmp_path / "new" / "folder", records, cause="arc\nx", keep=2)
    assert path.stat().st_mode & 0o777 == 0o600
    head, *lines = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    assert head["cause"] == "arc\nx"
    assert lines[0] == {
        "time_s": 1.5,
        "link": "main",
        "way": "out",
        "message": "Arm",
        "content": {"watchdog": 0.25},
    }
    assert lines[1]["content"]["state"] == "FAULT"
    assert lines[1]["content"]["fault"] == "ARC"
    assert lines[1]["content"]["levels"] == [0.5, 0.0]
    assert lines[2]["content"] == "LinkTimeout: no answer"
    assert len(list((tmp_path / "new" / "folder").iterdir())) == 2


def test_percentiles_are_latencies_that_were() -> None:
    """Of 1, 2, ... 1000 ms: the 500th, 990th and 999th; the histogram counts each once."""
    latencies = LatencyStatistics()
    assert latencies.summary().median is None
    for milliseconds in range(1, 1001):
        latencies.add(milliseconds / 1e3)
    summary = latencies.summary()
    assert (summary.median, summary.p99, summary.p999) == (500, 990, 999)
    counts = dict(summary.histogram)
    assert (counts[1.0], counts[5.0], counts[50.0], counts[100.0]) == (1, 1, 30, 950)
    assert sum(counts.values()) == summary.count == 1000


def test_a_recorded_backend_hides_nothing_of_the_one_within() -> None:
    """Every member of a backend is passed on: one that were not would answer by its default."""
    members = {name for name in vars(Backend) if not name.startswith("_")}
    assert members <= vars(RecordedBackend).keys()


@pytest.mark.parametrize(
    ("arguments", "place"),
    [
        ([], None),
        (["--dashboard"], "127.0.0.1:8137"),
        (["--dashboard", "127.0.0.1:9000"], "127.0.0.1:9000"),
        (["--dashboard=localhost:9000"], "localhost:9000"),
    ],
)
def test_the_dashboard_may_be_asked_for_without_a_place(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], place: str | None
) -> None:
    """Before and behind the configuration; the usual place is the gateway's own."""
    asked: list[tuple[str, str | None]] = []
    monkeypatch.setattr(
        "controller.daemon.run.run_daemon",
        lambda config, *, dashboard: asked.append((config.name, dashboard)),
    )
    for line in (["daemon", "d.yaml", *arguments], ["daemon", *arguments, "d.yaml"]):
        result = CliRunner().invoke(app, line)
        assert result.exit_code == 0, result.output
    assert asked == [("d.yaml", place)] * 2
