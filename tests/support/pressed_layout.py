"""Fingers on a surface layout in virtual time: real bytes on a wire, a plate in time, what is felt.

Backends, codecs, far ends and amplifiers are the project's own, with the durations of the wire;
the level is measured at the finger's points of the plate, from the moment its amplifier starts.
"""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.loop.envelopes import RAMPS_ONLY
from controller.loop.loop import Controller
from controller.loop.observer import Applied, Observer
from controller.sources.touch import Touch, TouchFrame
from drivers.opening import Lines
from drivers.protocol.records import Values
from memory_machine import live_in_memory
from model.arrays import FloatArray
from model.finger.perception import detection_threshold
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from model.table.timing import Timing
from sim.bench.amplifier_device import AmplifierDevice
from sim.bench.bench import Bench
from sim.far_ends.wires import Wire, open_wires
from sim.faults.fault_window import Faults
from virtual_loop import run_virtual

WIRES = {
    "serial": Wire("serial", speed=921_600, unpluggable=True),
    "modbus-rtu": Wire("modbus-rtu", speed=115_200, unpluggable=True),
    "modbus-tcp": Wire("modbus-tcp"),
    "socketcand": Wire("socketcand", speed=500_000),
}
"""Wires at their default speeds."""

Position = tuple[float, float]

_REPORT = 0.010  # s; between two frames of the panel
_LEAST_PAUSE, _PAUSE_STEP = 0.1, 0.0137  # s; between presses, at another phase of heartbeats


@dataclass(frozen=True)
class Felt:
    """What a finger feels from one start of a vibration on.

    delay [s]: after the finger came down; applied: its report; accelerations (n, p) [m/s²];
    weights (p,) of the points in the mean over the fingertip; threshold: name of the rig's set.
    """

    delay: float
    applied: Applied
    accelerations: FloatArray
    weights: FloatArray
    sample_rate: float
    threshold: str

    @property
    def promised_db_sl(self) -> float:
        """The level that the controller reported."""
        (prediction,) = self.applied.targets
        return prediction.level_db_sl

    @property
    def frequency(self) -> float:
        """The only frequency that plays [Hz]."""
        (frequency,) = {tone.frequency for tone in self.applied.pattern.excitation.values()}
        return frequency

    def level_db_sl(self, duration: float, *, since: float = 0.0) -> float:
        """Level of the rms over a part of it [s], mean over the fingertip's points."""
        first, last = round(since * self.sample_rate), round((since + duration) * self.sample_rate)
        rms = np.sqrt((self.accelerations[first:last] ** 2).mean(axis=0))
        threshold = detection_threshold(np.array(self.frequency), self.threshold)
        return float(20 * np.log10(np.sqrt(2) * rms @ self.weights / threshold))


@dataclass
class Pressed:
    """A layout on a rig and its table behind a wire; along plain ramps unless it is shaped."""

    rig: Rig
    table: LocalizationTable
    layout: SurfaceLayout
    wire: str
    resting: Sequence[Position] = ()
    is_shaped: bool = True

    def press(self, *ways: Callable[[float], Position], held: float = 0.15) -> list[list[Felt]]:
        """Press for a time [s] along each way, the position [m] by the time since the press.

        Returns what starts at each press, each up to where the finger moves on.
        """
        with pytest.MonkeyPatch.context() as patched:
            if not self.is_shaped:
                plain = "controller.loop.capabilities.envelope_support"
                patched.setattr(plain, lambda rig, amplifiers: RAMPS_ONLY)
            return run_virtual(self._run(ways, held))

    async def _run(
        self, ways: Sequence[Callable[[float], Position]], held: float
    ) -> list[list[Felt]]:
        loop = asyncio.get_running_loop()
        live_in_memory()
        self._bench = Bench(self.rig, now=loop.time())
        device = AmplifierDevice(
            self._bench, "main", address=1, faults=Faults(begin=loop.time(), seed=1)
        )
        self._watch(device)
        felt = []
        async with open_wires({"main": WIRES[self.wire]}, [device]) as urls:
            self._controller = Controller(
                self.rig,
                self.table,
                lines=Lines,
                urls=urls,
                intent_source=EffectPlayer(self.layout),
                timing=Timing(self.table),
                observer=Observer(pattern_applied=lambda applied: self._reports.append(applied)),
            )
            self._starts: list[float] = []
            self._reports: list[Applied] = []
            await self._controller.open()
            await self._controller.arm()
            running = asyncio.create_task(self._controller.run())
            await self._hold(0.5, None, 0)
            for number, way in enumerate(ways, start=1):
                self._starts, self._reports, self._felts = [], [], []
                self._touched, self._at = loop.time(), way(0.0)
                await self._hold(held, way, number)
                self._harvest(number)
                felt.append(self._felts)
                await self._hold(_LEAST_PAUSE + _PAUSE_STEP * number, None, number)
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            await self._controller.close()
            device.close()
        return felt

    def _watch(self, device: AmplifierDevice) -> None:
        """Note when a tone starts."""
        obey, bench = device.handle, self._bench

        def handle(name: str, values: Values, now: float) -> Values:
            reply = obey(name, values, now)
            outputs = bench.amplifiers["main"].outputs
            origins = {tone.origin for each in outputs for tone in each if tone.transition.last}
            self._starts += sorted(origins - {*self._starts})
            return reply

        device.handle = handle  # type: ignore[method-assign]

    async def _hold(
        self, seconds: float, way: Callable[[float], Position] | None, number: int
    ) -> None:
        """Report the fingers for a time [s]."""
        loop = asyncio.get_running_loop()
        begin = loop.time()
        while (since := loop.time() - begin) < seconds - 1e-9:
            fingers = dict(enumerate(self.resting))
            if way is not None:
                fingers[100 + number] = way(since)
                if way(since) != self._at:  # records end where a finger moves
                    self._harvest(number)
                    self._at = way(since)
            self._bench.place_fingers(
                {str(id): position for id, position in fingers.items()}, now=loop.time()
            )
            touches = tuple(
                Touch(id, x / self.rig.plate.length, 1 - y / self.rig.plate.width)
                for id, (x, y) in fingers.items()
            )
            self._controller.deliver(TouchFrame("panel", loop.time(), touches))
            await asyncio.sleep(_REPORT)

    def _harvest(self, number: int) -> None:
        """Note what the pressing finger has felt at its last position."""
        now = asyncio.get_running_loop().time()
        self._bench.advance(now)
        for start in self._starts:
            applied = min(self._reports, key=lambda each: abs(each.time - start))
            record = self._bench.fingers.felt(start, now)[str(100 + number)]
            self._felts.append(
                Felt(
                    start - self._touched,
                    applied,
                    record.accelerations[record.times > start],
                    record.weights,
                    self._bench.sample_rate,
                    self.rig.threshold,
                )
            )
        self._starts, self._reports = [], []
