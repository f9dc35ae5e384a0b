"""A daemon that serves two clients in virtual time, its amplifiers on lines in memory."""

import asyncio
import contextlib
import json
import re
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np

from controller.api.client import AsyncClient
from controller.api.methods import StatusResult
from controller.cli.status_text import show_status
from controller.demo.demonstration import layout_of_people
from controller.operation.operation_states import Operation
from controller.operation.supervisor import Supervisor
from kit.plates import TWO_AMPLIFIERS, make_paper_rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from processes.daemons import (
    PATIENCE,
    READY,
    DaemonBench,
    daemon_at,
    daemon_table,
    far_end,
    until_state,
)
from sim.faults import FaultWindow

PLACES = {
    "pad": (0.1, 0.1),
    "beside": (0.25, 0.1),
    "west": (0.08, 0.1),
    "east": (0.22, 0.1),
    "left": (0.03, 0.11),
    "right": (0.216, 0.0572),
}
"""Places [m] by name."""
SEATS = ("left", "right")
"""Where two people sit."""


class Planted(Exception):
    """A bug."""


@cache
def phased_table() -> LocalizationTable:
    """For two vibrations at once, of levels that a step on the wire does not round by much."""
    rig = make_paper_rig(12, 9)
    rig = replace(rig, promised_thresholds=(rig.threshold,))
    return build_table(rig, frequencies=np.arange(60.0, 301.0, 20.0), drive_mode="phased")


@dataclass
class ServedDaemon:
    """A daemon that is ready to be armed, with two clients."""

    folder: Path
    options: Mapping[str, Any]
    """Options of `daemon_at`."""
    stack: AsyncExitStack = field(default_factory=AsyncExitStack)
    bench: DaemonBench = field(init=False)
    era: AsyncClient = field(init=False)
    guest: AsyncClient = field(init=False)
    holds: "list[asyncio.Task[None]]" = field(default_factory=list)
    """What reports fingers again and again."""

    @property
    def supervisor(self) -> Supervisor:
        """The supervisor of the daemon."""
        return self.bench.daemon.supervisor

    @property
    def operation(self) -> Operation:
        """What the supervisor knows."""
        return self.supervisor.operation

    @property
    def amplifier_state(self) -> str:
        """The state of the first amplifier."""
        return self.bench.far.summary().state

    @property
    def is_loud(self) -> bool:
        """Whether the first amplifier plays."""
        return any(self.bench.far.summary().levels)

    @property
    def felt_effects(self) -> list[str | None]:
        """What each finger feels now."""
        contacts = self.bench.daemon.publisher.view.contact_statuses()
        return [contact.feels for contact in contacts]

    async def start(self) -> None:
        """Start the daemon, wait until it is ready, and connect the clients."""
        line = far_end(self.folder, changes=self.options["changes"])
        far = await self.stack.enter_async_context(line)
        daemon = daemon_at(far, self.folder, **self.options)
        self.bench = await self.stack.enter_async_context(daemon)
        self.era = await self.connect("test")
        self.guest = await self.connect("test")
        await self.reach(READY)

    async def restart(self) -> None:
        """End the daemon and start it anew; all clients are gone."""
        self.lift()
        await self.stack.aclose()
        await self.start()

    async def connect(self, name: str) -> AsyncClient:
        """Connect a client by this name."""
        client = await self.bench.client(name)
        return await self.stack.enter_async_context(client)

    async def reach(self, state: str) -> None:
        """Wait until the daemon is in a state."""
        await until_state(self.era, state)

    async def status_when(self, holds: Callable[[StatusResult], bool]) -> StatusResult:
        """Read the status until a condition holds."""
        async with asyncio.timeout(PATIENCE):
            status = await self.era.status()
            while not holds(status):
                await asyncio.sleep(0.01)
                status = await self.era.status()
        return status

    async def hear(self, topic: str, **expected: object) -> Mapping[str, Any]:
        """Wait for an event of a topic with these data; all of its data."""
        while True:
            event = await self.era.next_event(timeout=PATIENCE)
            assert event is not None, f"no event of {topic} with {expected}"
            if event.topic == topic and event.data.items() >= expected.items():
                return cast(Mapping[str, Any], event.data)

    def expire_lease(self) -> None:
        """Let the lease be over."""
        assert self.operation.lease is not None
        expired = replace(self.operation.lease, expires_at=0.0)
        self.supervisor.current.value = replace(self.operation, lease=expired)

    def hold_back_arming(self) -> asyncio.Event:
        """Let the amplifiers be armed only once an event is set."""
        arm = self.bench.daemon.controller.arm
        going_on = asyncio.Event()

        async def arm_later() -> None:
            await going_on.wait()
            await arm()

        self.bench.daemon.controller.arm = arm_later  # type: ignore[method-assign]
        return going_on

    def hang(self, amplifier: str = "main") -> None:
        """Let an amplifier reply no more."""
        self.bench.far.devices[amplifier].inject_fault(FaultWindow(fault="hang"))

    def recover(self, amplifier: str = "main") -> None:
        """Let it reply again."""
        self.bench.far.devices[amplifier].recover()

    def hold(self, client: AsyncClient, *places: str, **source: str) -> None:
        """Let a client report fingers at these places until they are lifted."""
        positions = [PLACES[place] for place in places]

        async def repeat() -> None:
            with contextlib.suppress(ConnectionError):
                while True:
                    await client.touch(positions, **source)
                    await asyncio.sleep(0.02)

        self.holds.append(asyncio.create_task(repeat()))

    def lift(self) -> None:
        """Let no client report fingers any more."""
        while self.holds:
            self.holds.pop().cancel()

    async def touch(self, *places: str) -> None:
        """Report fingers, or an empty plate, for 0.2 s."""
        for _ in range(4):
            await self.era.touch([PLACES[place] for place in places])
            await asyncio.sleep(0.05)

    def write_layout(self, name: str, text: str) -> None:
        """Write a layout."""
        (self.folder / f"{name}.yaml").write_text(text, "utf-8")

    async def reload_with(self, *edits: tuple[str, str]) -> str:
        """Reload with texts of the configuration replaced; the reason for a refusal, or "".

        The file is restored afterwards.
        """
        path = self.folder / "daemon.yaml"
        original = text = path.read_text("utf-8")
        for old, new in edits:
            assert old in text
            text = text.replace(old, new)
        path.write_text(text, "utf-8")
        verdict = await self.era.reload()
        path.write_text(original, "utf-8")
        return "" if verdict.reloaded else verdict.reasons[0]


