"""A controller between a table and amplifiers of our own, which obey and remember."""

import asyncio
import math
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from controller.loop.loop import Controller
from controller.loop.observer import Applied, Observer, Silenced
from controller.sources.touch import Touch, TouchFrame, TouchSource
from drivers.amplifier import Amplifier
from drivers.backend import Backend
from drivers.command import CommandSet
from drivers.protocol.messages import (
    AmplifierEvent,
    AmplifierState,
    Apply,
    Reply,
    Request,
    Status,
)
from drivers.protocol.wire_times import WireTimes
from model.arrays import FloatArray
from model.fem.mesh import Mesh
from model.rig.rig import Channel, Rig
from model.structure.actuator import Era
from model.structure.material import Material
from model.structure.plate import Plate
from model.table.pattern import Pattern
from model.table.question import Question
from model.vibration.excitation import Excitation, Tone
from registry.limits import GuardLimits
from sim.amplifier.amplifier import VOICES, SimulatedAmplifier
from stub_wire_times import StubWireTimes

FINGER = (1, 0.5, 0.5)
OTHER = (2, 0.9, 0.9)


class FarEnd(Backend):
    """A simulated amplifier without envelopes that remembers everything it was asked, and when.

    The last byte leaves at once, the reply takes `delay` [s]. `answer` may override any reply.
    """

    def __init__(self, channels: int = 2, voices: int = VOICES) -> None:
        self.asked: list[tuple[float, Request]] = []
        self.delay = self.commit_takes = 0.0
        self.amplifier = SimulatedAmplifier("any", channels=channels, voices=voices)
        self.amplifier.capabilities = replace(
            self.amplifier.capabilities, frequency_max=600.0, envelope_knots=0, envelope_slots=0
        )
        self.answer: Callable[[Request], Reply | None] = lambda request: None
        self.is_open = False
        self.report: Callable[[AmplifierEvent], None] = lambda event: None
        self._last_sent_at = 0.0

    def listen(
        self, on_event: Callable[[AmplifierEvent], None], on_loss: Callable[[str], None]
    ) -> None:
        """Keep the callback of events, for tests to call."""
        self.report = on_event

    async def open(self) -> None:
        """Always succeeds."""
        self.is_open = True

    async def close(self) -> None:
        """As asked."""
        self.is_open = False

    @property
    def last_sent_at(self) -> float:
        """On the loop's clock [s]."""
        return self._last_sent_at

    @property
    def wire_times(self) -> WireTimes:
        """A commit is said to take `commit_takes` [s]."""
        return StubWireTimes(self.commit_takes)

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Remember, wait, answer."""
        self._last_sent_at = asyncio.get_running_loop().time()
        self.asked.append((self._last_sent_at, request))
        await asyncio.sleep(self.delay)
        return self.answer(request) or self.obey(request)

    def obey(self, request: Request) -> Reply:
        """What the simulated amplifier answers."""
        return self.amplifier.handle(request, asyncio.get_running_loop().time())

    def status(self) -> Status:
        """What it reports now."""
        now = asyncio.get_running_loop().time()
        self.amplifier.tick(now)
        return self.amplifier.status(now)

    @property
    def state(self) -> AmplifierState:
        """Its state now."""
        return self.status().state

    @property
    def levels(self) -> tuple[float, ...]:
        """Its levels now."""
        return self.status().levels

    @property
    def token(self) -> int:
        """Token of the set that plays."""
        return self.status().token

    def sets(self) -> list[CommandSet]:
        """All sets that were to be applied."""
        return [request.command_set for _, request in self.asked if isinstance(request, Apply)]

    def requests(self, *kinds: type[Request]) -> list[Request]:
        """What was asked, of some kinds."""
        return [request for _, request in self.asked if isinstance(request, kinds)]

    def times(self, kind: type[Request]) -> list[float]:
        """When something was asked [s]."""
        return [time for time, request in self.asked if isinstance(request, kind)]


class Table:
    """A table whose answer is set by the test, or an exception to raise."""

    def __init__(self, excitation: Excitation | Exception, plate: Plate) -> None:
        self.excitation = excitation
        self.plate = plate
        self.prepared: list[str] = []
        self.asked: list[Question] = []

    @property
    def frequencies(self) -> FloatArray:
        """Those of the tests' tones [Hz]."""
        return np.array([110.0, 250.0])

    def prepare(self, drive_mode: str) -> None:
        """Remember it."""
        self.prepared.append(drive_mode)

    def query(self, question: Question, over_effect: object = None) -> Pattern:
        """The same for every target."""
        self.asked.append(question)
        if isinstance(self.excitation, Exception):
            raise self.excitation
        return Pattern(
            self.excitation,
            0.015,
            20.0,
            12.0 if question.quiet else None,
            None,
            question.drive_mode or "",
        )

    def amplitudes(
        self, excitation: Excitation, points: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """1 m/s² everywhere."""
        return np.array([110.0]), np.ones((1, len(points)))


@dataclass
class Reports:
    """What the control loop reported to its observer."""

    applied: list[Applied] = field(default_factory=list)
    silenced: list[Silenced] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    contacts: list[int] = field(default_factory=list)

    def observer(self) -> Observer:
        """The observer that records it."""
        return Observer(
            contacts_changed=lambda contacts, change: self.contacts.append(len(contacts)),
            pattern_applied=self.applied.append,
            silenced=self.silenced.append,
            refused=self.refused.append,
            link_lost=self.lost.append,
            source_failed=self.failed.append,
        )


def _rig(*amplifiers: str) -> Rig:
    """A rig with two ERAs, both on the first amplifier or one on each."""
    return Rig(
        plate=Plate(0.3, 0.2, 0.0015, Material("aluminium", 70e9, 2700.0, 0.33)),
        mesh=Mesh(4, 4, 0.3, 0.2),
        eras=(
            Era("SW", 0.0, 0.0, 17_000.0, 1.0, 0.0, 100e-6),
            Era("NE", 0.3, 0.2, 17_000.0, 1.0, 0.0, 100e-6),
        ),
        wiring={"SW": Channel(amplifiers[0], 0), "NE": Channel(amplifiers[-1], 1)},
        amplifiers=dict.fromkeys(amplifiers, "fake://"),
        limits=GuardLimits(40.0, 500.0, 1.0),
    )


@dataclass
class Bench:
    """A controller with its far ends, its table, its reports and its running loop."""

    controller: Controller
    rig: Rig
    far_ends: list[Any]
    table: Table
    reports: Reports
    loop: asyncio.Task[None] | None = None

    @property
    def far_end(self) -> Any:
        """The first amplifier."""
        return self.far_ends[0]

    def states(self) -> set[AmplifierState]:
        """The states of all amplifiers."""
        return {far_end.state for far_end in self.far_ends}

    def silences(self) -> list[bool]:
        """Whether each set of the first amplifier was silent."""
        return [each.is_silent for each in self.far_end.sets()]

    async def ended(self) -> None:
        """Wait for the end of the loop; raises what ended it."""
        assert self.loop is not None
        loop, self.loop = self.loop, None
        await loop

    def touch(self, *touches: tuple[int, float, float], ago: float = 0.0) -> None:
        """Deliver a frame that arrived some time ago [s]."""
        now = asyncio.get_running_loop().time()
        self.controller.deliver(
            TouchFrame("test", now - ago, tuple(Touch(*touch) for touch in touches))
        )

    async def hold(self, *touches: tuple[int, float, float], seconds: float) -> None:
        """Repeat a frame every 50 ms, as a source must."""
        for _ in range(round(seconds / 0.05)):
            self.touch(*touches)
            await asyncio.sleep(0.05)


def make_bench(
    *amplifiers: str,
    sources: Sequence[TouchSource] = (),
    observer: Observer | None = None,
    channels: int = 2,
    voices: int = VOICES,
    far_ends: list[Any] | None = None,
    rate: float = math.inf,
    on_time: float = math.inf,
    **options: Any,
) -> Bench:
    """A bench within a running loop; one amplifier unless more are named.

    rate [1/s], on_time [s]: limits of the rig; options: as a `Controller` takes them.
    """
    names = amplifiers or ("main",)
    far_ends = far_ends or [FarEnd(channels, voices) for _ in names]
    reports = Reports()
    rig = _rig(*names)
    rig = replace(rig, limits=replace(rig.limits, rate=rate, on_time=on_time))
    table = Table({"SW": Tone(110.0, 20e-6, math.pi / 2)}, rig.plate)
    controller = Controller(
        rig,
        table,
        amplifiers={n: Amplifier(far_end) for n, far_end in zip(names, far_ends, strict=True)},
        sources=sources,
        observer=observer or reports.observer(),
        **options,
    )
    return Bench(controller, rig, far_ends, table, reports)


@asynccontextmanager
async def armed(*amplifiers: str, **options: Any) -> AsyncIterator[Bench]:
    """A bench that is open and armed, without a loop; closed at the end."""
    bench = make_bench(*amplifiers, **options)
    await bench.controller.open()
    await bench.controller.arm()
    try:
        yield bench
    finally:
        await bench.controller.close()


@asynccontextmanager
async def running(*amplifiers: str, **options: Any) -> AsyncIterator[Bench]:
    """A bench that is open, armed and runs; its loop must survive unless the test awaits `ended`.

    Amplifiers and options as for `make_bench`.
    """
    async with armed(*amplifiers, **options) as bench:
        bench.loop = asyncio.create_task(bench.controller.run())
        await asyncio.sleep(0.001)
        yield bench
    if bench.loop is not None:
        await bench.loop
