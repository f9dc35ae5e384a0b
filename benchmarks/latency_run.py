"""One measurement: every part a process of its own, started, armed, touched and taken apart."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.latency_match import Command, Expected, Matched, match
from benchmarks.latency_touches import Work
from controller.api.client import Client
from controller.api.parts import LatencySummary
from controller.means import Means, means_of
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Capabilities
from model.rig import Rig
from model.rig_file import example_rig_path, load_rig
from model.table import LocalizationTable
from sim.amplifier.amplifier import capabilities

FLOOD_RATE = 10_000  # Hz
WORKERS = 2  # programs at work in the loaded case, one for each core
NICE = -10  # as the unit that `era systemd install` prints
PATIENCE = 60.0  # s
_SETTLE = 1.0  # s


@dataclass(frozen=True)
class Case:
    """What is measured: the work; whether others flood and work; and touch_wait [ms] of the
    daemon, None for the plain exchange beside it."""

    name: str
    work: Work
    is_loaded: bool
    touch_wait: float | None


@dataclass(frozen=True)
class Found:
    """What came of it; own: what the daemon says itself, None for the plain exchange.

    sent: how many datagrams; computed [s]: processor time meanwhile; is_urgent: whether daemon and
    far end went before others.
    """

    case: Case
    matched: Matched
    own: LatencySummary | None
    sent: int
    computed: float
    is_urgent: bool


class Disturbed(Exception):
    """The machine was so busy with something else that nothing could be measured."""


@dataclass(frozen=True)
class _Open:
    """An amplifier as far as it decides what is played."""

    capabilities: Capabilities
    bus: str | None = None

    def loading_time(self, knots: int) -> float:
        """A pseudo-terminal takes no time."""
        return 0.0


def measure(case: Case, table_file: Path, table: LocalizationTable) -> Found:
    """Run one case; table: as in its file."""
    with tempfile.TemporaryDirectory(prefix="era-latency-") as name, contextlib.ExitStack() as all_:
        folder = Path(name)
        rig_file, seen, sent_file = folder / "rig.yaml", folder / "seen.jsonl", folder / "sent.npy"
        rig_file.write_text(example_rig_path().read_text("utf-8"), "utf-8")
        far = _Program(all_, *_module("far_end"), rig_file, seen, nice=NICE)
        url = far.line()
        path = folder / "socket"
        daemon: Client | None = None
        if case.touch_wait is None:
            plain = _Program(all_, *_module("plain"), rig_file, url, path, nice=NICE)
            port, tested = int(plain.line()), plain
        else:
            port = _free_port()
            config = _daemon_file(folder, url, table_file, port, case.touch_wait)
            tested = _Program(all_, _ERA, "daemon", config, nice=NICE)
            daemon = all_.enter_context(_client(path, tested))
            all_.enter_context(daemon.armed("latency"))
        panel = _Program(
            all_,
            *(*_module("clients"), "panel", rig_file, port),
            *(case.work.kind, case.work.count, case.work.rate, case.work.seed, sent_file),
        )
        panel.line()
        if case.is_loaded:
            flood = _Program(all_, *_module("clients"), "flood", path, rig_file, FLOOD_RATE)
            flood.line()
            for _ in range(WORKERS):
                _Program(all_, *_module("clients"), "work")
        time.sleep(_SETTLE)
        computed = -tested.computed()
        panel.tell("go")
        panel.wait(case.work.count / case.work.rate + PATIENCE)
        computed += tested.computed()
        own = None
        if daemon is not None:
            status = daemon.status()
            if status.state != "OPERATION_ENABLED":
                raise Disturbed(f"{case.name}: the daemon is in {status.state}: {status.cause}")
            own = status.latency_ms
        far.finish()
        rig = load_rig(rig_file)
        sent = np.load(sent_file) * 1e-9
        commands = [
            Command.read(json.loads(line), PROTOCOL.types["apply"])
            for line in seen.read_text("utf-8").splitlines()
        ]
    matched = _matched(case, commands, sent, rig, table)
    return Found(case, matched, own, len(sent), computed, tested.is_urgent)


def _matched(
    case: Case,
    commands: Sequence[Command],
    sent: np.ndarray,
    rig: Rig,
    table: LocalizationTable,
) -> Matched:
    """The commands from the first touch on, by the touches that they answer."""
    since = [each for each in commands if sent[0] <= each.time <= sent[-1] + LAST]
    if case.touch_wait is None:
        return match(
            since,
            sent,
            lambda touch, command: abs((touch + 1 & 0xFFFF) - command.sequence),
            first=lambda before, touch: touch,
        )
    expected = Expected(
        case.work, rig, table, _means(rig, case.touch_wait), is_flooded=case.is_loaded
    )
    # A set whose answer was late is sent once more, under its token.
    repeated = {id(each) for one, each in pairwise(since) if each.token == one.token}
    vibrating = [
        each
        for each in since
        if id(each) not in repeated and any(command.level > 0 for command in each.commands)
    ]
    return match(vibrating, sent, expected.error, first=expected.first)


LAST = 0.03  # s; after the last touch fingers expire, and silence answers none


def _means(rig: Rig, touch_wait: float) -> Means:
    opened = {name: _Open(capabilities(4)) for name in rig.amplifiers}
    return means_of(rig, opened, envelope_time=touch_wait * 1e-3)


def _daemon_file(folder: Path, url: str, table: Path, port: int, touch_wait: float) -> Path:
    rig = folder / "rig.yaml"
    rig.write_text(rig.read_text("utf-8").replace('"sim://"', f'"{url}"'), "utf-8")
    path = folder / "daemon.yaml"
    path.write_text(
        f"rig: rig.yaml\nsocket: socket\ntable: {table}\ntouch_wait: {touch_wait:g} ms\n"
        f"touch:\n  - {{name: panel, url: 'tuio:127.0.0.1:{port}'}}\nlog: {{level: warning}}\n",
        "utf-8",
    )
    return path


@contextlib.contextmanager
def _client(path: Path, serving: "_Program") -> Iterator[Client]:
    """A client of a daemon that has come up and can be armed."""
    end = time.monotonic() + PATIENCE
    while True:
        serving.check()
        with contextlib.suppress(OSError), Client.connect(path, name="latency") as client:
            while client.status().state != "READY_TO_SWITCH_ON":
                assert time.monotonic() < end, client.status()
                time.sleep(0.05)
            yield client
            return
        assert time.monotonic() < end, "the daemon does not come up"
        time.sleep(0.05)


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.bind(("127.0.0.1", 0))
        return int(line.getsockname()[1])


class _Program:
    """A process that ends with the stack; nice: how urgent it is, as far as that is allowed."""

    def __init__(self, stack: contextlib.ExitStack, *command: object, nice: int = 0) -> None:
        self._process = subprocess.Popen(
            list(map(str, command)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD},
            text=True,
            start_new_session=nice != 0,
        )
        self.is_urgent = False
        if nice:
            with contextlib.suppress(PermissionError):
                os.setpriority(os.PRIO_PROCESS, self._process.pid, nice)
                # Where sessions share the cores among them, nice counts within a session only.
                group = Path(f"/proc/{self._process.pid}/autogroup")
                if group.exists():
                    group.write_text(str(nice), "ascii")
                self.is_urgent = True
        stack.callback(self.end)

    def line(self) -> str:
        """The next line that it prints."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline().strip()
        assert line, "a part of the benchmark has ended early"
        return line

    def tell(self, text: str) -> None:
        """A line for it."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{text}\n")
        self._process.stdin.flush()

    def wait(self, timeout: float) -> None:
        """Until it has ended by itself."""
        assert self._process.wait(timeout) == 0

    def check(self) -> None:
        """Fail if it has ended."""
        assert self._process.poll() is None, "the daemon has ended; its log says why"

    def computed(self) -> float:
        """Processor time [s] so far; 0 where the system does not say."""
        file = Path(f"/proc/{self._process.pid}/schedstat")
        return int(file.read_text("ascii").split()[0]) * 1e-9 if file.exists() else 0.0

    def finish(self) -> None:
        """Let it write what it has seen, and go on."""
        self._process.send_signal(signal.SIGUSR1)
        self.line()

    def end(self) -> None:
        """Tell it to end, unless it has."""
        if self._process.poll() is None:
            self._process.terminate()
        self._process.wait(PATIENCE)
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()


def _module(name: str) -> tuple[str, ...]:
    return (sys.executable, "-m", f"benchmarks.latency_{name}")


_ERA = Path(sys.executable).with_name("era")
_ONE_THREAD: Mapping[str, str] = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
