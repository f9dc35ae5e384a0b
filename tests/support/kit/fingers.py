"""Presses on a layout in virtual time: real bytes on a wire, a plate in time, what is felt.

TUIO is as a sender makes it, by python-osc: captures of it, and a panel of a daemon.
"""

import asyncio
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder

from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.play.reports import PlayReport
from controller.play.shared_capabilities import RAMPS_ONLY, PlaybackCapabilities
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio_capture import RecordedDatagram
from examples.make_touches import tuio_datagram, write_capture
from kit.chain import Chain, Position
from kit.clock import run_virtual
from kit.plates import smooth_rig
from kit.wires import after_each
from model.answer.answer import Limits
from model.answer.answer_report import Timing
from model.arrays import FloatArray
from model.finger import detection_threshold
from model.rig.rig import Rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from registry import threads
from sim.far_ends.wire_assignment import SimulatedWire


def answers_take(patch: pytest.MonkeyPatch, *seconds: float) -> list[float]:
    """Let answers of the thread take these times [s], the last one from then on.

    Returns when [s] each was asked for.
    """
    times: list[float] = []

    def answer_late(loop: Any, executor: Any, work: Callable[[], Any]) -> "asyncio.Future[Any]":
        future = loop.create_future()
        number = min(len(times), len(seconds) - 1)
        loop.call_later(seconds[number], lambda: future.set_result(work()))
        times.append(loop.time())
        return future

    patch.setattr(type(asyncio.get_running_loop()), "run_in_executor", answer_late)
    return times


@cache
def table() -> LocalizationTable:
    """The paper's plate at 29 frequencies."""
    return build_table(smooth_rig(), frequencies=np.linspace(40.0, 320.0, 29))


def playable(layers: int = 8) -> PlaybackCapabilities:
    """What amplifiers of that plate can play, of so many layers, with ramps alone."""
    return PlaybackCapabilities(
        "phased",
        ("phased",),
        Limits((40.0, 320.0), table().full_levels),
        RAMPS_ONLY,
        layers=layers,
    )


WIRES = {
    "serial": SimulatedWire("serial", speed=921_600, unpluggable=True),
    "modbus-rtu": SimulatedWire("modbus-rtu", speed=115_200, unpluggable=True),
    "modbus-tcp": SimulatedWire("modbus-tcp"),
    "socketcand": SimulatedWire("socketcand", speed=500_000),
}
"""Wires at their default speeds."""

_LEAST_PAUSE, _PAUSE_STEP = 0.1, 0.0137  # s; between presses, at another phase of heartbeats


@dataclass(frozen=True)
class Felt:
    """What a finger feels from one start of a vibration on.

    delay [s]: after the finger came down; applied: its report; accelerations (n, p) [m/s²];
    weights (p,) of the points in the mean over the fingertip; threshold: name of the rig's set.
    """

    delay: float
    applied: PlayReport
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
        (frequency,) = {tone.frequency for tone in self.applied.layer.excitation.values()}
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
                plain = "controller.play.shared_capabilities.envelope_support"
                patched.setattr(plain, lambda rig, amplifiers: RAMPS_ONLY)
            return run_virtual(self._run(ways, held))

    async def _run(
        self, ways: Sequence[Callable[[float], Position]], held: float
    ) -> list[list[Felt]]:
        source, timing = EffectPlayer(self.layout), Timing(self.table)
        felt = []
        async with _Starts.armed(
            WIRES[self.wire], self.rig, self.table, intent_source=source, timing=timing
        ) as chain:
            chain.must_be_felt = False
            chain.at = dict(enumerate(self.resting))
            await chain.hold(0.5)
            for number, way in enumerate(ways, start=1):
                felt.append(await chain.press(100 + number, way, held))
                await chain.hold(_LEAST_PAUSE + _PAUSE_STEP * number)
        return felt


@dataclass
class _Starts(Chain):
    """A chain of which every start of a vibration is known."""

    starts: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Note when a tone starts."""
        super().__post_init__()
        amplifier = self.far.amplifier

        def note(*_: object) -> None:
            tones = [tone for each in amplifier.outputs for tone in each]
            origins = {tone.began for tone in tones if tone.transition.last}
            self.starts += sorted(origins - {*self.starts})

        after_each(self.far.device, note)

    async def press(self, id: int, way: Callable[[float], Position], held: float) -> list[Felt]:
        """Press once; records end where the finger moves."""
        self.starts.clear()
        self.applied.clear()
        felt, touched = list[Felt](), threads.now()

        def move(since: float) -> None:
            if self.at.get(id) not in (None, way(since)):
                felt.extend(self._harvest(str(id), touched))
            self.at[id] = way(since)

        await self.hold(held, move)
        felt += self._harvest(str(id), touched)
        del self.at[id]
        return felt

    def _harvest(self, finger: str, touched: float) -> list[Felt]:
        """What the finger has felt at its last position."""
        now, bench, felt = threads.now(), self.far.bench, list[Felt]()
        bench.advance(now)
        for start in self.starts:
            applied = min(self.applied, key=lambda each: abs(each.time - start))
            record = bench.sample_fingers().felt(start, now)[finger]
            felt.append(
                Felt(
                    start - touched,
                    applied,
                    record.accelerations[record.times > start],
                    record.weights,
                    bench.sample_rate,
                    bench.rig.threshold,
                )
            )
        self.starts.clear()
        self.applied.clear()
        return felt


def message(*arguments: Any, address: str = "/tuio/2Dcur") -> Any:
    """An OSC message with python-osc's own choice of types."""
    builder = OscMessageBuilder(address)
    for argument in arguments:
        builder.add_arg(argument)
    return builder.build()


def bundle(*messages: Any) -> bytes:
    """A bundle as a TUIO sender makes it."""
    builder = OscBundleBuilder(IMMEDIATELY)
    for part in messages:
        builder.add_content(part)
    return builder.build().dgram


def cursor(id: int, x: float, y: float) -> Any:
    """A set message of a cursor at rest."""
    return message("set", id, x, y, 0.0, 0.0, 0.0)


def frame(*touches: tuple[int, float, float], fseq: int = -1, source: str = "table@a") -> bytes:
    """A complete bundle."""
    return bundle(
        message("source", source),
        message("alive", *(id for id, _, _ in touches)),
        *(cursor(*touch) for touch in touches),
        message("fseq", fseq),
    )


def free_port() -> int:
    """Find a free UDP port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def panel(port: int) -> str:
    """The lines of a daemon's file for a TUIO panel."""
    return f'touch: [{{name: panel, url: "tuio:127.0.0.1:{port}?timeout=0.15"}}]\n'


FRAME = 1 / 50  # s


def write_schedule(
    path: Path, schedule: Sequence[tuple[int, float, float, float, float]], seconds: float
) -> Path:
    """Write a TUIO capture of fingers: id, down and up [s], place in TUIO's coordinates."""
    datagrams = []
    for number in range(round(seconds / FRAME)):
        now = number * FRAME
        touches = tuple(Touch(id, x, y) for id, down, up, x, y in schedule if down <= now < up)
        frame = TouchFrame("test", now, touches)
        datagrams.append(RecordedDatagram(now, tuio_datagram(frame, number + 1)))
    write_capture(path, datagrams)
    return path
