"""A controller between a table and simulated amplifiers, which obey and remember."""

import asyncio
import math
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

from committed_sets import CommittedSets
from controller.loop.loop import Controller
from controller.loop.observer import Applied, Observer, Silenced
from controller.sources.touch import Touch, TouchFrame
from drivers.contents import Tone as Played
from drivers.errors import LinkError
from drivers.host.amplifier import Amplifier as Host
from drivers.host.line import Line
from drivers.host.wire import Event
from drivers.opening import Lines
from drivers.protocol.records import Values
from drivers.protocol.sets import LayerSet
from drivers.protocol.table import NO_CHANNEL, QUANTITIES
from model.rig.rig import Rig
from model.vibration.excitation import Tone
from newest_contact import BuzzNewestContact
from registry.limits import GuardLimits
from set_table import SetTable, SetTiming, make_rig
from words_line import MemoryLine

FINGER = (1, 0.5, 0.5)
OTHER = (2, 0.9, 0.9)
ENABLED, STOPPED, DISARMED = "OPERATION_ENABLED", "QUICK_STOP_ACTIVE", "SWITCH_ON_DISABLED"


@dataclass(frozen=True)
class Sent:
    """A set that was committed, or a silence: when [s], ramp and valid_for [s], and its tones."""

    time: float
    token: int
    ramp: float
    valid_for: float = 0.0
    commands: tuple[Played, ...] = ()
    renew: bool = False

    @property
    def is_silent(self) -> bool:
        """Whether nothing plays after it."""
        return not self.renew and not any(each.level or each.onset for each in self.commands)


def _sent(one: LayerSet, token: int, time: float) -> Sent:
    def tone(command: Any) -> Played:
        return Played(
            command.channel,
            QUANTITIES["frequency"].from_wire(command.frequency),
            QUANTITIES["level"].from_wire(command.level),
            QUANTITIES["phase"].from_wire(command.phase),
            command.keep_phase,
            command.skip_ending,
            command.onset,
            command.ending,
        )

    return Sent(
        time,
        token,
        QUANTITIES["ramp"].from_wire(one.ramp),
        QUANTITIES["valid_for"].from_wire(one.valid_for),
        tuple(map(tone, one.commands)),
        one.renew,
    )


class FarEnd(MemoryLine):
    """A simulated amplifier, on a line of its own, that remembers everything it was asked.

    A request arrives at once unless it is deaf, its reply takes `delay` [s], and is not sent if it
    is mute. `answer` may override any reply, or raise Refusal. attempts [s]: to open a line to it.
    Without envelopes unless knots are given.
    """

    def __init__(self, *, wire: str = "serial", channels: int = 2, knots: int = 0) -> None:
        super().__init__(wire, "main", channels=channels)
        self.asked: list[tuple[float, str, Values]] = []
        self.delay = 0.0
        self.is_mute = self.is_deaf = self._is_cut = False
        self.attempts: list[float] = []
        self.answer: Callable[[str, Values], Values | None] = lambda name, values: None
        self.amplifier = self.far["main"]
        highest = QUANTITIES["frequency"].to_wire(600.0)
        self.amplifier.capabilities.update(frequency_max=highest, knots=knots)
        self.obey = self.amplifier.handle
        self.amplifier.handle = self._handle  # type: ignore[method-assign]
        self.inward = lambda name, data: [] if self.is_deaf else [(0.0, data)]
        self.outward = lambda name, data: [] if self.is_mute else [(self.delay, data)]
        self._sets = CommittedSets()
        self.close()

    @property
    def is_open(self) -> bool:
        """Whether a line to it is."""
        return self.line.loss is None

    def connect(self) -> Line:
        """Open a line to it; raises LinkError while it is cut."""
        self.attempts.append(self.loop.time())
        if self._is_cut:
            raise LinkError("wire cut")
        self.start_host()
        return self.line

    def cut(self) -> None:
        """Cut its line, until `mend`."""
        self._is_cut = True
        self.line.lose("wire cut")

    def mend(self) -> None:
        """Let it be opened again."""
        self._is_cut = False

    def report(self, **event: int) -> None:
        """Let its host hear of an event."""
        values = {"channel": NO_CHANNEL, "latch": 0, **event}
        self.line.members[1].note_unasked(Event(1, values))

    def close(self) -> None:
        """Close its line."""
        self.line.lose("closed")

    def _handle(self, name: str, values: Values, now: float) -> Values:
        self.asked.append((now, name, values))
        answer = self.answer(name, values)
        reply = self.obey(name, values, now) if answer is None else answer
        self._sets.note(name, values, reply, now)
        return reply

    def status(self) -> Values:
        """What it reports now."""
        now = self.loop.time()
        self.amplifier.tick(now)
        return self.amplifier.status(now)

    @property
    def state(self) -> str:
        """Its state now."""
        self.status()
        return self.amplifier.state

    @property
    def token(self) -> int:
        """Token of the layer that plays."""
        return int(self.status()["tokens"][0])

    def sets(self) -> list[Sent]:
        """All sets that were committed, and silences, in order."""
        ramps = {now: values["ramp"] for now, name, values in self.asked if name == "Silence"}
        return [
            _sent(one, token, now)
            for now, token, layers in self._sets.all
            for one in layers or (LayerSet(0, ramps[now], 0, ()),)
        ]

    def requests(self, *names: str) -> list[Values]:
        """What was asked, of some names."""
        return [values for _, name, values in self.asked if name in names]

    def names(self, since: int = 0) -> list[str]:
        """Names of all that was asked from a number on."""
        return [name for _, name, _ in self.asked[since:]]

    def times(self, *names: str) -> list[float]:
        """When something was asked [s]."""
        return [time for time, name, _ in self.asked if name in names]


