"""`era daemon` as a process over real wires, and clients whose fingers are felt.

The far end runs in the test's own process, so that its amplifier's clock can be read: it is
time.monotonic(), the same for all processes.
"""

import asyncio
import contextlib
import json
import os
import sys
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

from controller.api.client import AsyncClient
from controller.api.jsonrpc import RpcError
from daemon_bench import (
    ENABLED,
    PATIENCE,
    daemon_table,
    far_end,
    holding,
    ready,
    until,
    write_daemon,
)
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import unpack_layers
from installed_program import ERA
from model.table.table_file import save_table
from patient_daemon import PROGRAM
from rig_on_wire import FarSide
from sim.amplifier.simulated_amplifier import Amplifier

FEEDING = ("Ping", "Set", "Commit", "Silence", "Arm", "Disarm", "Stop")
"""What a host that is alive sends while something may play."""


@dataclass(frozen=True)
class Asked:
    """A request that an amplifier got at a time [s], and its levels thereafter.

    is_refused: whether it refused the request.
    """

    time: float
    amplifier: str
    name: str
    values: Values
    is_refused: bool
    levels: tuple[float, ...]

    @property
    def raises(self) -> bool:
        """Whether it is a set, of one part, that asks for more than silence."""
        if self.name != "Set" or self.values["parts"] > 1:
            return self.name == "Set"
        layers = unpack_layers(self.values["stream"])
        return any(command.is_driven for one in layers for command in one.commands)


class Journal:
    """Listens at a far end from now on."""

    def __init__(self, far: FarSide) -> None:
        self.entries: list[Asked] = []
        self._far = far
        exchange = far.bench.exchange

        def noted(amplifier: str, name: str, values: Values, *, now: float) -> Any:
            is_refused = False
            try:
                return exchange(amplifier, name, values, now=now)
            except Refusal:
                is_refused = True
                raise
            finally:
                at = far.bench.time
                levels = far.bench.amplifiers[amplifier].summary(at).levels
                self.entries.append(Asked(at, amplifier, name, values, is_refused, levels))

        far.bench.exchange = noted  # type: ignore[method-assign]

    async def hear(self, requests: int) -> None:
        """Wait until so many more requests have come; a heartbeat comes every 50 ms."""
        enough = len(self.entries) + requests
        await until(lambda: len(self.entries) >= enough)

    def since(self, time: float) -> list[Asked]:
        """What was asked after a time [s]."""
        return [entry for entry in self.entries if entry.time > time]

    def raising_since(self, time: float) -> list[Asked]:
        """The sets after a time [s] that ask for more than silence."""
        return [entry for entry in self.since(time) if entry.raises]

    def last_fed(self, amplifier: str) -> float:
        """When [s] one of them has taken something that feeds its watchdog, for the last time."""
        return max(
            entry.time
            for entry in self.entries
            if entry.amplifier == amplifier and entry.name in FEEDING and not entry.is_refused
        )

    def widest_gap(self, since: float, until: float) -> float:
        """The longest time [s] between two signs of life in a window."""
        times = [e.time for e in self.since(since) if e.name in FEEDING]
        moments = [since, *(time for time in times if time <= until), until]
        return max(later - earlier for earlier, later in pairwise(moments))


def energised(far: FarSide) -> list[str]:
    """The amplifiers that are enabled now, or on their way out of it, or still audible."""
    summaries = {name: far.summary(name) for name in far.devices}
    alive = ("OPERATION_ENABLED", "SWITCHED_ON", "FAULT_REACTION_ACTIVE")
    return [name for name, one in summaries.items() if one.state in alive or any(one.levels)]


def silent_from(far: FarSide) -> float:
    """When [s] every channel of every amplifier is silent, or was; -inf where none ever played."""
    return max(silent_from_of(far, name) for name in far.devices)


def silent_from_of(far: FarSide, name: str) -> float:
    """The same of one amplifier; what has faded is no longer among its tones."""
    far.summary()
    one = cast(Amplifier, far.bench.amplifiers[name])
    ends = [tone.silent_from for output in one.outputs for tone in output]
    return max([one._silent_from, *ends])


def loudness(far: FarSide) -> float:
    """The highest level of any channel now."""
    return max(max(far.summary(name).levels) for name in far.devices)


STARTING = 180.0  # s; for a loaded machine
WATCHDOG, REACTION = 0.25, 0.005  # s; the longest time of an amplifier to be silent


class NotServing(AssertionError):
    """A daemon exited before it served: a bug, or no reply in time on a loaded machine."""


