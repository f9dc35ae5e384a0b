"""One measurement: start all processes, arm, touch, and match commands to touches."""

import contextlib
import json
import os
import socket
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.latency.machine import Others
from benchmarks.latency.match import Command, Expected, Matched, match, read_commands
from benchmarks.latency.programs import TIMEOUT, Ended, Program, Rank, module
from benchmarks.latency.touches import WANDERS, Work
from controller.api.client import Client
from controller.api.jsonrpc import RpcError
from controller.api.schema import LatencySummary
from controller.loop.capabilities import PlaybackCapabilities, playback_capabilities
from controller.loop.envelopes import RAMPS_ONLY
from drivers.host.ledger import Ledger
from drivers.host.serial_wire import SerialWire
from model.rig.file import example_rig_path, load_rig
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from registry.limits import GuardLimits
from sim.amplifier.readings import capabilities

FLOOD_RATE = 10_000  # Hz
WORKERS = 2  # programs at work in the loaded case, one for each core
ATTEMPTS = 2  # per case
_SETTLE = 1.0  # s

DAEMON: Sequence[object] = module("daemon")
"""The program that is measured, without its arguments."""


@dataclass(frozen=True)
class Case:
    """A case: touches; whether the machine is loaded; touch_wait [ms]: longest of a touch for
    its shaped onset, None for the baseline; wire: `tcp` or `pty`."""

    name: str
    work: Work
    is_loaded: bool
    touch_wait: float | None
    wire: str = "tcp"


@dataclass(frozen=True)
class Found:
    """Result of a case; own: latencies reported by the daemon, None for the baseline.

    sent: number of datagrams; computed [s]: processor time of the daemon; others: processors kept
    busy by other programs; is_urgent: whether all priorities were permitted.
    """

    case: Case
    matched: Matched
    own: LatencySummary | None
    sent: int
    computed: float
    others: float
    is_urgent: bool


@dataclass(frozen=True)
class Failed:
    """A case that could not be measured, with the reason of each attempt."""

    case: Case
    why: tuple[str, ...]


class Disturbed(Exception):
    """The machine was too busy to measure."""


class _OpenLine:
    """A serial line as fast as that of the far end."""

    def __init__(self) -> None:
        self.wire = SerialWire(921_600, sequence=0)


class _Open:
    """An amplifier on a line of its own, as far as it decides the pattern."""

    def __init__(self, limits: GuardLimits) -> None:
        self.capabilities = capabilities(4)
        self.ledger = Ledger(limits, self.capabilities)
        self.line = _OpenLine()


def attempt(
    case: Case,
    measured: Callable[[], Found],
    *,
    attempts: int = ATTEMPTS,
) -> Found | Failed:
    """Measure a case, again if it is disturbed."""
    why: list[str] = []
    while len(why) < attempts:
        try:
            return measured()
        # Errors of a daemon that has lost its amplifier or has too little time.
        except (Disturbed, Ended, RpcError, OSError) as error:
            # The error of disarming afterwards is only a consequence.
            first = error.__context__ if isinstance(error.__context__, Disturbed) else error
            why.append(f"{first} (load average {os.getloadavg()[0]:.1f})")
    return Failed(case, tuple(why))