class BenchLines(Lines):
    """The lines of far ends by URL."""

    def __init__(self, far_ends: Mapping[str, Any]) -> None:
        super().__init__()
        self._far_ends = far_ends

    async def amplifier(
        self,
        url: str,
        limits: GuardLimits,
        *,
        name: str,
        serial_number: str | None = None,
        is_output: bool | None = False,
    ) -> Host:
        """Return the amplifier of this name, on a new line."""
        line = self._far_ends[name].connect()
        return Host(line, 1, limits, name=name, serial_number=serial_number, is_output=is_output)

    async def close(self) -> None:
        """Close all lines."""
        for far_end in self._far_ends.values():
            far_end.close()


@dataclass
class Reports:
    """What the control loop reported to its observer."""

    applied: list[Applied] = field(default_factory=list)
    silenced: list[Silenced] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    contacts: list[int] = field(default_factory=list)

    def observer(self) -> Observer:
        """The observer that records it."""
        return Observer(
            contacts_changed=lambda contacts, change: self.contacts.append(len(contacts)),
            pattern_applied=self.applied.append,
            silenced=self.silenced.append,
            refused=self.refused.append,
            link_lost=self.lost.append,
        )


@dataclass
class Bench:
    """A controller with its far ends, its table, its reports and its running loop."""

    controller: Controller
    rig: Rig
    far_ends: list[FarEnd]
    table: SetTable
    reports: Reports
    loop: asyncio.Task[None] | None = None

    @property
    def far_end(self) -> FarEnd:
        """The first amplifier."""
        return self.far_ends[0]

    def states(self) -> set[str]:
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

    async def touches(
        self, *touches: tuple[int, float, float], rest: float, ago: float = 0.0
    ) -> None:
        """Deliver a frame, and rest for a time [s]."""
        self.touch(*touches, ago=ago)
        await asyncio.sleep(rest)

    async def hold(self, *touches: tuple[int, float, float], seconds: float) -> None:
        """Repeat a frame every 50 ms, as a source must."""
        for _ in range(round(seconds / 0.05)):
            self.touch(*touches)
            await asyncio.sleep(0.05)


def make_bench(
    *amplifiers: str,
    observer: Observer | None = None,
    wire: str = "serial",
    channels: int = 2,
    knots: int = 0,
    rate: float = math.inf,
    on_time: float = math.inf,
    **options: Any,
) -> Bench:
    """A bench within a running loop; one amplifier unless more are named.

    wire, channels, knots: of each far end; rate [1/s], on_time [s]: limits of the rig; options: as
    a `Controller` takes them.
    """
    names = amplifiers or ("main",)
    far_ends = [FarEnd(wire=wire, channels=channels, knots=knots) for _ in names]
    reports = Reports()
    limits = GuardLimits(40.0, 500.0, 1.0, rate=rate, on_time=on_time)
    rig = make_rig(names, limits, eras=2)
    table = SetTable({"SW": Tone(110.0, 20e-6, math.pi / 2)}, rig.plate)
    by_name = dict(zip(names, far_ends, strict=True))
    controller = Controller(
        rig,
        table,
        lines=lambda: BenchLines(by_name),
        observer=observer or reports.observer(),
        **{"intent_source": BuzzNewestContact(), "timing": SetTiming(), **options},
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
