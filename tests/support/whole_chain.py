"""The whole chain in processes of its own: touches over UDP, daemon, wire, far end, fingertips.

The daemon has only the URLs of its amplifiers; every wire has a witness.
"""

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Collection, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import quote

from controller.api.client_protocol import Notification
from controller.api.jsonrpc import RpcError
from far_end_process import FarEndProcess, far_end_process
from heard import PATIENCE, SENSORS, Control, Heard, Refused, hear
from rig_files import write_rig
from sim.witness.endpoint import parse_endpoint
from sim.witness.violation import Violation
from sim.witness.witness import Witness
from sim.witness_relay import relays
from stream_daemon import LINK_FAILED, DidNotStart, RunningDaemon, running_daemon
from touch_stream import Stream, play_stream
from witness_config import witness_config

POLL = 0.01  # s
ATTEMPTS = 8
PROMPT = 0.1  # s; from touch to pattern event, on an idle machine
LOADING_LOGGER = "controller.loop.loading_times"
FREQUENCY_LIMITS, LEVEL_LIMIT = (40.0, 500.0), 1.0  # Hz; of the example's rig, written by hand

Polls: TypeAlias = list[tuple[float, list[float]]]
"""Times [s] of the far end, and the levels of all channels then."""


@dataclass(frozen=True)
class Played:
    """Results of a stream.

    polls: time [s] and levels of all channels, as the far end reports; violations, frames: of the
    witness, which no wire within a process has; exit_status: the daemon's; is_tired: whether it has
    found envelopes to take too long, and plays plain ramps from then on.
    """

    heard: list[Heard]
    polls: Polls
    violations: list[Violation]
    frames: int
    exit_status: int
    state: Mapping[str, Any]
    is_tired: bool


@dataclass
class Chain:
    """Daemon, wire and far end, ready to be armed."""

    folder: Path
    daemon: RunningDaemon
    control: Control
    witness: Witness | None

    async def play(self, stream: Stream) -> Played:
        """Play a stream, and repeat it while the machine is too busy for a valid result.

        Repeated where the daemon was late or has stopped all, or where a reply was late and the
        witness reports a violation. Ends the daemon.
        """
        sensors = {name: {"at_m": list(at)} for name, at in SENSORS.items()}
        await self.control.ask("sensors", sensors=sensors)
        await self.daemon.client.subscribe("pattern")
        capture = self.folder / "touches.tuio"
        stream.write(capture)
        heard: list[Heard] = []
        polls: Polls = []
        begin = 0.0
        for attempt in range(ATTEMPTS):
            await self._come_to_rest(0.0 if attempt == 0 else 2.0)
            begin, late = time.monotonic(), await self._late()
            try:
                heard, polls = await self._play(capture, stream)
            except (RpcError, Refused):  # a link was lost, or the request was more than 10 s late
                continue
            is_prompt = all(
                one.patterns and one.delay < PROMPT for one in heard if one.situation.fingers
            )
            if is_prompt and (await self._late() == late or not self._found(begin)):
                break
        assert heard, self.daemon.log
        state = await self.control.ask("state")
        status = await self.daemon.end()
        return Played(
            heard,
            polls,
            self._found(begin),
            0 if self.witness is None else self.witness.frames,
            status,
            state,
            any(LOADING_LOGGER in line for line in self.daemon.log),
        )

    def _found(self, since: float) -> list[Violation]:
        """Violations of the witness since a time [s]."""
        found = [] if self.witness is None else self.witness.finish(time.monotonic())
        return [violation for violation in found if violation.time >= since]

    async def _touch(self, stream: Stream, touched: Collection[str]) -> None:
        """Rest fingers on places; at the others they only feel."""
        await self.control.ask(
            "fingers",
            fingers={name: list(at) for name, at in stream.places.items()},
            observers=[name for name in stream.places if name not in touched],
        )

    async def _late(self) -> tuple[int, ...]:
        """Number of replies that were late or missing, by amplifier."""
        status = await self.daemon.client.status()
        return tuple(one.statistics.timeouts for one in status.amplifiers)

    async def _come_to_rest(self, seconds: float) -> None:
        """Clear faults after a pause [s]."""
        await asyncio.sleep(seconds)
        end = time.monotonic() + PATIENCE
        while (state := (await self.daemon.client.status()).state) != "READY_TO_SWITCH_ON":
            assert time.monotonic() < end, self.daemon.log
            if state == "FAULT":
                with contextlib.suppress(RpcError):  # its cause is not gone yet
                    await self.daemon.client.clear()
            await asyncio.sleep(0.05)

    async def _play(self, capture: Path, stream: Stream) -> tuple[list[Heard], Polls]:
        """Arm, send the stream, poll the far end, and query the vibration at the fingers."""
        if self.witness is not None:
            self.witness.contacts(time.monotonic(), ())
            self.witness.operator_command(time.monotonic(), "arm")
        polls: Polls = []
        events: list[Notification] = []
        went: list[float] = []
        await self._touch(stream, ())

        def changed(now: float, fingers: Mapping[int, str]) -> None:
            went.append(now)
            group.create_task(self._touch(stream, fingers.values()))
            if self.witness is not None:
                self.witness.contacts(now, tuple(fingers))

        async def poll() -> None:
            while len(went) < len(stream.changes) or polls[-1][0] < went[-1]:
                state = await self.control.ask("state")
                levels = [v for each in state["amplifiers"].values() for v in each["levels"]]
                polls.append((state["time_s"], levels))
                await asyncio.sleep(POLL)

        async def listen() -> None:
            async for notification in self.daemon.client.events():
                events.append(notification)

        listening = asyncio.create_task(listen())
        try:
            async with self.daemon.client.armed("test", lease_s=60), asyncio.TaskGroup() as group:
                group.create_task(poll())
                await play_stream(capture, stream, self.daemon.port, changed)
        finally:
            listening.cancel()
        if self.witness is not None:
            self.witness.operator_command(time.monotonic(), "disarm")
        return [
            await hear(self.control, situation, begin, end, events=events)
            for situation, begin, end in zip(stream.situations, went, went[1:], strict=False)
        ], polls


