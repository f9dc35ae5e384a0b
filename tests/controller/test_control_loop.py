"""The control loop, on a virtual clock and with amplifiers that record what they are asked."""

import asyncio
import logging
import math
import re
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import pytest

from controller.amplifiers import Phase
from controller.loop import Controller
from controller.observer import Applied, Observer, Silenced
from controller.touch import Touch, TouchFrame, TouchSource
from drivers.amplifier import Amplifier
from drivers.backend import Backend
from drivers.command import CommandSet
from drivers.errors import CommandError, CommandRefused, LinkError
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    Apply,
    Arm,
    Capabilities,
    Clear,
    Commit,
    Disarm,
    Fault,
    GetCaps,
    GetStatus,
    Hello,
    Identity,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    Stage,
    State,
    Status,
    Stop,
)
from model.actuator import Era
from model.errors import InputError
from model.excitation import Excitation, Tone
from model.mesh import Mesh
from model.plate import Material, Plate
from model.rig import Channel, Limits, Rig
from model.table import Pattern

Run = Callable[..., Any]


class FarEnd(Backend):
    """An amplifier that obeys and remembers everything it was asked, and when.

    The last byte leaves at once, the reply takes `delay` [s]. `answer` may override any reply.
    """

    def __init__(self, channels: int = 2) -> None:
        self.asked: list[tuple[float, Request]] = []
        self.delay = 0.0
        self.channels = channels
        self.state = State.SWITCH_ON_DISABLED
        self.levels = (0.0,) * channels
        self.token = 0
        self.staged: CommandSet | None = None
        self.answer: Callable[[Request], Reply | None] = lambda request: None
        self.is_open = False
        self._last_sent = 0.0

    async def open(self) -> None:
        """Always succeeds."""
        self.is_open = True

    async def close(self) -> None:
        """As asked."""
        self.is_open = False

    @property
    def last_sent(self) -> float:
        """On the loop's clock [s]."""
        return self._last_sent

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Remember, wait, answer."""
        self._last_sent = asyncio.get_running_loop().time()
        self.asked.append((self._last_sent, request))
        await asyncio.sleep(self.delay)
        return self.answer(request) or self.obey(request)

    def obey(self, request: Request) -> Reply:
        """What an amplifier without faults answers."""
        match request:
            case Hello():
                return Identity("maker", "box", "1", "1", PROTOCOL.version)
            case GetCaps():
                return Capabilities(
                    channels=self.channels,
                    frequency_min=10.0,
                    frequency_max=600.0,
                    frequency_step=0.01,
                    level_max=1.0,
                    level_step=1e-4,
                    phase_step=0.01,
                    ramp_max=1.0,
                    watchdog_min=0.1,
                    watchdog_max=1.0,
                    envelope_knots=0,
                )
            case Arm() if self.state is State.SWITCH_ON_DISABLED:
                self.state = State.OPERATION_ENABLED
            case Arm():
                return Nak(NakCode.WRONG_STATE)
            case Disarm() | Clear():
                self.state = State.SWITCH_ON_DISABLED
                self.levels = (0.0,) * self.channels
            case Stop():
                self.state = State.QUICK_STOP_ACTIVE
                self.levels = (0.0,) * self.channels
            case Stage(command_set=staged):
                self.staged = staged
                return Achieved(staged.token, staged.commands)
            case Commit():
                assert self.staged is not None
                return self._play(self.staged)
            case Apply(command_set=wanted):
                return self._play(wanted)
            case _:
                pass
        return Status(self.state, Fault.NONE, self.token, True, 25.0, 0.25, self.levels)

    def _play(self, wanted: CommandSet) -> Achieved:
        levels = {command.channel: command.level for command in wanted.commands}
        self.levels = tuple(levels.get(channel, 0.0) for channel in range(self.channels))
        self.token = wanted.token
        return Achieved(wanted.token, wanted.commands)

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

    def __init__(self, excitation: Excitation | Exception) -> None:
        self.excitation = excitation

    def answer(
        self,
        target: tuple[float, float],
        *,
        quiet: Sequence[tuple[float, float]] = (),
        level_db_sl: float = 0.0,
    ) -> Pattern:
        """The same for every target."""
        if isinstance(self.excitation, Exception):
            raise self.excitation
        return Pattern(self.excitation, 0.015, 20.0, 12.0 if quiet else None, None)


@dataclass
class Told:
    """What an observer was told."""

    applied: list[Applied] = field(default_factory=list)
    silenced: list[Silenced] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    contacts: list[int] = field(default_factory=list)

    def observer(self) -> Observer:
        """The observer that writes it down."""
        return Observer(
            contacts_changed=lambda contacts, change: self.contacts.append(len(contacts)),
            pattern_applied=self.applied.append,
            silenced=self.silenced.append,
            refused=self.refused.append,
            link_lost=self.lost.append,
            source_failed=self.failed.append,
        )


def rig(*amplifiers: str) -> Rig:
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
        limits=Limits(40.0, 500.0, 1.0),
    )


@dataclass
class Bench:
    """A controller with its far ends, its table and what it told."""

    controller: Controller
    far_ends: list[FarEnd]
    table: Table
    told: Told

    @property
    def far_end(self) -> FarEnd:
        """The first amplifier."""
        return self.far_ends[0]

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
    *amplifiers: str, sources: Sequence[TouchSource] = (), observer: Observer | None = None
) -> Bench:
    """A bench around a running loop; one amplifier unless more are named."""
    names = amplifiers or ("main",)
    far_ends = [FarEnd() for _ in names]
    table = Table({"SW": Tone(110.0, 20e-6, math.pi / 2)})
    told = Told()
    controller = Controller(
        rig(*names),
        table,
        amplifiers={n: Amplifier(far_end) for n, far_end in zip(names, far_ends, strict=True)},
        sources=sources,
        observer=observer or told.observer(),
        clock=asyncio.get_running_loop().time,
    )
    return Bench(controller, far_ends, table, told)


@asynccontextmanager
async def running(*amplifiers: str, **options: Any) -> AsyncIterator[Bench]:
    """A bench that is open, armed and runs; closed at the end, and its loop must have survived."""
    bench = make_bench(*amplifiers, **options)
    await bench.controller.open()
    await bench.controller.arm()
    task = asyncio.create_task(bench.controller.run())
    await asyncio.sleep(0.001)
    try:
        yield bench
    finally:
        await bench.controller.close()
        await task


FINGER = (1, 0.5, 0.5)
OTHER = (2, 0.9, 0.9)


def test_touch_to_wire(run_virtual: Run) -> None:
    """A touch is on the wire in the same moment, as worked out by hand, and is told as confirmed.

    20 of 100 µm is level 0.2; the pattern's own ramp goes with it; latency counts from the frame.
    """

    async def scenario() -> None:
        async with running() as bench:
            bench.touch(FINGER, ago=0.003)
            await asyncio.sleep(0.001)
            played = bench.far_end.sets()[-1]
            assert [(c.channel, c.frequency, c.phase) for c in played.commands] == [
                (0, 110.0, 90.0),
                (1, 40.0, 0.0),
            ]
            assert [c.level for c in played.commands] == pytest.approx([0.2, 0.0])
            assert played.ramp == 0.015
            (applied,) = bench.told.applied
            assert applied.latency == pytest.approx(0.003)
            assert (applied.target.x, applied.target.y) == pytest.approx((0.15, 0.1))
            assert applied.quiet == ()
            assert applied.pattern.level_db_sl == 20.0
            assert applied.drive == {"SW": played.commands[0]}
            assert bench.told.contacts == [1]

    run_virtual(scenario())


def test_last_finger_up(run_virtual: Run) -> None:
    """When the last finger lifts, every channel is at zero within 20 ms, ramp included."""

    async def scenario() -> None:
        async with running() as bench:
            bench.touch(FINGER, OTHER)
            await asyncio.sleep(0.02)
            lifted = asyncio.get_running_loop().time()
            bench.touch()
            await asyncio.sleep(0.02)
            zero = bench.far_end.sets()[-1]
            assert zero.is_silent
            assert {command.channel for command in zero.commands} == {0, 1}
            assert bench.far_end.times(Apply)[-1] + zero.ramp - lifted <= 0.020
            assert bench.told.silenced[-1].reason == "nobody touches the plate"
            assert bench.told.silenced[-1].latency == 0.0

    run_virtual(scenario())


def test_a_source_that_falls_silent(run_virtual: Run) -> None:
    """150 ms after the last news the contact counts as lifted, and zero is on the wire."""

    async def scenario() -> None:
        async with running() as bench:
            bench.touch(FINGER)
            start = asyncio.get_running_loop().time()
            await asyncio.sleep(0.3)
            assert [each.is_silent for each in bench.far_end.sets()] == [True, False, True]
            assert bench.far_end.times(Apply)[-1] == pytest.approx(start + 0.150, abs=1e-6)

    run_virtual(scenario())


def test_nothing_is_sent_twice(run_virtual: Run) -> None:
    """A finger at rest, repeated by its source, costs the wire heartbeats only."""

    async def scenario() -> None:
        async with running() as bench:
            await bench.hold(FINGER, seconds=1.0)
            assert len(bench.far_end.sets()) == 2  # silence after arming, then the pattern

    run_virtual(scenario())


def test_heartbeat_pace(run_virtual: Run) -> None:
    """While armed a heartbeat goes out every 50 ms, whether or not anybody touches."""

    async def scenario() -> None:
        async with running() as bench:
            await asyncio.sleep(0.5)
            await bench.hold(FINGER, seconds=0.5)
            times = bench.far_end.times(Ping)
            pauses = [later - earlier for earlier, later in pairwise(times)]
            assert len(pauses) in (19, 20)  # within a second, by rounding
            assert pauses == pytest.approx([0.05] * len(pauses), abs=1e-6)

    run_virtual(scenario())


def test_heartbeat_only_after_the_loop_has_run(run_virtual: Run) -> None:
    """Nothing but a turn of the loop beats, once per turn, and after what the turn had to send."""

    async def scenario() -> None:
        bench = make_bench()
        await bench.controller.open()
        await bench.controller.arm()
        await asyncio.sleep(1.0)
        assert bench.far_end.requests(Ping) == []
        bench.touch(FINGER)
        await bench.controller.step()
        kinds = [type(request) for _, request in bench.far_end.asked]
        assert kinds == [Hello, GetCaps, Arm, Apply, Ping]
        await asyncio.sleep(1.0)
        assert len(bench.far_end.requests(Ping)) == 1
        await bench.controller.close()

    run_virtual(scenario())


def test_a_hung_loop_does_not_beat(run_virtual: Run) -> None:
    """While the loop waits for an amplifier that does not answer, the other gets no heartbeat."""

    async def scenario() -> None:
        async with running("a", "b") as bench:
            slow, other = bench.far_ends
            slow.delay = 0.4
            hung = asyncio.get_running_loop().time()
            bench.touch(FINGER)
            await asyncio.sleep(0.35)
            assert [time for time in other.times(Ping) if time > hung] == []
            slow.delay = 0.0
            await asyncio.sleep(0.5)
            assert [time for time in other.times(Ping) if time > hung] != []

    run_virtual(scenario())


def test_the_latest_frame_wins(run_virtual: Run) -> None:
    """Frames that come while a command is on the wire are not sent one by one."""

    async def scenario() -> None:
        async with running() as bench:
            bench.far_end.delay = 0.02
            bench.touch(FINGER)
            for step in range(1, 10):
                await asyncio.sleep(0.001)
                bench.touch((1, 0.5 + 0.04 * step, 0.5))
            await asyncio.sleep(0.1)
            assert [round(applied.target.x, 3) for applied in bench.told.applied] == [0.15, 0.258]

    run_virtual(scenario())


def test_disarmed_at_first(run_virtual: Run) -> None:
    """Until armed, contacts are followed and nothing is sent; then fingers already there feel."""

    async def scenario() -> None:
        bench = make_bench()
        with pytest.raises(CommandError, match="not open yet"):
            await bench.controller.arm()
        await bench.controller.open()
        assert bench.controller.phase is Phase.DISARMED
        task = asyncio.create_task(bench.controller.run())
        await bench.hold(FINGER, seconds=0.3)
        assert bench.told.contacts == [1]
        assert bench.far_end.requests(Apply, Ping, Arm) == []
        await bench.controller.arm()
        await bench.hold(FINGER, seconds=0.1)
        assert [each.is_silent for each in bench.far_end.sets()] == [False]
        await bench.controller.disarm()
        await bench.hold(OTHER, seconds=0.3)
        assert len(bench.far_end.sets()) == 1
        assert isinstance(bench.far_end.asked[-1][1], Disarm)
        await bench.controller.close()
        await task

    run_virtual(scenario())


@pytest.mark.parametrize(
    ("error", "reason", "logged"),
    [
        (InputError("no pattern reaches 20 dB SL there"), "no pattern reaches 20 dB SL there", 0),
        (ZeroDivisionError("a bug"), "ZeroDivisionError: a bug", 1),
    ],
)
def test_a_table_that_fails(
    run_virtual: Run,
    caplog: pytest.LogCaptureFixture,
    error: Exception,
    reason: str,
    logged: int,
) -> None:
    """No answer is silence with its reason; a bug is logged once; the next touch is felt again."""

    async def scenario() -> None:
        async with running() as bench:
            await bench.hold(FINGER, seconds=0.1)
            excitation, bench.table.excitation = bench.table.excitation, error
            await bench.hold(FINGER, OTHER, seconds=0.2)
            assert [each.is_silent for each in bench.far_end.sets()] == [True, False, True]
            assert bench.told.silenced[-1].reason == reason
            bench.table.excitation = excitation
            bench.touch(FINGER)
            bench.touch(FINGER, (3, 0.1, 0.1))
            await asyncio.sleep(0.01)
            assert not bench.far_end.sets()[-1].is_silent

    run_virtual(scenario())
    assert len([r for r in caplog.records if r.levelno == logging.ERROR]) == logged


@pytest.mark.parametrize(
    ("excitation", "complaint"),
    [
        ({"SW": Tone(110.0, 101e-6)}, r"main: CommandRefused: level of channel 0 is 1\.01"),
        ({"SW": Tone(39.0, 10e-6)}, "main: CommandRefused: frequency of channel 0 is 39 Hz"),
        ({"SW": Tone(110.0, math.nan)}, "main: CommandRefused: level of channel 0 is nan"),
    ],
)
def test_guard_refuses(run_virtual: Run, excitation: Excitation, complaint: str) -> None:
    """A pattern that the guard does not let through becomes a zero command, and is told."""

    async def scenario() -> None:
        async with running() as bench:
            await bench.hold(FINGER, seconds=0.1)
            bench.table.excitation = excitation
            await bench.hold(FINGER, OTHER, seconds=0.1)
            assert [each.is_silent for each in bench.far_end.sets()] == [True, False, True]
            (refusal,) = bench.told.refused
            assert re.match(complaint, refusal)
            assert bench.told.silenced[-1].reason == refusal
            assert bench.controller.phase is Phase.ARMED

    run_virtual(scenario())


def test_an_era_that_the_rig_has_not(run_virtual: Run) -> None:
    """A table that drives an unknown ERA makes silence, not half a pattern."""

    async def scenario() -> None:
        async with running() as bench:
            bench.table.excitation = {"SW": Tone(110.0, 1e-6), "XX": Tone(110.0, 1e-6)}
            await bench.hold(FINGER, seconds=0.1)
            assert all(each.is_silent for each in bench.far_end.sets())
            assert "drives XX" in bench.told.silenced[-1].reason

    run_virtual(scenario())


def test_nan_touch(run_virtual: Run) -> None:
    """A touch that is nowhere sends nothing and is counted."""

    async def scenario() -> None:
        async with running() as bench:
            before = len(bench.far_end.sets())
            await bench.hold((1, math.nan, 0.5), (2, 0.5, 1.2), seconds=0.1)
            assert len(bench.far_end.sets()) == before
            assert bench.told.contacts == []
            assert bench.controller.rejected_touches == {"not_finite": 2, "off_plate": 2}

    run_virtual(scenario())


def test_link_lost(run_virtual: Run) -> None:
    """A link that breaks stops the other amplifier, is told, and ends the loop with the error."""

    async def scenario() -> None:
        bench = make_bench("a", "b")
        await bench.controller.open()
        await bench.controller.arm()
        task = asyncio.create_task(bench.controller.run())
        await bench.hold(FINGER, seconds=0.1)

        def break_off(request: Request) -> Reply | None:
            raise LinkError("the cable was pulled")

        bench.far_ends[0].answer = break_off
        await asyncio.sleep(0.1)
        assert bench.controller.phase is Phase.LOST
        assert len(bench.far_ends[1].requests(Stop)) == 1
        assert len(bench.told.lost) == 1
        assert "the cable was pulled" in bench.told.lost[0]
        with pytest.raises(LinkError, match="the cable was pulled"):
            await task
        with pytest.raises(CommandError, match="open all again"):
            await bench.controller.arm()
        await bench.controller.close()
        assert not bench.far_ends[1].is_open

    run_virtual(scenario())


def test_together_or_not_at_all(run_virtual: Run) -> None:
    """Several amplifiers stage under one token, all before any commits, and are read back."""

    async def scenario() -> None:
        async with running("a", "b") as bench:
            bench.far_ends[0].delay = 0.004
            before = len(bench.far_ends[1].asked)
            bench.touch(FINGER)
            await asyncio.sleep(0.03)
            first, second = bench.far_ends
            kinds = [type(request) for _, request in second.asked[before:]]
            assert kinds == [Stage, Commit, GetStatus]
            assert second.times(Commit)[-1] >= first.times(Stage)[-1] + 0.004
            tokens = {
                request.command_set.token
                for far_end in bench.far_ends
                for request in [far_end.requests(Stage)[-1]]
                if isinstance(request, Stage)
            }
            assert tokens == {first.token} == {second.token}
            assert bench.told.applied[-1].drive.keys() == {"SW"}

    run_virtual(scenario())


@pytest.mark.parametrize(
    ("kind", "reply"),
    [
        (Stage, Nak(NakCode.BAD_VALUE, 1)),
        (Commit, Nak(NakCode.BAD_TOKEN)),
        (
            GetStatus,
            Status(State.OPERATION_ENABLED, Fault.NONE, 9999, True, 25.0, 0.2, (0.0, 0.0)),
        ),
        (Ping, Status(State.FAULT, Fault.ARC, 1, False, 25.0, 0.0, (0.0, 0.0))),
    ],
)
def test_one_of_several_fails(run_virtual: Run, kind: type[Request], reply: Reply) -> None:
    """Whatever one amplifier does not do, all are stopped, disarmed and stay so; it is told."""

    async def scenario() -> None:
        async with running("a", "b") as bench:
            bench.far_ends[1].answer = lambda request: reply if isinstance(request, kind) else None
            await bench.hold(FINGER, seconds=0.2)
            assert [len(far_end.requests(Stop)) for far_end in bench.far_ends] == [1, 1]
            assert bench.controller.phase is Phase.DISARMED
            assert len(bench.told.refused) == 1
            assert bench.told.applied == [] or kind is Ping
            asked = len(bench.far_ends[0].asked)
            await bench.hold(FINGER, OTHER, seconds=0.2)
            assert len(bench.far_ends[0].asked) == asked

    run_virtual(scenario())


def test_stop_is_latched(run_virtual: Run) -> None:
    """After a stop nothing arms before it was acknowledged, and touches are not felt."""

    async def scenario() -> None:
        async with running() as bench:
            await bench.controller.stop()
            with pytest.raises(CommandRefused, match="stopped"):
                await bench.controller.arm()
            assert bench.controller.phase is Phase.DISARMED
            await bench.controller.clear()
            await bench.controller.arm()
            bench.touch(FINGER)
            await asyncio.sleep(0.01)
            assert not bench.far_end.sets()[-1].is_silent

    run_virtual(scenario())


def test_stop_between_stage_and_commit(run_virtual: Run) -> None:
    """A set that was staged when the stop came is never committed, and no error is made of it."""

    async def scenario() -> None:
        async with running("a", "b") as bench:
            bench.far_ends[0].delay = 0.01
            commits = len(bench.far_ends[1].requests(Commit))
            bench.touch(FINGER)
            await asyncio.sleep(0.005)
            await bench.controller.stop()
            await asyncio.sleep(0.1)
            assert len(bench.far_ends[1].requests(Commit)) == commits
            assert bench.told.refused == []

    run_virtual(scenario())


def test_close(run_virtual: Run) -> None:
    """Closing ramps to zero in 50 ms, reads zero back, disarms, closes and ends the loop."""

    async def scenario() -> None:
        bench = make_bench()
        await bench.controller.open()
        await bench.controller.arm()
        task = asyncio.create_task(bench.controller.run())
        bench.touch(FINGER)
        await asyncio.sleep(0.01)
        before = len(bench.far_end.asked)
        start = asyncio.get_running_loop().time()
        await bench.controller.close()
        await task
        (zero_at, zero), (read_at, _), _ = bench.far_end.asked[before:]
        assert isinstance(zero, Apply)
        assert zero.command_set.is_silent
        assert zero.command_set.ramp == 0.05
        assert zero_at == start
        assert read_at >= start + 0.05
        assert [type(request) for _, request in bench.far_end.asked[before:]] == [
            Apply,
            GetStatus,
            Disarm,
        ]
        assert not bench.far_end.is_open
        await bench.controller.close()

    run_virtual(scenario())


def test_close_without_proof_of_silence(run_virtual: Run, caplog: pytest.LogCaptureFixture) -> None:
    """An amplifier that goes on reporting a level is stopped, and that is logged."""

    async def scenario() -> None:
        async with running() as bench:
            bench.far_end.answer = lambda request: (
                Status(State.OPERATION_ENABLED, Fault.NONE, 1, True, 25.0, 0.2, (0.3, 0.0))
                if isinstance(request, GetStatus)
                else None
            )
        assert isinstance(bench.far_end.asked[-1][1], Stop)
        assert not bench.far_end.is_open

    run_virtual(scenario())
    assert "reports a level after it was told to be silent" in caplog.text


def test_an_observer_that_fails(run_virtual: Run, caplog: pytest.LogCaptureFixture) -> None:
    """Whatever an observer raises is logged, and the finger feels what it should."""

    def fail(*_: object) -> None:
        raise RuntimeError("no disk space for this row")

    async def scenario() -> None:
        observer = Observer(contacts_changed=fail, pattern_applied=fail, silenced=fail)
        async with running(observer=observer) as bench:
            bench.touch(FINGER)
            await asyncio.sleep(0.01)
            bench.touch()
            await asyncio.sleep(0.2)
            assert [each.is_silent for each in bench.far_end.sets()] == [True, False, True]
            assert len(bench.far_end.requests(Ping)) > 3

    run_virtual(scenario())
    assert "no disk space for this row" in caplog.text


class FailingSource(TouchSource):
    """A touch source that sees one finger and then breaks."""

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Break after 10 ms."""
        deliver(TouchFrame("weak", asyncio.get_running_loop().time(), (Touch(1, 0.5, 0.5),)))
        await asyncio.sleep(0.01)
        raise OSError("the panel was unplugged")


