"""The whole chain in virtual time: touch frames, control loop, wire, far end, fingertips.

Everything between the touch frames and the plate is the project's own, with the durations of the
wires; only the lines are memory. Each wire has a witness.
"""

import asyncio
import json
import random
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest

import sim.shared_rig
from controller.api.client_protocol import Notification
from controller.daemon.api_views import PlateView
from controller.effects.layout import SurfaceLayout, default_effects
from controller.effects.player import EffectPlayer
from controller.loop.loop import Controller
from controller.loop.observer import Applied, Observer
from drivers import clock
from drivers.opening import Lines
from heard import SENSORS, Heard, hear
from memory_machine import live_in_memory
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from model.table.timing import Timing
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench
from sim.control.context import SimulationContext
from sim.control.operations import carry_out
from sim.far_ends.wires import Wire, open_wires
from sim.plant.imperfections import draw_imperfections
from sim.witness.violation import Violation
from sim.witness.witness import Witness
from touch_stream import Stream
from virtual_loop import run_virtual
from witness_config import witness_config

LEVEL_DB_SL = 30.0
LEVEL_LIMIT = 1.0  # of the example's rig, written by hand
SPEEDS = {"serial": 921_600, "modbus-rtu": 115_200, "slcan": 500_000, "socketcand": 500_000}
"""Default speeds of the wires that have one [bit/s]."""

_POLL = 0.005  # s


@dataclass(frozen=True)
class Played:
    """Results of a stream.

    polls: times [s] of the far end, and the levels of all channels then; violations, frames: of the
    witness, which no wire within a process has.
    """

    heard: list[Heard]
    polls: list[tuple[float, list[float]]]
    violations: list[Violation]
    frames: int
    state: Mapping[str, Any]


@dataclass
class Chain:
    """A chain to play one stream.

    rig, table: of the controller; truth: the rig of the plate; wires: kinds by amplifier, None for
    sim:// of the rig's file.
    """

    rig: Rig
    table: LocalizationTable
    truth: Rig
    wires: Mapping[str, str] | None
    rig_file: Path
    drive_mode: str | None = None
    witness: Witness | None = field(default=None, init=False)
    _early: list[tuple[str, str, bytes]] = field(default_factory=list, init=False)

    def play(self, stream: Stream) -> Played:
        """Play a stream from arming to closing."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sim.shared_rig, "control_socket", self._keep_context)
            return run_virtual(self._play(stream), rng=random.Random(1), seen=self._seen)

    async def ask(self, op: str, **request: Any) -> dict[str, Any]:
        """Execute a request of the plate's control."""
        line = json.dumps({"op": op, **request}).encode()
        reply = await carry_out(self._context, line, now=clock.now())
        assert "error" not in reply, reply
        return dict(reply)

    async def _play(self, stream: Stream) -> Played:
        live_in_memory()
        async with self._far_end() as urls:
            controller = Controller(
                self.rig,
                self.table,
                lines=Lines,
                urls=urls,
                intent_source=EffectPlayer(SurfaceLayout(effects=default_effects(LEVEL_DB_SL))),
                timing=Timing(self.table),
                observer=Observer(pattern_applied=self._applied),
                drive_mode=self.drive_mode,
            )
            self._events: list[Notification] = []
            self._polls: list[tuple[float, list[float]]] = []
            await controller.open()
            sensors = {name: {"at_m": list(at)} for name, at in SENSORS.items()}
            await self.ask("sensors", sensors=sensors)
            await self._touch(stream, {})
            self._operate("arm")
            await controller.arm()
            tasks = [asyncio.create_task(work) for work in (controller.run(), self._poll())]
            times = await self._send(stream, controller)
            heard = [
                await hear(self, situation, begin, end, events=self._events)
                for situation, begin, end in zip(stream.situations, times, times[1:], strict=False)
            ]
            self._operate("disarm")
            await controller.close()
            state = await self.ask("state")
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        witness = self.witness
        found = [] if witness is None else witness.finish(clock.now())
        return Played(heard, self._polls, found, 0 if witness is None else witness.frames, state)

    @asynccontextmanager
    async def _far_end(self) -> AsyncIterator[Mapping[str, str]]:
        """Open the amplifiers of the true rig on their wires."""
        if self.wires is None:
            yield {"main": f"sim://{quote(str(self.rig_file))}?control=control"}
            return
        bench = Bench(
            self.truth,
            now=clock.now(),
            imperfections=draw_imperfections(self.truth),
        )
        devices = {
            name: AmplifierDevice(bench, name, address=number)
            for number, name in enumerate(bench.amplifiers, start=1)
        }
        wires = {name: Wire(kind, speed=SPEEDS.get(kind)) for name, kind in self.wires.items()}
        async with open_wires(wires, [*devices.values()]) as urls:
            config = witness_config(urls, times_s={}, level=LEVEL_LIMIT)
            self.witness = Witness(config)
            for link in config["wires"]:
                self.witness.opened(link, clock.now())
            self._context = SimulationContext(bench, devices, urls)
            yield urls
            for device in devices.values():
                device.close()

    @asynccontextmanager
    async def _keep_context(self, context: SimulationContext, path: Path) -> AsyncIterator[None]:
        """Keep the plate of sim:// at hand instead of serving its control at a path."""
        self._context = context
        yield

    async def _send(self, stream: Stream, controller: Controller) -> list[float]:
        """Deliver the stream at its pace; return the times of its changes [s]."""
        start = clock.now()
        due = list(stream.changes)
        times = []
        for frame in stream.frames():
            await asyncio.sleep(max(0.0, start + frame.time - clock.now()))
            while due and due[0][0] <= frame.time + 1e-6:
                times.append(clock.now())
                await self._touch(stream, due.pop(0)[1])
            controller.deliver(replace(frame, time=clock.now()))
        return times

    async def _touch(self, stream: Stream, fingers: Mapping[int, str]) -> None:
        """Rest fingers on places; at the others they only feel."""
        await self.ask(
            "fingers",
            fingers={name: list(at) for name, at in stream.places.items()},
            observers=[name for name in stream.places if name not in fingers.values()],
        )
        if self.witness is not None:
            self.witness.contacts(clock.now(), tuple(fingers))

    async def _poll(self) -> None:
        while True:
            state = await self.ask("state")
            levels = [v for each in state["amplifiers"].values() for v in each["levels"]]
            self._polls.append((state["time_s"], levels))
            await asyncio.sleep(_POLL)

    def _operate(self, command: Any) -> None:
        if self.witness is not None:
            self.witness.operator_command(clock.now(), command)

    def _applied(self, applied: Applied) -> None:
        event = PlateView(effect_of=lambda key: None, applied=applied).pattern_event()
        assert event is not None
        self._events.append(Notification("pattern", applied.time, 0, event.model_dump()))

    def _seen(self, link: str, toward: str, data: bytes) -> None:
        if self.witness is not None:
            self.witness.record_bytes(link, toward, clock.now(), data)  # type: ignore[arg-type]