@asynccontextmanager
async def running_chain(
    folder: Path,
    wires: Mapping[str, str] | None,
    *,
    table: Path,
    options: Sequence[str] = (),
    rig_changes: Sequence[tuple[str, str]] = (),
    truth_changes: Sequence[tuple[str, str]] | None = None,
    drive_mode: str | None = None,
    bug: str | None = None,
) -> AsyncIterator[Chain]:
    """A daemon over these wires, by amplifier, and the far end; None: sim:// in the daemon.

    options: of the far end; rig_changes: in the text of the daemon's rig; truth_changes: in that of
    the far end's, where it is another; bug: planted in the daemon.
    """
    truth = write_rig(
        folder / "truth.yaml", *(rig_changes if truth_changes is None else truth_changes)
    )
    async with contextlib.AsyncExitStack() as stack:
        path = folder / "plate"
        witness = None
        if wires is None:
            urls = {"main": f"sim://{quote(str(truth))}?control={quote(str(path))}"}
        else:
            wired = [o for name, wire in wires.items() for o in ("--wire", f"{name}={wire}")]
            far_end = await stack.enter_async_context(
                far_end_process(truth, *wired, *options, amplifiers=len(wires))
            )
            path = far_end.control
            urls, witness = await _witnessed(stack, far_end)
        daemon = await _started(
            stack, folder, urls, rig_changes, table=table, drive_mode=drive_mode, bug=bug
        )
        await stack.enter_async_context(daemon.client)
        control = await stack.enter_async_context(Control.at(path))
        yield Chain(folder, daemon, control, witness)


async def _started(
    stack: contextlib.AsyncExitStack,
    folder: Path,
    urls: Mapping[str, str],
    rig_changes: Sequence[tuple[str, str]],
    *,
    table: Path,
    drive_mode: str | None,
    bug: str | None,
) -> RunningDaemon:
    """Start a daemon; repeated where a busy machine makes its links fail."""
    for left in reversed(range(ATTEMPTS)):
        daemon = running_daemon(
            folder, urls, rig_changes, table=table, drive_mode=drive_mode, bug=bug
        )
        try:
            return await stack.enter_async_context(daemon)
        except DidNotStart as problem:
            if problem.args[0] != LINK_FAILED or not left:
                raise
    raise AssertionError("there are attempts")


async def _witnessed(
    stack: contextlib.AsyncExitStack, far_end: FarEndProcess
) -> tuple[dict[str, str], Witness]:
    """Insert a witness in every wire of a far end; returns the URLs through it."""
    endpoints = [parse_endpoint(url) for url in far_end.urls.values()]
    config = witness_config(
        far_end.urls,
        channels=4 if len(endpoints) == 1 else 2,
        # Times of real processes on a shared machine.
        times_s={"slack": 0.3},
        frequency_hz=list(FREQUENCY_LIMITS),
        level=LEVEL_LIMIT,
    )
    witness = Witness(config)
    names = [endpoint.location for endpoint in endpoints]
    ends = await stack.enter_async_context(relays(endpoints, names, witness))
    return dict(zip(far_end.urls, ends, strict=True)), witness