@dataclass
class DaemonProcess:
    """A serving or starting daemon."""

    process: asyncio.subprocess.Process
    socket: Path
    far: FarSide
    log: list[dict[str, object]] = field(default_factory=list)

    async def client(self) -> AsyncClient:
        """Connect a client."""
        return await AsyncClient.connect(self.socket, name="test", timeout=PATIENCE)

    async def status(self) -> int:
        """Wait for its exit status."""
        return await asyncio.wait_for(self.process.wait(), PATIENCE)

    def has_logged(self, text: str) -> bool:
        """Whether a text is in its log."""
        return any(text in json.dumps(line) for line in self.log)

    async def serves(self) -> None:
        """Wait until it serves; raises NotServing if it exits instead."""
        await until(
            lambda: self.has_logged("serving at") or self.process.returncode is not None,
            patience=STARTING,
        )
        if self.process.returncode is not None:
            raise NotServing(str(self.log))


@asynccontextmanager
async def daemon_process(
    folder: Path,
    far: FarSide,
    more: str = "",
    *,
    program: Sequence[str | Path] = (ERA,),
    options: Sequence[str] = (),
    environment: dict[str, str] | None = None,
    changes: Sequence[tuple[str, str]] = (),
    waits: bool = True,
) -> AsyncIterator[DaemonProcess]:
    """Run `era daemon` of a file with these further lines, at most until the context ends.

    program: the command before `daemon`; changes: replacements in the rig's text; waits: until it
    serves.
    """
    save_table(daemon_table(), folder / "table.npz")
    config = write_daemon(folder, dict(far.urls), f"table: table.npz\n{more}", changes=changes)
    process = await asyncio.create_subprocess_exec(
        *(*program, "daemon", str(config), *options),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        env={**os.environ, **(environment or {})},
    )
    assert process.stderr is not None
    made = DaemonProcess(process, folder / "era.sock", far)
    reading = asyncio.create_task(_read_log(process.stderr, made.log))
    try:
        if waits:
            await made.serves()
        yield made
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()
        await reading


async def _read_log(stream: asyncio.StreamReader, log: list[dict[str, object]]) -> None:
    while line := await stream.readline():
        try:
            log.append(json.loads(line))
        except ValueError:
            log.append({"no json": line.decode()})


async def run_era(*arguments: object) -> tuple[int, str, str]:
    """Run another `era` command; return exit status, stdout and stderr."""
    process = await asyncio.create_subprocess_exec(
        *(ERA, *map(str, arguments)),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    out, err = await asyncio.wait_for(process.communicate(), 3 * PATIENCE)
    assert process.returncode is not None
    return process.returncode, out.decode(), err.decode()


async def disarmed(era: AsyncClient) -> None:
    """Disarm and wait until ready; a loss of the link disarms as well."""
    with contextlib.suppress(RpcError):
        await era.disarm()
    await ready(era)


async def armed(era: AsyncClient) -> None:
    """Arm; again after a loss of the link, as may happen on a loaded machine."""
    end = time.monotonic() + STARTING
    while (await era.status()).state != ENABLED:
        assert time.monotonic() < end, "cannot be armed"
        await ready(era)
        with contextlib.suppress(RpcError):
            await era.arm("test", lease_s=60)


async def play(era: AsyncClient, far: FarSide) -> None:
    """Arm and wait until the amplifier plays for a resting finger; again after a loss."""
    end = time.monotonic() + STARTING
    while time.monotonic() < end:
        await armed(era)
        with contextlib.suppress(AssertionError):
            await until(lambda: loudness(far) > 0, patience=2.0)
            return
    raise AssertionError("nothing is played")


@asynccontextmanager
async def playing_daemon(
    folder: Path, more: str = "", *, waits: bool = True
) -> AsyncIterator[tuple[DaemonProcess, AsyncClient, Journal]]:
    """A daemon that waits for a busy machine, as of `daemon_process`, and plays for a finger.

    With the client that holds it down, and what the amplifier is asked.
    """
    async with (
        far_end(folder) as far,
        daemon_process(folder, far, more, program=PROGRAM, waits=waits) as daemon,
    ):
        journal = Journal(far)
        await until(daemon.socket.is_socket)
        async with await daemon.client() as era, holding(era):
            await play(era, far)
            yield daemon, era, journal


async def plays_on(
    what: str, daemon: DaemonProcess, era: AsyncClient, journal: Journal, *, seconds: float = 0.6
) -> None:
    """Assert that it stays enabled for a period, and tell the widest gap between signs of life.

    By a daemon that waits for a busy machine, see `patient_daemon`. what: the disturbance, for the
    printed figure.
    """
    await play(era, daemon.far)
    begin = time.monotonic()
    while time.monotonic() < begin + seconds:
        assert (await era.status()).state == ENABLED
        await asyncio.sleep(0.05)
    tell(f"between signs of life, {what}", journal.widest_gap(begin, time.monotonic()))


def tell(what: str, seconds: float) -> None:
    """Print a measured time; it is not asserted, for other programs on the machine lengthen it."""
    sys.stdout.write(f"\nmeasured: {what}: {1e3 * seconds:.1f} ms\n")
