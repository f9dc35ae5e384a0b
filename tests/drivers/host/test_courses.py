"""Groups on lines in virtual time that lose frames, and that fail where they should not.

Courses in YAML, each by the sentence that it proves. Sets play whole and once, or it is said that
they do not; no late status makes a sound amplifier contradict its requests. What a person would
feel is read from the simulated amplifiers themselves.
"""

import asyncio
import itertools
import random
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from drivers.by_hand.actions import read_electrical
from drivers.errors import LinkTimeout
from drivers.host.group import Group
from drivers.host.joint_sets import PlayedSet
from drivers.host.ledger import Ledger
from drivers.host.requests import Priority
from drivers.host.set_admission import StagedSet
from drivers.host.stops import StopOutcome
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import CLOCK_UNKNOWN, FEATURES, MESSAGES, STATES
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Command, Envelope
from drivers.wires.can_frames import CanFrame, pack_frames, segments
from drivers.wires.serial_frames import REPLY_BIT, FrameReader, encode_frame, pack_words
from drivers.wires.serial_line import SerialWire
from drivers.wires.wire import BrokenReply
from kit.clock import KINDS, MemoryLine, delayed, group_of, losing, of_parts, unaltered
from kit.courses import Taken, courses, follow
from registry import threads
from sim.amplifier.amplifier_clock import AmplifierClock, Crystal
from sim.amplifier.simulated_amplifier import SimulatedAmplifier as FarEnd


def altered(
    far: FarEnd, change: Callable[[str, Values, float, Callable[..., Values]], Values]
) -> None:
    """Have a far end reply by a function of the request, its time, and what it does itself."""
    handle = far.handle
    far.handle = lambda name, values, now, **options: change(  # type: ignore[method-assign]
        name, values, now, partial(handle, **options)
    )


def _layer(row: Sequence[float] | Mapping[str, Any]) -> AmplifierLayer:
    """A layer of a row: layer, channel, level, frequency [Hz]; the layer alone ends it.

    Or by name: layer, tones as rows of channel, level, frequency, the arguments of a layer, and
    keep_phase and onset (its step [us], and knots) of all tones. Its ramp is 1 ms unless given.
    """
    if not isinstance(row, Mapping):
        row = {"layer": row[0], "tones": [row[1:]] if len(row) > 1 else []}
    given = {"ramp": 0.001, "tones": [], "onset": [0], **row}
    number, tones, (step, *knots) = (given.pop(each) for each in ("layer", "tones", "onset"))
    keep_phase = given.pop("keep_phase", False)
    onset = Envelope(step, tuple(map(tuple, knots))) if knots else None
    made = [
        AmplifierTone(channel, frequency, level, keep_phase=keep_phase, onset=onset)
        for channel, level, frequency in tones
    ]
    return AmplifierLayer(number, tuple(made), **given)