def measure(case: Case, table_file: Path, table: LocalizationTable) -> Found:
    """Run one case; table: as in its file. Raises Disturbed, Ended, RpcError and OSError."""
    with tempfile.TemporaryDirectory(prefix="era-latency-") as name, contextlib.ExitStack() as all_:
        folder = Path(name)
        rig_file, seen, sent_file = folder / "rig.yaml", folder / "seen.jsonl", folder / "sent.npy"
        rig_file.write_text(example_rig_path().read_text("utf-8"), "utf-8")
        far = Program(all_, *module("far_end"), rig_file, seen, case.wire, rank=Rank.DEVICE)
        urls = far.line().split()
        path = folder / "socket"
        daemon: Client | None = None
        if case.touch_wait is None:
            plain = Program(all_, *module("plain"), rig_file, *urls, path, rank=Rank.SERVICE)
            port, tested = int(plain.line()), plain
        else:
            port = _free_port()
            arguments = (1e-3 * case.touch_wait, _daemon_file(folder, urls, table_file, port))
            tested = Program(all_, *DAEMON, *arguments, rank=Rank.SERVICE)
            daemon = _client(all_, path, tested)
            all_.enter_context(daemon.armed("latency"))
        panel = Program(
            all_,
            *(*module("clients"), "panel", rig_file, port, sent_file),
            *astuple(case.work),
            rank=Rank.DEVICE,
        )
        panel.line()
        programs = [far, tested, panel]
        if case.is_loaded:
            flood = Program(all_, *module("clients"), "flood", path, rig_file, FLOOD_RATE)
            flood.line()
            programs.append(flood)
            programs += [Program(all_, *module("clients"), "work") for _ in range(WORKERS)]
        time.sleep(_SETTLE)
        others = Others(lambda: sum(program.computed() for program in programs))
        panel.tell("go")
        computed = -tested.computed()
        panel.line()
        computed += tested.computed()
        busy = others.processors()
        own = None
        if daemon is not None:
            status = daemon.status()
            if status.state != "OPERATION_ENABLED":
                raise Disturbed(
                    f"while others kept {busy:.1f} processors busy the daemon went to "
                    f"{status.state}: {status.cause}"
                )
            own = status.latency_ms
        panel.tell("done")
        panel.wait(TIMEOUT)
        far.finish()
        rig = load_rig(rig_file)
        sent = np.load(sent_file) * 1e-9
        read = map(json.loads, seen.read_text("utf-8").splitlines())
        commands = list(read_commands(read, rig.amplifiers))
    matched = _matched(case, commands, sent, rig, table)
    is_urgent = all(program.is_urgent for program in programs)
    return Found(case, matched, own, len(sent), computed, busy, is_urgent)


def _matched(
    case: Case,
    commands: Sequence[Command],
    sent: np.ndarray,
    rig: Rig,
    table: LocalizationTable,
) -> Matched:
    """Match the commands from the first touch on."""
    since = [each for each in commands if sent[0] <= each.time <= sent[-1] + LAST]
    if case.touch_wait is None:
        return match(
            since,
            sent,
            lambda touch, command: abs((touch + 1 & 0xFFFF) - command.sequence),
            first=lambda before, touch: touch,
        )
    capabilities = _capabilities(rig, case.touch_wait)
    # A hundredth of a millimetre may decide between equal patterns, and the flood's finger expires
    # if the flood gets no processor for 150 ms.
    floods = (0.0, WANDERS, None) if case.is_loaded else (None,)
    expected = [Expected(case.work, rig, table, capabilities, flooded=each) for each in floods]
    # A set with a late reply is sent again under its token.
    repeated = {id(each) for one, each in pairwise(since) if each.token == one.token}
    vibrating = [
        each
        for each in since
        if id(each) not in repeated and any(command.level > 0 for _, command in each.commands)
    ]
    return match(vibrating, sent, *(each.error for each in expected), first=expected[0].first)


LAST = 0.1  # s; a set may wait for a fade; fingers expire later, and silence has no touch


def _capabilities(rig: Rig, touch_wait: float) -> PlaybackCapabilities:
    opened: Any = {name: _Open(rig.limits) for name in rig.amplifiers}
    found = playback_capabilities(rig, opened)
    return found if touch_wait > 0 else replace(found, envelope_support=RAMPS_ONLY)


def _daemon_file(folder: Path, urls: Sequence[str], table: Path, port: int) -> Path:
    rig = folder / "rig.yaml"
    text = rig.read_text("utf-8")
    for url in urls:
        text = text.replace('"sim://"', f'"{url}"', 1)
    rig.write_text(text, "utf-8")
    path = folder / "daemon.yaml"
    path.write_text(
        f"rig: rig.yaml\nsocket: socket\ntable: {table}\n"
        f"touch:\n  - {{name: panel, url: 'tuio:127.0.0.1:{port}'}}\nlog: {{level: warning}}\n",
        "utf-8",
    )
    return path


def _client(stack: contextlib.ExitStack, path: Path, serving: Program) -> Client:
    """Connect to the daemon once it is ready to be armed, until the stack ends."""
    end = time.monotonic() + TIMEOUT
    client: Client | None = None
    while time.monotonic() < end:
        serving.check()
        if client is None:
            with contextlib.suppress(OSError):
                client = stack.enter_context(Client.connect(path, name="latency"))
        elif client.status().state == "READY_TO_SWITCH_ON":
            return client
        time.sleep(0.05)
    raise Disturbed(f"the daemon was not ready within {TIMEOUT:g} s")


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.bind(("127.0.0.1", 0))
        return int(line.getsockname()[1])
