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

import pytest

from controller.api.client_protocol import Notification
from controller.api.jsonrpc import RpcError
from far_end_process import FarEndProcess, far_end_process
from heard import PATIENCE, SENSORS, Control, Heard, Refused, hear
from rig_files import write_rig
from sim.witness.endpoint import parse_endpoint
from sim.witness.violation import Violation
from sim.witness.witness import Witness
from sim.witness_relay import relays
from stream_daemon import RunningDaemon, running_daemon
from touch_stream import Stream, play_stream
from witness_config import witness_config

POLL = 0.01  # s
PROMPT = 0.25  # s; from touch to pattern event, far above what an idle machine takes
LOADING_LOGGER = "controller.loop.loading_times"
FREQUENCY_LIMITS, LEVEL_LIMIT = (40.0, 500.0), 1.0  # Hz; of the example's rig, written by hand

Polls: TypeAlias = list[tuple[float, list[float]]]
"""Times [s] of the far end, and the levels of all channels then."""


@dataclass(frozen=True)
class Played:
    """Results of a stream.

    polls: time [s] and levels of all channels, as the far end reports; violations, frames: of the
    witness, which no wire within a process has; exit_status: the daemon's; disturbance: why
    the machine was too busy for this to be a result.
    """

    heard: list[Heard]
    polls: Polls
    violations: list[Violation]
    frames: int
    exit_status: int
    state: Mapping[str, Any]
    disturbance: str | None

    def require_undisturbed(self) -> None:
        """Skip the test of a disturbed stream."""
        if self.disturbance is not None:
            pytest.skip(f"the machine was too busy: {self.disturbance}")


@dataclass
class Chain:
    """Daemon, wire and far end, ready to be armed."""

    folder: Path
    daemon: RunningDaemon
    control: Control
    witness: Witness | None

    async def play(self, stream: Stream) -> Played:
        """Play a stream and end the daemon."""
        await self._place(stream)
        capture = self.folder / "touches.tuio"
        stream.write(capture)
        disturbance = await self._wait_until_ready()
        begin, late = time.monotonic(), await self._late()
        heard: list[Heard] = []
        polls: Polls = []
        try:
            if disturbance is None:
                heard, polls = await self._play(capture, stream)
        except (RpcError, Refused) as error:  # a link was lost, or a request more than 10 s late
            disturbance = str(error)
        violations = self._found(begin)
        if not all(one.patterns and one.delay < PROMPT for one in heard if one.situation.fingers):
            disturbance = f"a pattern came more than {PROMPT:g} s after its touch"
        elif violations and await self._late() != late:
            disturbance = "a reply was late"
        elif any(LOADING_LOGGER in line for line in self.daemon.log):
            disturbance = "loading envelopes took too long"
        state = await self.control.ask("state")
        status = await self.daemon.end()
        frames = 0 if self.witness is None else self.witness.frames
        return Played(heard, polls, violations, frames, status, state, disturbance)

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

    async def _place(self, stream: Stream) -> None:
        """Place fingers and sensors."""
        fingers = {name: list(at) for name, at in stream.places.items()}
        await self.control.ask("fingers", fingers=fingers)
        sensors = {name: {"at_m": list(at)} for name, at in SENSORS.items()}
        await self.control.ask("sensors", sensors=sensors)
        await self.daemon.client.subscribe("pattern")

    async def _wait_until_ready(self) -> str | None:
        """Wait until the daemon can be armed; returns why it cannot be."""
        end = time.monotonic() + PATIENCE
        while (status := await self.daemon.client.status()).state != "READY_TO_SWITCH_ON":
            if status.state == "FAULT":
                return status.cause
            assert time.monotonic() < end, self.daemon.log
            await asyncio.sleep(0.05)
        return None

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
        daemon = await stack.enter_async_context(
            running_daemon(folder, urls, rig_changes, table=table, drive_mode=drive_mode, bug=bug)
        )
        await stack.enter_async_context(daemon.client)
        control = await stack.enter_async_context(Control.at(path))
        yield Chain(folder, daemon, control, witness)


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