def test_a_source_that_fails(run_virtual: Run, caplog: pytest.LogCaptureFixture) -> None:
    """A source that breaks is told; its finger expires; other sources go on."""

    async def scenario() -> None:
        async with running(sources=[FailingSource()]) as bench:
            await asyncio.sleep(0.2)
            assert bench.told.failed == ["OSError: the panel was unplugged"]
            assert bench.far_end.sets()[-1].is_silent
            assert len(bench.told.applied) == 1
            bench.touch(FINGER)
            await asyncio.sleep(0.01)
            assert len(bench.told.applied) == 2

    run_virtual(scenario())
    assert "the panel was unplugged" in caplog.text


def test_a_rig_that_does_not_fit(run_virtual: Run) -> None:
    """Amplifiers the rig does not name, and channels an amplifier has not, are refused at once."""

    async def scenario() -> None:
        far_end = FarEnd(channels=1)
        table = Table({})
        with pytest.raises(InputError, match="names the amplifiers main, but given are other"):
            Controller(rig("main"), table, amplifiers={"other": Amplifier(far_end)})
        controller = Controller(rig("main"), table, amplifiers={"main": Amplifier(far_end)})
        with pytest.raises(InputError, match="ERA NE is wired to channel 1 of amplifier main"):
            await controller.open()
        assert not far_end.is_open

    run_virtual(scenario())