@dataclass
class OnLines(Taken):
    """A group on lines, which takes steps; lines are given by number, amplifiers by name."""

    lines: Sequence[MemoryLine] = ()
    group: Group = field(init=False)
    applied: PlayedSet = field(init=False)
    stopped: dict[str, StopOutcome] = field(default_factory=dict)
    kept: list[bytes] = field(default_factory=list)
    has_come: bool = False
    since: float = 0.0

    @property
    def far(self) -> SimpleNamespace:
        """The amplifiers by name."""
        return SimpleNamespace(
            **{name: far for line in self.lines for name, far in line.far.items()}
        )

    @property
    def hosts(self) -> SimpleNamespace:
        """What the host has of them, by name."""
        return SimpleNamespace(**self.group.amplifiers)

    @property
    def levels(self) -> dict[str, list[float]]:
        """What channels play now."""
        return {name: line.levels(name) for line in self.lines for name in line.far}

    @property
    def sent(self) -> list[list[str]]:
        """What was sent on each line since `forget`, as address:number."""
        return [[each for _, each in line.sent] for line in self.lines]

    @property
    def unexpected(self) -> int:
        """Frames that belonged to nothing."""
        return sum(line.line.wire.counters.unexpected_frames for line in self.lines)

    @property
    def is_loud(self) -> bool:
        """Whether any amplifier plays."""
        return any(map(any, self.levels.values()))

    @property
    def retries(self) -> int:
        """Requests that were repeated."""
        return sum(line.retries for line in self.lines)

    def forget(self) -> None:
        """Forget what was sent so far."""
        self.since = self.lines[0].loop.time()
        for line in self.lines:
            line.sent.clear()

    def never_sent(self, line: int, *requests: str) -> None:
        """Require that none of these was sent on a line."""
        assert not {*requests} & {*self.sent[line]}

    def sent_within(self, request: str, seconds: float, line: int = 0, least: float = 0.0) -> None:
        """Require that a request was sent on a line so soon after `forget`, but not sooner."""
        first = next(at for at, each in self.lines[line].sent if each == request)
        assert least <= first - self.since <= seconds

    async def waits_until(self, seconds: float) -> None:
        """Wait until so long after `forget`."""
        await asyncio.sleep(self.since + seconds - self.lines[0].loop.time())

    async def waits_until_sent(self, request: str) -> None:
        """Wait until a request is the last that was sent on the first line."""
        while self.sent[0][-1] != request:  # noqa: ASYNC110
            await asyncio.sleep(0.0001)

    async def applies_parts(self, count: int) -> None:
        """Apply a set of about so many parts to the first amplifier."""
        await self.group.apply({"a": of_parts(count)})

    async def measures(self, name: str) -> None:
        """Read the voltages of one."""
        await read_electrical(self.group.amplifiers[name])

    def plans_nothing(self, text: str) -> None:
        """Require that what is planned is refused, with this text."""
        planned = {"a": StagedSet([_layer((0, 0, 0.5, 100.0))])}
        assert text in str(self.group.sets.refusal_of(planned))

    async def applies(self, **rows: Sequence[Sequence[float] | Mapping[str, Any]]) -> None:
        """Apply layers of rows by amplifier."""
        layers = {name: [*map(_layer, each)] for name, each in rows.items()}
        self.applied = await self.group.apply(layers)

    async def plays(self, level: float) -> None:
        """Play 100 Hz at a level on the first channel of all amplifiers, in layer 0."""
        await self.applies(**{name: [(0, 0, level, 100.0)] for name in self.group.amplifiers})

    async def plays_unless_one_has_come(self, level: float) -> None:
        """Do the same, and give way as soon as `has_come`."""
        layers = [_layer((0, 0, level, 100.0))]
        sets = {name: StagedSet(layers) for name in self.group.amplifiers}
        await self.group.play(sets, lambda: self.has_come)

    def plans(self, level: float) -> None:
        """Ask whether the first amplifier may play 100 Hz at a level: it may."""
        self.planned = {"a": StagedSet([_layer((0, 0, level, 100.0))])}
        assert self.group.sets.refusal_of(self.planned) is None

    async def plays_as_planned(self) -> None:
        """Play what the first amplifier may play, as it was asked."""
        await self.group.play(self.planned)

    async def waits_past_the_start(self, seconds: float) -> None:
        """Wait until so long after the moment at which what was applied last starts."""
        await asyncio.sleep(self.applied.starts_at + seconds - self.lines[0].loop.time())

    def start_together(self, channel: int, seconds: float, *, as_said: bool = False) -> None:
        """Require that each amplifier has one voice on a channel, and all began within a time.

        as_said: at the moment that was said of the set that was applied last.
        """
        assert self.levels  # which lets happen what is due
        began = [each.began for far in vars(self.far).values() for each in _voices(far, channel)]
        assert len(began) == len(vars(self.far))
        began += [self.applied.starts_at] * as_said
        assert max(began) - min(began) < seconds

    def voices(self, *frequencies: float) -> None:
        """Require the voices of the first channel [Hz], as amplifier a and its host have them."""
        for each in (self.far.a, self.hosts.a.ledger):
            assert [voice.frequency for voice in _voices(each, 0)] == [*frequencies]

    async def achieves(self, **values: int) -> None:
        """Require what the first amplifier says of the first tone that was applied last."""
        layer, token = self.applied.layers["a"][0], self.applied.token
        (tone,) = (await self.hosts.a.read_achieved(layer, token)).commands
        found = {what: getattr(tone, what) for what in values}
        assert found == values

    async def reads(self, name: str, times: int = 1) -> None:
        """Read the status of one, so often at once."""
        await asyncio.gather(*(self.group.amplifiers[name].read_status() for _ in range(times)))

    async def reads_last(self, name: str) -> None:
        """Read the status of one with the priority of readings, which go after all else."""
        await getattr(self.hosts, name).read_status(Priority.READING)

    async def beats(self, times: int) -> None:
        """Beat so often, 50 ms after one another."""
        for _ in range(times):
            await asyncio.sleep(0.05)
            await self.group.beat()

    async def stops(self, **confirmed: bool) -> None:
        """Stop all; it is confirmed, or not, that they are silent."""
        self.since = self.lines[0].loop.time()
        self.stopped = {**await self.group.stop()}
        assert {name: each.is_confirmed for name, each in self.stopped.items()} == confirmed
        assert all(each.is_confirmed or each.cause for each in self.stopped.values())

    def answers_after(self, *delays: float) -> None:
        """Let replies come after these times, the last for all that follow; without any, none."""
        for line in self.lines:
            left = [*delays]
            line.outward = (
                lambda _, data, left=left: [  # type: ignore[misc]
                    (left.pop(0) if len(left) > 1 else each, data) for each in left[:1]
                ]
            )

    def mute(self, number: int, seconds: float = 1e9) -> None:
        """Let no reply come on a line, for a time."""
        line = self.lines[number]
        until = line.loop.time() + seconds
        line.outward = lambda _, data: [] if line.loop.time() < until else [(0.0, data)]

    def tells_nothing(self, address: str) -> None:
        """Let no reply come to a request at an address of the first line."""
        (line, *_) = self.lines
        answered = line.outward
        line.outward = lambda name, data: (
            [] if line.sent[-1][1].startswith(address) else answered(name, data)
        )

    def hears_nothing(self, *names: str) -> None:
        """Let amplifiers of the first line get nothing that is for them alone."""
        (line, *_) = self.lines
        muted = {line.hosts[name].address for name in names}
        line.inward = lambda _, data: [] if line.kind.request_of(data)[0] in muted else [(0, data)]  # type: ignore[index]

    def misses(self, name: str, count: int, line: int) -> None:
        """Lose so many requests of a name on a line."""
        self.lines[line].inward = losing(name, count=count)

    def misses_parts(self, *numbers: int) -> None:
        """Lose the parts of sets on the first line that have these numbers, from 0 on."""
        counted = itertools.count()
        self.lines[0].inward = lambda name, data: (
            [] if name == "Set" and next(counted) in numbers else unaltered(name, data)
        )

    def misses_all_parts(self) -> None:
        """Let the first amplifier say that no part of a set has come."""
        said = {"exact": 0, "staged": 0, "played": 0, "missing": 0}
        self.far.a._take_part = lambda part, now: {**said, "token": part["token"]}

    def says_other_tokens(self, count: int) -> None:
        """Let the first amplifier take so many parts under another token."""
        take, left = self.far.a._take_part, [1] * count
        self.far.a._take_part = lambda part, now: (
            take(part, now) | {"token": part["token"] ^ (left.pop() if left else 0)}
        )

    def replies_come_twice(self) -> None:
        """Let each reply on the first line come once more."""
        self.lines[0].outward = lambda _, data: [(0.0002, data), (0.004, data)]

    def loses_in_turn(self, *requests: str) -> None:
        """Lose these requests on the first line, as they come one after the other."""
        (line, *_), self.to_lose = self.lines, [*requests]
        line.inward = lambda name, data: (
            []
            if self.to_lose and line.sent[-1][1] == self.to_lose[0] and self.to_lose.pop(0)
            else unaltered(name, data)
        )

    def marks_come_twice(self) -> None:
        """Let every third Mark come once more, up to 60 ms later."""
        rng = random.Random(1)
        self.lines[0].inward = lambda name, data: (
            unaltered(name, data)
            + ([(rng.uniform(0.0, 0.06), data)] * (name == "Mark" and rng.random() < 1 / 3))
        )

    def loses_replies(self, name: str, count: int) -> None:
        """Lose so many replies to requests of a name on each line."""
        for line in self.lines:
            line.outward = losing(name, count=count)

    def is_late(self, **delays: float) -> None:
        """Let replies to requests of these names come after these times, on the first line."""
        self.lines[0].outward = lambda name, data: [(delays.get(name, 0.0002), data)]

    def arrives_after(self, seconds: float, **by_name: float) -> None:
        """Let requests on the first line arrive so much later, some by name."""
        self.lines[0].inward = lambda name, data: [(by_name.get(name, seconds), data)]

    def reply_cannot_be_read(self) -> None:
        """Let the next reply on the first line be broken."""
        wire, broken = self.lines[0].line.wire, [[BrokenReply("cut")]]
        received = wire.received
        wire.received = lambda data: broken.pop() if broken else received(data)  # type: ignore[method-assign]

    def keeps_replies(self) -> None:
        """Keep a copy of what comes to the host on the first line."""
        self.lines[0].outward = lambda _, data: self.kept.append(data) or [(0.0, data)]  # type: ignore[func-returns-value]

    def keeps_requests_but(self, number: int) -> None:
        """Keep what is sent on the first line; that of a number, from 0 on, arrives."""
        self.kept.clear()
        self.lines[0].inward = lambda _, data: (
            self.kept.append(data) or [(0.0002, data)] * (len(self.kept) == number + 1)  # type: ignore[func-returns-value]
        )

    def last_request_arrives(self) -> None:
        """Let the last request that was kept arrive."""
        self.lines[0].later(0.0, self.lines[0].arrives, "Ping", self.kept[-1])

    def hands_over_the_copies(self) -> None:
        """Let all copies come once more."""
        for data in self.kept:
            self.lines[0].line.received(data)

    def timers_come_early(self, seconds: float) -> None:
        """Let timers that are due later than that come so much earlier."""
        loop = self.lines[0].loop
        call_at = loop.call_at
        loop.call_at = lambda when, *given, **more: call_at(  # type: ignore[method-assign]
            when - seconds if when - loop.time() > seconds + 0.0005 else when, *given, **more
        )

    def blocks_writes(self, line: int, *numbers: int) -> None:
        """Let the port of a line take none of the writes with these numbers, from 1 on."""
        end, counted = self.lines[line], itertools.count(1)

        def write(data: bytes) -> None:
            if next(counted) in numbers:
                raise LinkTimeout("write blocked; check the network")
            MemoryLine.write(end, data)

        end.write = write  # type: ignore[method-assign]

    def broadcasts_fail(self) -> None:
        """Let a bug end each broadcast on the first line."""
        line = self.lines[0].line
        submit, fail = line.submit, Mock(side_effect=ZeroDivisionError("planted"))
        line.submit = lambda member, *given, **more: (submit if member else fail)(
            member, *given, **more
        )

    def lies(self, **said: Any) -> None:
        """Let the first amplifier say something else in each status."""
        far = self.far.a
        status = far.status
        said |= {"state": STATES[said["state"]]} if "state" in said else {}
        far.status = lambda now: {**status(now), **said}

    def obeys_instead(self, **instead: str) -> None:
        """Let the first amplifier take requests of some names for others."""
        altered(
            self.far.a,
            lambda name, values, now, handle: handle(
                instead.get(name, name), {} if name in instead else values, now
            ),
        )

    def commits(self, name: str, count: int) -> None:
        """Let an amplifier play so many layers of each set, and say that it plays the set."""
        playback = getattr(self.far, name).playback
        commit = playback.commit
        playback.commit = lambda layers, *when: count and commit(layers[:count], *when)

    def refuses_after(self, name: str, count: int, status: str = "BUSY", times: int = 99) -> None:
        """Let the first amplifier refuse requests of a name once it has taken some, so often."""
        taken = itertools.count()

        def busy(asked: str, values: Values, now: float, handle: Callable[..., Values]) -> Values:
            if asked == name and count <= next(taken) < count + times:
                raise Refusal("as told", status)
            return handle(asked, values, now)

        altered(self.far.a, busy)

    def trips_at(self, name: str, fault: str) -> None:
        """Let the first amplifier trip as it carries out requests of a name, and say so."""

        def trip(asked: str, values: Values, now: float, handle: Callable[..., Values]) -> Values:
            reply = handle(asked, values, now)
            if asked == name:
                self.far.a.trip(fault, now)
            return self.far.a.status(now) if asked == name else reply

        altered(self.far.a, trip)

    async def has(self, **capabilities: Any) -> None:
        """Give the first amplifier other capabilities, or features by name, then arm all."""
        can = self.far.a.capabilities
        features = sum(1 << FEATURES[each] for each in capabilities.pop("features", ()))
        self.far.a.capabilities = {**can, "features": can["features"] | features, **capabilities}
        await self.group.open()
        await self.group.arm()

    def rounds(self, **steps: int) -> None:
        """Let the first amplifier play multiples of steps alone, and say that no set is exact."""
        far = self.far.a
        commit, take = far.playback.commit, far._take_part

        def rounded(tone: Command) -> Command:
            shares = {
                what: step * round(getattr(tone, what) / step) for what, step in steps.items()
            }
            return replace(tone, **shares)

        far.playback.commit = lambda layers, *when: commit(
            [replace(each, commands=tuple(map(rounded, each.commands))) for each in layers], *when
        )
        far._take_part = lambda part, now: {**take(part, now), "exact": 0}

    def says_frequency(self, said: int) -> None:
        """Let the first amplifier say a frequency of all tones that it achieves."""

        def say(name: str, values: Values, now: float, handle: Callable[..., Values]) -> Values:
            reply = handle(name, values, now)
            for each in reply["commands"] if name == "GetAchieved" else ():
                each["frequency"] = said
            return reply

        altered(self.far.a, say)

    def has_clock(self, name: str, ahead: float, *, is_steered: bool = True) -> None:
        """Give an amplifier a clock that is ahead by a time [s]."""
        far = getattr(self.far, name)
        far.clock = AmplifierClock(Crystal(ahead=ahead), since=self.lines[0].loop.time())
        if not is_steered:
            far.capabilities["clock_error"] = CLOCK_UNKNOWN

    async def feeds(self, name: str) -> None:
        """Feed an amplifier without end, each time that it has replied."""
        while True:
            await getattr(self.hosts, name).ping()

    def restarts(self, **capabilities: Any) -> None:
        """Switch the first amplifier off and on again, with other capabilities: CAN nodes boot."""
        (line, *_), far = self.lines, self.far.a
        far.capabilities = {**far.capabilities, **capabilities}
        far.restart(line.loop.time())
        if line.kind is KINDS["can"]:
            line.boot(1)

    def is_randomly_late(self) -> None:
        """Let what passes the first line come up to 14 ms late."""
        delayed(self.lines[0], random.Random(6))

    def long_replies_are_late(self, seconds: float) -> None:
        """Let replies of more than 8 bytes come so much later on the first line."""
        self.lines[0].outward = lambda _, data: [(seconds if len(data) > 8 else 0.0, data)]

    def says_that_each_part_plays(self) -> None:
        """Let the first amplifier reply to each part of a set that the set plays."""
        (line, *_), taken = self.lines, {"exact": 1, "staged": 0, "played": 1, "missing": 0}
        payload = pack_words(
            MESSAGES["Set"].reply.pack({"token": self.group.sets.token + 1, **taken})
        )

        def replied(name: str, data: bytes) -> list[tuple[float, bytes]]:
            (frame,) = FrameReader().feed(data)
            if name == "Set":
                reply = frame._replace(kind=MESSAGES["Set"].number | REPLY_BIT, payload=payload)
                line.later(0.0001, line.line.received, encode_frame(reply))
            return unaltered(name, data)

        line.inward = replied

    @property
    def last_voices(self) -> list[tuple[float, int]]:
        """When what the last amplifier plays on its first channel began, and its layers."""
        assert self.levels  # which lets happen what is due
        return [(each.began, each.layer) for each in _voices([*vars(self.far).values()][-1], 0)]

    def remembers_voices(self) -> None:
        """Remember what the last amplifier plays on its first channel."""
        self.voices_before = self.last_voices

    def plays_on(self) -> None:
        """Require that it plays the same to the sample."""
        assert self.last_voices == self.voices_before

    def skips_tokens(self) -> None:
        """Count sets that are not sent, until the next multiple of 4096."""
        self.group.sets.token = (self.group.sets.token // 4096 + 1) * 4096 % 65536 or 1

    def counts_calls(self, what: str) -> None:
        """Count in `calls` how often a method is called, by its name."""
        owner, _, name = what.rpartition(".")
        self.calls = Mock(side_effect=getattr(self.value(owner), name))
        setattr(self.value(owner), name, self.calls)

    def draws(self, session: int) -> None:
        """Let the session that is armed next have a number."""
        self.group.draw = lambda low, high: session

    def sleeps(self, seconds: float) -> None:
        """Let this machine sleep."""
        self.lines[0].loop.now += seconds  # type: ignore[attr-defined]

    def hears_another_host(self, name: str, session: int) -> None:
        """Let another host's request to node 1 come on the first line, of CAN."""
        data = segments(99, MESSAGES[name].number, (session, 250))
        self.lines[0].line.received(pack_frames(CanFrame(0x201, each) for each in data))

    async def another_host_feeds(self, name: str) -> None:
        """Feed the watchdog of an amplifier as another host, without end."""
        while True:
            await asyncio.sleep(0.07)
            getattr(self.far, name).handle("Ping", {"session": 5, "rate": 0}, threads.now())

    async def waits_for_the_loss(self) -> None:
        """Wait until an amplifier is lost, for the host."""
        await asyncio.sleep(self.group.members.lost_from - self.lines[0].loop.time())


@asynccontextmanager
async def on_lines(*names: str, wire: str, baud: int = 0, **options: Any) -> AsyncIterator[OnLines]:
    """An armed group; names: of the amplifiers on each line, a letter each; baud: of serial lines.

    options: of the group, and is_armed.
    """
    at_baud = SerialWire(baud, sequence=0) if baud else None
    made = OnLines(lines=[MemoryLine(wire, *each, wire=at_baud) for each in names])
    made.group = await group_of(*made.lines, **options)
    yield made


def _voices(of: FarEnd | Ledger, channel: int) -> Sequence[Any]:
    """The voices of a channel, as an amplifier or a host has them."""
    return of.playback.all_voices[channel]


COURSES = courses(Path(__file__).with_name("courses.yaml"))


@pytest.mark.parametrize(
    ("name", "kind"),
    [(name, kind) for name, each in COURSES.items() for kind in each.get("wires", KINDS)],
)
def test_group_keeps_to_its_course(name: str, kind: str) -> None:
    """Every step is as it is in the file, on every kind of wire that it names, or on all."""
    course = {key: value for key, value in COURSES[name].items() if key != "wires"}
    follow({**course, "wire": kind}, on_lines)
