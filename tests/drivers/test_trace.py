"""The trace of wires."""

import io
import os
import re
import stat
import threading
from pathlib import Path

import pytest

from drivers import trace
from drivers.errors import CommandError
from drivers.trace import Direction, TraceWriter, tracing
from long_form import full_disk


def fail() -> str:
    """Fail to decode."""
    raise ValueError("no such type")


def test_trace_has_time_direction_bytes_and_meaning(tmp_path: Path) -> None:
    """A line each, only while the context lasts; a frame that cannot be decoded is shown too."""
    path = tmp_path / "trace.txt"
    trace.frame(Direction.OUT, b"\x01", "before", lambda: "before")
    with tracing(path):
        trace.frame(Direction.OUT, b"\x2c\x01", "serial:///dev/x", lambda: "Ping()")
        trace.frame(Direction.IN, b"\xff", "serial:///dev/x", fail)
        trace.request("Ping()", "Status", 0.0123)
    trace.frame(Direction.OUT, b"\x01", "after", lambda: "after")
    lines = path.read_text("utf-8").splitlines()
    time = re.compile(r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}\+00:00 ")
    assert all(time.match(line) for line in lines)
    assert [time.sub("", line) for line in lines] == [
        "wire serial:///dev/x > 2c 01  Ping()",
        "wire serial:///dev/x < ff  not decoded: no such type",
        "request Ping() -> 'Status' in 12.3 ms",
    ]
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


class SlowFile(io.StringIO):
    """A file that does not take more until it may."""

    def __init__(self) -> None:
        super().__init__()
        self.may_go_on = threading.Event()
        self.is_writing = threading.Event()
        self.text = ""

    def write(self, text: str) -> int:
        self.is_writing.set()
        self.may_go_on.wait(60)
        self.text += text
        return len(text)


def test_slow_file_drops_and_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The caller never waits; the number of dropped records stands in the file."""
    monkeypatch.setattr(trace, "MAX_PENDING", 10)
    file = SlowFile()
    writer = TraceWriter(file)
    trace._writers.append(writer)
    trace.frame(Direction.OUT, b"", "first", str)
    assert file.is_writing.wait(60)
    for _ in range(25):
        trace.frame(Direction.OUT, b"", "later", str)
    assert writer.dropped == 15
    file.may_go_on.set()
    writer.close()
    trace._writers.remove(writer)
    assert file.text.count("later") == 10
    assert file.text.endswith("trace: 15 records dropped\n")


def test_full_disk_ends_only_the_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No exception of its thread, which would be printed over the result of a command."""
    raised: list[object] = []
    monkeypatch.setattr(threading, "excepthook", raised.append)
    with full_disk(), tracing(tmp_path / "trace.txt"):
        trace.frame(Direction.OUT, bytes(500), "serial:///dev/x", str)
    assert raised == []


@pytest.mark.parametrize("kind", ["fifo", "directory", "missing folder"])
def test_unusable_trace_file_is_refused(tmp_path: Path, kind: str) -> None:
    """At once, also a FIFO that nothing reads."""
    path = tmp_path / "trace"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "directory":
        path.mkdir()
    else:
        path /= "file"
    with pytest.raises(CommandError, match="trace file"), tracing(path):
        pass