@asynccontextmanager
async def served_daemon(
    *,
    further_lines: str = "",
    layouts: Mapping[str, str] | None = None,
    has_side_amplifier: bool = False,
    has_seats: bool = False,
) -> AsyncIterator[ServedDaemon]:
    """A daemon that is ready to be armed.

    further_lines: of its file; layouts: their texts by name; has_side_amplifier: a second
    amplifier, side; has_seats: the layout of two people, and a table for them.
    """
    texts = dict(layouts or {})
    if has_seats:
        people = layout_of_people(make_paper_rig(12, 9).plate, dict.fromkeys(SEATS))
        texts["panel"] = json.dumps(people)
    if texts:
        files = ", ".join(f"{name}: {name}.yaml" for name in texts)
        further_lines = f"layouts: {{{files}}}\n{further_lines}"
    table = phased_table if has_seats else daemon_table
    options = {
        "more": further_lines,
        "changes": TWO_AMPLIFIERS if has_side_amplifier else (),
        "table": lambda rig: table(),
    }
    with TemporaryDirectory() as folder:
        daemon = ServedDaemon(Path(folder), options)
        for name, text in texts.items():
            daemon.write_layout(name, text)
        await daemon.start()
        try:
            yield daemon
        finally:
            daemon.lift()
            await daemon.stack.aclose()


def require_shown(status: StatusResult, *patterns: str) -> None:
    """Require that `era status` prints a match of each pattern."""
    text = show_status(status)
    for pattern in patterns:
        assert re.search(pattern, text), f"no {pattern!r} in:\n{text}"


def levels_of(status: StatusResult) -> list[float]:
    """The level at each finger [dB SL]."""
    return [round(contact.level_db_sl or 0.0, 1) for contact in status.contacts]


def roles_of(status: StatusResult) -> list[str | None]:
    """The role of each finger."""
    return [contact.role for contact in status.contacts]


def effects_of(status: StatusResult) -> list[str | None]:
    """The effect at each finger."""
    return [contact.effect for contact in status.contacts]
