"""Presses on a layout in virtual time: real bytes on a wire, a plate in time, what is felt."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.play.reports import PlayReport
from kit.chain import Chain, Position
from kit.clock import run_virtual
from kit.wires import after_each
from model.answer.answer_report import Timing
from model.arrays import FloatArray
from model.finger import detection_threshold
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from registry import threads
from sim.far_ends.wire_assignment import SimulatedWire

WIRES = {
    "serial": SimulatedWire("serial", speed=921_600, unpluggable=True),
    "modbus-rtu": SimulatedWire("modbus-rtu", speed=115_200, unpluggable=True),
    "modbus-tcp": SimulatedWire("modbus-tcp"),
    "socketcand": SimulatedWire("socketcand", speed=500_000),
}
"""Wires at their default speeds."""

LEAST_PAUSE, PAUSE_STEP = 0.1, 0.0137  # s; between presses, at another phase of heartbeats
FingerPath = Callable[[float], Position]
"""The position [m] of a finger by the time [s] since it came down."""


@dataclass(frozen=True)
class Felt:
    """What a finger feels from one start of a vibration on.

    report: of that start; accelerations (n, p) [m/s²]; weights (p,) of the points in the mean over
    the fingertip; threshold: name of the rig's set.
    """

    report: PlayReport
    accelerations: FloatArray
    weights: FloatArray
    sample_rate: float
    threshold: str

    @property
    def promised_db_sl(self) -> float:
        """The level that the controller reported."""
        (target,) = self.report.targets
        return target.level_db_sl

    @property
    def frequency(self) -> float:
        """The only frequency that plays [Hz]."""
        (frequency,) = {tone.frequency for tone in self.report.layer.excitation.values()}
        return frequency

    def level_db_sl(self, duration: float, *, since: float = 0.0) -> float:
        """Level of the rms over a part of it [s], mean over the fingertip's points."""
        first = round(since * self.sample_rate)
        last = round((since + duration) * self.sample_rate)
        rms = np.sqrt((self.accelerations[first:last] ** 2).mean(axis=0))
        threshold = detection_threshold(np.array(self.frequency), self.threshold)
        return float(20 * np.log10(np.sqrt(2) * rms @ self.weights / threshold))


def press(
    rig: Rig,
    table: LocalizationTable,
    layout: SurfaceLayout,
    wire: str,
    path: FingerPath,
    *,
    count: int,
    held: float,
) -> list[list[Felt]]:
    """Press so often for a time [s] along a path; return what starts at each press.

    Each start lasts up to where the finger moves on.
    """

    async def run() -> list[list[Felt]]:
        presses = []
        source, timing = EffectPlayer(layout), Timing(table)
        async with PressedPlate.armed(
            WIRES[wire], rig, table, intent_source=source, timing=timing
        ) as plate:
            plate.must_be_felt = False
            await plate.hold(0.5)
            for number in range(1, count + 1):
                presses.append(await plate.press(100 + number, path, held))
                await plate.hold(LEAST_PAUSE + PAUSE_STEP * number)
        return presses

    return run_virtual(run())


@dataclass
class PressedPlate(Chain):
    """A chain of which every start of a vibration is known."""

    starts: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Note when a tone starts."""
        super().__post_init__()
        amplifier = self.far.amplifier

        def note(*_: object) -> None:
            origins = set()
            for tones in amplifier.outputs:
                origins |= {tone.began for tone in tones if tone.transition.last}
            self.starts += sorted(origins - {*self.starts})

        after_each(self.far.device, note)

    async def press(self, id: int, path: FingerPath, held: float) -> list[Felt]:
        """Press once."""
        self.starts.clear()
        self.applied.clear()
        vibrations: list[Felt] = []

        def move(since: float) -> None:
            if self.at.get(id) not in (None, path(since)):
                vibrations.extend(self._harvest(str(id)))
            self.at[id] = path(since)

        await self.hold(held, move)
        vibrations += self._harvest(str(id))
        del self.at[id]
        return vibrations

    def _harvest(self, finger: str) -> list[Felt]:
        """What the finger has felt at its last position."""
        now, bench = threads.now(), self.far.bench
        bench.advance(now)
        vibrations = []
        for start in self.starts:
            report = min(self.applied, key=lambda report: abs(report.time - start))
            record = bench.sample_fingers().felt(start, now)[finger]
            accelerations = record.accelerations[record.times > start]
            felt = Felt(
                report, accelerations, record.weights, bench.sample_rate, bench.rig.threshold
            )
            vibrations.append(felt)
        self.starts.clear()
        self.applied.clear()
        return vibrations
