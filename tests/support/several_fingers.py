"""Several fingers on the paper's plate in virtual time: controller, wire, amplifier, fingertips.

Everything is the project's own but the memory of the serial line, whose bytes a witness reads and
judges at the end. Fingers are reported every 10 ms.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.loop.loop import Controller
from controller.loop.observer import Applied, Observer, Silenced
from controller.sources.touch import Touch, TouchFrame
from drivers.opening import Lines
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet, unpack_layers
from memory_machine import live_in_memory
from model.finger.perception import detection_threshold
from model.table.table import LocalizationTable
from model.table.timing import Timing
from paper_table import smooth_rig
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench
from sim.far_ends.wires import Wire, open_wires
from sim.faults.fault_window import Faults
from sim.witness.witness import Witness
from witness_config import witness_config

Position = tuple[float, float]
LEVEL_LIMIT = 1.0  # of the paper's rig, written by hand


@dataclass
class Fingers:
    """Fingers by id, at x, y [m] of the plate, and what was sent and reported for them.

    committed: time [s], token and layers of every set and silence (no layers), as the amplifier
    carries them out.
    """

    controller: Controller
    bench: Bench
    witness: Witness
    at: dict[int, Position] = field(default_factory=dict)
    applied: list[Applied] = field(default_factory=list)
    silenced: list[Silenced] = field(default_factory=list)
    committed: list[tuple[float, int, tuple[LayerSet, ...]]] = field(default_factory=list)
    _staged: dict[int, dict[int, list[int]]] = field(default_factory=dict)

    def report(self) -> None:
        """Report where the fingers are."""
        plate, now = self.bench.rig.plate, asyncio.get_running_loop().time()
        places = {str(id): position for id, position in self.at.items()}
        self.bench.place_fingers(places, now=now)
        self.witness.contacts(now, tuple(self.at))
        touches = tuple(
            Touch(id, x / plate.length, 1 - y / plate.width) for id, (x, y) in self.at.items()
        )
        self.controller.deliver(TouchFrame("panel", now, touches))

    async def hold(self, seconds: float, way: Callable[[float], None] = lambda since: None) -> None:
        """Report them for a time [s]; way moves them, by the time since the start."""
        loop = asyncio.get_running_loop()
        begin = loop.time()
        while (since := loop.time() - begin) < seconds - 1e-9:
            way(since)
            self.report()
            await asyncio.sleep(0.010)

    def contrasts(self, *, over: float = 0.25) -> Mapping[int, float]:
        """Level of each finger's content over all others there [dB], of the last seconds.

        By the frequencies that are reported for the fingers, and the amplitudes at their tips; as
        the table defines it: mean of the own tone over the tip, over the loudest point of the rest.
        """
        now = asyncio.get_running_loop().time()
        self.bench.advance(now)
        own = {each.contact.key.id: each.frequency for each in self.applied[-1].targets}
        found = {}
        for name, felt in self.bench.felt(now - over, now).items():
            frequency = own.get(int(name))
            thresholds = detection_threshold(np.array(felt.frequencies), self.bench.rig.threshold)
            amplitudes = felt.amplitude / thresholds[:, None]
            is_own = np.isclose(felt.frequencies, frequency or 0.0, atol=0.2)
            if is_own.sum() == 1 and len(felt.frequencies) > 1:
                others = np.sqrt((amplitudes[~is_own] ** 2).sum(axis=0)).max()
                level = float((amplitudes[is_own][0] * felt.weights).sum() / felt.weights.sum())
                found[int(name)] = 20 * np.log10(level / others)
        return found

    def note(self, name: str, values: Values, reply: Values) -> None:
        """Note what a request of the host changes."""
        now = asyncio.get_running_loop().time()
        if name == "Set":
            parts = self._staged.setdefault(values["token"], {})
            parts[values["index"]] = list(values["stream"])
            if reply["played"]:
                self._commit(values["token"], now)
        elif name == "Commit":
            self._commit(values["token"], now)
        elif name == "Silence":
            self.committed.append((now, 0, ()))

    def _commit(self, token: int, now: float) -> None:
        parts = self._staged.pop(token, None)
        if parts is not None:  # else it was repeated
            words = [word for part in sorted(parts) for word in parts[part]]
            self.committed.append((now, token, unpack_layers(words)))


@asynccontextmanager
async def fingers_on(
    table: LocalizationTable, layout: SurfaceLayout, *, layers: int = 8, breaks: str | None = None
) -> AsyncIterator[Fingers]:
    """Fingers on a layout, armed, over a serial line with an amplifier of four channels.

    breaks: the only rule of the witness that what is planted breaks.
    """
    loop: Any = asyncio.get_running_loop()
    live_in_memory()
    rig = smooth_rig()
    bench = Bench(rig, now=loop.time())
    device = AmplifierDevice(bench, "main", address=1, faults=Faults(begin=loop.time(), seed=1))
    bench.amplifiers["main"].capabilities["layers"] = layers
    async with open_wires(
        {"main": Wire("serial", speed=921_600, unpluggable=True)}, [device]
    ) as on:
        controller = Controller(
            rig,
            table,
            lines=Lines,
            urls=on,
            intent_source=EffectPlayer(layout),
            timing=Timing(table),
        )
        config = witness_config(on, times_s={}, level=LEVEL_LIMIT)
        witness = Witness(config)
        for link in config["wires"]:
            witness.opened(link, loop.time())
        loop.seen = lambda link, toward, data: witness.record_bytes(link, toward, loop.time(), data)
        fingers = Fingers(controller, bench, witness)
        controller.observers.append(
            Observer(pattern_applied=fingers.applied.append, silenced=fingers.silenced.append)
        )
        obey = device.handle

        def handle(name: str, values: Values, now: float) -> Values:
            reply = obey(name, values, now)
            fingers.note(name, values, reply)
            return reply

        device.handle = handle  # type: ignore[method-assign]
        await controller.open()
        witness.operator_command(loop.time(), "arm")
        await controller.arm()
        running = asyncio.create_task(controller.run())
        await fingers.hold(0.5)
        yield fingers
        witness.operator_command(loop.time(), "disarm")
        await controller.close()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        device.close()
        broken = {violation.invariant for violation in witness.finish(loop.time())}
        assert broken == ({breaks} if breaks else set())
        assert witness.frames > 10
