"""Groups on lines in virtual time that lose frames, and that fail where they should not.

Courses in YAML, each by the sentence that it proves. Sets play whole and once, or it is said that
they do not; no late status makes a sound amplifier contradict its requests. What a person would
feel is read from the simulated amplifiers themselves.
"""

import asyncio
import contextlib
import itertools
import random
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from courses import Taken, courses, follow
from drivers.errors import CommandRefused, DriverError, LinkTimeout
from drivers.host.amplifier_sensors import read_measured
from drivers.host.group import Group
from drivers.host.ledger import StopOutcome
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import MESSAGES, STATES
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Envelope, LayerSet
from drivers.wires.serial_frames import REPLY_BIT, FrameReader, encode_frame, pack_words
from sim.amplifier.simulated_amplifier import SimulatedAmplifier as FarEnd
from virtual_lines import (
    KINDS,
    MemoryLine,
    group_of,
    grouped,
    in_virtual_time,
    layer,
    losing,
    run_virtual,
    tone,
    unaltered,
)

LOST = 0.1  # of the frames, either way
LINES = {
    "one": (("a",),),
    "one line of two": (("a", "b"),),
    "two lines": (("a",), ("b",)),
}
SET = MESSAGES["Set"].number


def of_parts(count: int, level: float = 0.05) -> list[AmplifierLayer]:
    """Layers whose set has about so many parts: a layer of two onsets of 24 knots has 111 words."""
    tones = [tone(each, level, onset=Envelope(20, ((100, 0),) * 24)) for each in (0, 1)]
    return [layer(number, *tones) for number in range(count)]


async def _play(kind: str, lines: str, rng: random.Random, count: int) -> list[str]:
    """Play so many sets while frames are lost; returns what was wrong."""
    ends = [MemoryLine(kind, *names) for names in LINES[lines]]
    group = await group_of(*ends, watchdog=2.0, draw=rng.randint)
    far = {name: each for end in ends for name, each in end.far.items()}
    found, committed = list[str](), dict[tuple[str, int], Sequence[LayerSet]]()

    def noted(name: str) -> None:
        commit = far[name].playback.commit

        def note(layers: Sequence[LayerSet], token: int, time: float) -> None:
            if (name, token) in committed:
                found.append(f"{name} plays {token} twice")
            committed[name, token] = layers
            commit(layers, token, time)

        far[name].playback.commit = note  # type: ignore[method-assign]

    def losing(name: str, data: bytes) -> list[tuple[float, bytes]]:
        return [] if rng.random() < LOST else unaltered(name, data)

    for name in far:
        noted(name)
    played_sets = 0
    for _ in range(count):
        layers = of_parts(rng.randint(1, 8), rng.uniform(0.02, 0.06))
        for end in ends:
            end.inward = end.outward = losing
        result = None
        with suppress(DriverError):
            result = await group.apply(dict.fromkeys(far, layers))
        for end in ends:
            end.inward = end.outward = unaltered
        await asyncio.sleep(0.05)
        for each in far.values():
            each.tick(ends[0].loop.time())
        token = group.sets.token
        for name in far:
            words = committed.get((name, token))
            if words is not None and len(words) != len(layers):
                found.append(f"{name} plays {token} in part")
            if result is not None and words != result.layers[name]:
                found.append(f"{name} does not play {token}, though it is said")
        played_sets += result is not None
        await _recovered(group)
    if played_sets < 0.6 * count:  # of the rest it is said, as of 8 parts on Modbus RTU
        found.append(f"{played_sets} of {count} sets play")
    return found


async def _recovered(group: Group) -> None:
    """Read all amplifiers, and arm them again where they were stopped."""
    await group.statuses()
    if not group.is_armed:
        await group.clear()
        await group.arm()
    await group.silence(0.001)
    await asyncio.sleep(0.15)  # what was late has faded


CASES = [
    pytest.param(
        *(kind, lines, count),
        marks=pytest.mark.long if count > 40 or lines == "one line of two" else [],
    )
    for count in (40, 6700)
    for kind in KINDS
    for lines in LINES
]


@pytest.mark.parametrize(("kind", "lines", "count"), CASES)
def test_sets_play_whole_and_once_though_frames_are_lost(kind: str, lines: str, count: int) -> None:
    """One frame of ten either way, of sets of 1 to 8 parts; the long form: 20 000 on each wire."""
    rng = random.Random(count)
    assert run_virtual(_play(kind, lines, rng, count), rng=rng) == []


@grouped(("a",), wire="serial")
async def test_reply_to_a_part_but_the_last_is_none_of_its_set(
    group: Group, ends: list[MemoryLine]
) -> None:
    """An amplifier says of each of eight parts that the set plays: all are sent, and it does."""
    (end,) = ends
    taken = {"token": group.sets.token + 1, "exact": 1, "staged": 0, "played": 1, "missing": 0}
    payload = pack_words(MESSAGES["Set"].reply.pack(taken))

    def replied(name: str, data: bytes) -> list[tuple[float, bytes]]:
        (frame,) = FrameReader().feed(data)
        if name == "Set":
            reply = frame._replace(kind=SET | REPLY_BIT, payload=payload)
            end.later(0.0001, end.line.received, encode_frame(reply))
        return unaltered(name, data)

    end.sent.clear()
    end.inward = replied
    await group.apply({"a": of_parts(8)})
    assert [each for _, each in end.sent] == [f"1:{SET}"] * 8
    await asyncio.sleep(0.06)
    assert end.levels("a")[0] > 0.1


@grouped(("a", "b"), wire="rtu")
async def test_one_reply_is_due_at_a_time_where_two_share_a_line(
    group: Group, ends: list[MemoryLine]
) -> None:
    """Each frame but a broadcast has a response, which comes before the next frame is sent."""
    (end,) = ends
    received, due, most = end.line.received, 0, 0

    def sent(name: str, data: bytes) -> list[tuple[float, bytes]]:
        nonlocal due, most
        due += data[0] > 0
        most = max(most, due)
        return unaltered(name, data)

    def taken(data: bytes) -> None:
        nonlocal due
        due -= 1
        received(data)

    end.inward = sent
    end.line.received = taken  # type: ignore[method-assign]
    await group.apply(dict.fromkeys("ab", of_parts(3)))
    await group.beat()
    assert (due, most) == (0, 1)


LATEST = 0.014  # s, each way
PULSE = tone(level=0.0, onset=Envelope(100, ((3000, 0), (3000, 0))))  # over after 30 ms


def delayed(end: MemoryLine, rng: random.Random) -> None:
    """Have what passes a line come late, as on a busy machine."""
    end.inward = end.outward = lambda name, data: [(rng.uniform(0.0, LATEST), data)]


async def read(group: Group) -> None:
    """Read two statuses of the amplifier, which show a contradiction each."""
    for _ in range(2):
        await asyncio.sleep(0.02)
        await group.amplifiers["a"].read_status()


@pytest.mark.parametrize("ends_by", ["a pulse", "its time", "what waited"])
@in_virtual_time
async def test_what_ends_amid_an_exchange_may_be_shown_or_not(ends_by: str) -> None:
    """Up to 14 ms out, and back: a status may show the layer and its level, whenever it is read."""
    rng, end = random.Random(5), MemoryLine("serial", "a")
    group = await group_of(end, watchdog=2.0)
    host = group.amplifiers["a"]
    layers = {
        "a pulse": [layer(0, PULSE)],
        "its time": [layer(0, tone(ending=Envelope(50, ((8000, 0),))), valid_for=0.04)],
        "what waited": [layer(0, PULSE), layer(1, tone(1, 0.1))],
    }[ends_by]
    shown = set[int]()
    for _ in range(60):
        await group.apply({"a": layers})
        if ends_by == "what waited":
            await group.apply({"a": [layer(0, tone(level=0.4), after=True, valid_for=0.02)]})
        delayed(end, rng)
        for _ in range(4):
            await asyncio.sleep(rng.uniform(0.0, 0.02))
            shown.add((await host.read_status())["tokens"][0] > 0)
            assert host._contradictions == 0
        end.inward = end.outward = unaltered
        await asyncio.sleep(0.1)
    assert shown == {False, True}


@in_virtual_time
async def test_renewal_that_comes_as_its_layer_ends_may_be_too_late() -> None:
    """A layer of 40 ms is renewed about then, up to 14 ms late: it plays on, or it does not."""
    rng, end = random.Random(7), MemoryLine("serial", "a")
    group = await group_of(end, watchdog=2.0)
    host, shown = group.amplifiers["a"], set[int]()
    for _ in range(40):
        await group.apply({"a": [layer(0, tone(), valid_for=0.04)]})
        delayed(end, rng)
        await asyncio.sleep(rng.uniform(0.02, 0.045))
        await group.apply({"a": [layer(0, renew=True, valid_for=1.0)]})
        for _ in range(3):
            await asyncio.sleep(0.015)
            shown.add((await host.read_status())["tokens"][0] > 0)
            assert host._contradictions == 0
        end.inward = end.outward = unaltered
        await group.silence(0.0)
    assert shown == {False, True}


@pytest.mark.parametrize("what", ["token", "level"])
@in_virtual_time
async def test_layer_that_is_dropped_is_found_where_statuses_are_late(what: str) -> None:
    """Silent, or at half its level: by two statuses, however late."""
    end = MemoryLine("serial", "a")
    group = await group_of(end)
    await group.apply({"a": [layer(0, tone())]})
    delayed(end, random.Random(6))
    await asyncio.sleep(0.05)
    playback, now = end.far["a"].playback, end.loop.time()
    if what == "token":
        playback.silence(now, 0.0)
    else:
        playback.scale(now, 0.5, 0.0)
    with pytest.raises(CommandRefused, match=f"{what} of"):
        await read(group)


def altered(
    far: FarEnd, change: Callable[[str, Values, float, Callable[..., Values]], Values]
) -> None:
    """Have a far end reply by a function of the request, its time, and what it does itself."""
    handle = far.handle
    far.handle = lambda name, values, now, **options: change(  # type: ignore[method-assign]
        name, values, now, partial(handle, **options)
    )


@grouped(("a",), ("b",), wire="serial")
async def test_reply_that_cannot_be_noted_keeps_nobody_waiting(
    group: Group, ends: list[MemoryLine], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The exchange fails, all are stopped; a stop whose reply cannot be noted ends in time."""

    def fail(*_: object) -> None:
        raise ZeroDivisionError("planted")

    await group.apply({name: [layer(0, tone())] for name in "ab"})
    monkeypatch.setattr(group.amplifiers["b"].ledger, "resolve", fail)
    with pytest.raises(ZeroDivisionError):
        async with asyncio.timeout(1.0):
            await group.apply({name: [layer(0, tone(level=0.4))] for name in "ab"})
    assert not group.is_armed
    await asyncio.sleep(0.01)
    assert (ends[0].levels("a"), ends[1].levels("b")) == ([0.0, 0.0], [0.0, 0.0])
    monkeypatch.setattr(group.amplifiers["b"].ledger, "silenced", fail)
    async with asyncio.timeout(1.0):
        await group.stop()


@grouped(("a",), wire="serial")
async def test_request_to_a_busy_amplifier_goes_again_whenever_its_timer_comes(
    group: Group, ends: list[MemoryLine], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the clock of some systems a timer comes up to 16 ms early: here 4 ms."""
    (end,) = ends
    call_at, refusals = end.loop.call_at, [Refusal("busy", "BUSY")]

    def early(when: float, *args: Any, **more: Any) -> asyncio.TimerHandle:
        return call_at(when - 0.004 if when - end.loop.time() > 0.0045 else when, *args, **more)

    def busy(name: str, values: Values, now: float, handle: Callable[..., Values]) -> Values:
        if name == "Ping" and refusals:
            raise refusals.pop()
        return handle(name, values, now)

    monkeypatch.setattr(end.loop, "call_at", early)
    altered(end.far["a"], busy)
    await asyncio.wait_for(group.beat(), 0.1)
    assert not refusals


@pytest.mark.parametrize("what", ["cables", "replies"])
@grouped(("a",), ("b",))
async def test_lines_that_are_exchanged_while_armed_are_silenced(
    group: Group, ends: list[MemoryLine], what: str
) -> None:
    """Each amplifier refuses the other's session, and a line takes no reply to the other's request.

    Both are at address 1, alike and silent, so that no status contradicts what was sent.
    """
    first, second = ends
    if what == "cables":
        first._end, second._end = (
            one.kind.far_end({1: far}, one._send)
            for one, far in ((first, second.far["b"]), (second, first.far["a"]))
        )
    else:
        await second.hosts["b"].read_status()  # numbers of requests begin anywhere on each line
        first.line, second.line = second.line, first.line
    async with asyncio.timeout(2.0):
        while group.is_armed:
            with contextlib.suppress(DriverError):
                await group.beat()
            await asyncio.sleep(0.05)
    await asyncio.sleep(0.3)
    for end in ends:
        for far in end.far.values():
            far.tick(end.loop.time())
            assert far.state != "OPERATION_ENABLED"


def _layer(
    number: float, channel: float = 0, level: float = 0, frequency: float = 0
) -> AmplifierLayer:
    """A layer with a ramp of 1 ms and a tone, or none without a frequency."""
    tones = (AmplifierTone(int(channel), frequency, level),) if frequency else ()
    return AmplifierLayer(int(number), tones, 0.001)


@dataclass
class OnLines(Taken):
    """A group on lines, which takes steps; lines are given by number, amplifiers by name."""

    lines: Sequence[MemoryLine] = ()
    group: Group = field(init=False)
    stopped: dict[str, StopOutcome] = field(default_factory=dict)
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
    def unexpected(self) -> list[int]:
        """Frames on each line that belonged to nothing."""
        return [line.line.wire.counters.unexpected_frames for line in self.lines]

    @property
    def tokens(self) -> dict[str, Any]:
        """Tokens of layers, as the host has them."""
        return {name: each.ledger.playback.tokens for name, each in self.group.amplifiers.items()}

    @property
    def is_loud(self) -> bool:
        """Whether any amplifier plays."""
        return any(map(any, self.levels.values()))

    @property
    def shown(self) -> int:
        """The token of layer 0 that the last status of the first amplifier shows."""
        return int((self.hosts.a.status or {})["tokens"][0])

    @property
    def contradictions(self) -> int:
        """How many statuses of the first amplifier have contradicted its requests, in a row."""
        return int(self.hosts.a._contradictions)

    @property
    def retries(self) -> int:
        """Requests that were repeated."""
        return sum(line.retries for line in self.lines)

    @property
    def degraded(self) -> list[str]:
        """Amplifiers that do not reply but may play."""
        return [*self.group.members.degraded]

    @property
    def plays_for(self) -> float:
        """How long after `forget` the first amplifier may play [s]."""
        return float(self.hosts.a.feeding.may_play_until) - self.since

    @property
    def may_play(self) -> list[str]:
        """What the last stop said may play on, with a time and a cause."""
        left = {name: each for name, each in self.stopped.items() if not each.is_confirmed}
        return [name for name, each in left.items() if each.may_play_until > self.since]

    @property
    def causes(self) -> list[str]:
        """Why each is not confirmed."""
        return [each.cause for each in self.stopped.values()]

    def forget(self) -> None:
        """Forget what was sent so far."""
        self.since = self.lines[0].loop.time()
        for line in self.lines:
            line.sent.clear()

    def never_sent(self, line: int, *requests: str) -> None:
        """Require that none of these was sent on a line."""
        assert not {*requests} & {*self.sent[line]}

    def sent_within(self, request: str, seconds: float) -> None:
        """Require that a request was sent on the first line so soon after `forget`."""
        assert (
            next(at for at, each in self.lines[0].sent if each == request) <= self.since + seconds
        )

    def was_sent(self, *requests: str) -> None:
        """Require that a line was sent these first since `forget`."""
        assert self.sent[0][: len(requests)] == [*requests]

    def sends(self, **bounds: Sequence[int]) -> None:
        """Require numbers of requests on the first line since `forget`: at least, at most."""
        found = {request: self.sent[0].count(request) for request in bounds}
        assert all(low <= found[each] <= high for each, (low, high) in bounds.items()), found

    def is_between(self, **bounds: Sequence[float]) -> None:
        """Require values of properties: more than the one, less than the other."""
        found = {what: getattr(self, what) for what in bounds}
        assert all(low < found[each] < high for each, (low, high) in bounds.items()), found

    async def waits_until_sent(self, request: str) -> None:
        """Wait until a request is the last that was sent on the first line."""
        while self.sent[0][-1] != request:  # noqa: ASYNC110
            await asyncio.sleep(0.0001)

    async def applies_parts(self, count: int) -> None:
        """Apply a set of about so many parts to the first amplifier."""
        await self.group.apply({"a": of_parts(count)})

    async def measures(self, name: str) -> None:
        """Read the voltages of one."""
        await read_measured(self.group.amplifiers[name])

    def plans_nothing(self, text: str) -> None:
        """Require that what is planned is refused, with this text."""
        assert text in str(self.group.sets.refusal_of({"a": [_layer(0, 0, 0.5, 100.0)]}))

    async def applies(self, **rows: Sequence[Sequence[float]]) -> None:
        """Apply rows of layer, channel, level, frequency [Hz], by amplifier; a layer alone ends."""
        layers = {name: [_layer(*row) for row in each] for name, each in rows.items()}
        await self.group.apply(layers)

    async def plays(self, level: float) -> None:
        """Play 100 Hz at a level on the first channel of all amplifiers, in layer 0."""
        await self.applies(**{name: [(0, 0, level, 100.0)] for name in self.group.amplifiers})

    async def reads(self, name: str, times: int = 1) -> None:
        """Read the status of one, so often at once."""
        await asyncio.gather(*(self.group.amplifiers[name].read_status() for _ in range(times)))

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
        self.far.a._take = lambda part, now: {**said, "token": part["token"]}

    def loses_replies(self, name: str, count: int) -> None:
        """Lose so many replies to requests of a name on each line."""
        for line in self.lines:
            line.outward = losing(name, count=count)

    def is_late(self, **delays: float) -> None:
        """Let replies to requests of these names come after these times, on the first line."""
        self.lines[0].outward = lambda name, data: [(delays.get(name, 0.0002), data)]

    def arrives_after(self, seconds: float) -> None:
        """Let requests on the first line arrive so much later."""
        self.lines[0].inward = lambda _, data: [(seconds, data)]

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
        (line, *_) = self.lines
        submit = line.line.submit

        def fail(member: object, *values: Any, **other: Any) -> Any:
            if member is None:
                raise ZeroDivisionError("planted")
            return submit(member, *values, **other)  # type: ignore[arg-type]

        line.line.submit = fail  # type: ignore[method-assign]

    def cuts(self, line: int) -> None:
        """Cut a line."""
        self.lines[line].line.lose("cut")

    def lies(self, **said: Any) -> None:
        """Let the first amplifier say something else in each status."""
        far = self.far.a
        status = far.status
        said |= {"state": STATES[said["state"]]} if "state" in said else {}
        far.status = lambda now: {**status(now), **said}

    def obeys_instead(self, **instead: str) -> None:
        """Let the first amplifier take requests of some names for others."""
        far = self.far.a
        handle = far.handle

        def obey(name: str, values: Values, now: float, **options: bool) -> Any:
            given = {} if name in instead else values
            return handle(instead.get(name, name), given, now, **options)

        far.handle = obey

    def commits(self, name: str, count: int) -> None:
        """Let an amplifier play so many layers of each set, and say that it plays the set."""
        playback = getattr(self.far, name).playback
        commit = playback.commit
        playback.commit = lambda layers, *when: count and commit(layers[:count], *when)

    def is_busy_after(self, name: str, count: int) -> None:
        """Let the first amplifier refuse requests of a name once it has taken so many."""
        left = [count]

        def busy(asked: str, values: Values, now: float, handle: Callable[..., Values]) -> Values:
            left[0] -= asked == name
            if asked == name and left[0] < 0:
                raise Refusal("busy", "BUSY")
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

    def restarts(self, **capabilities: Any) -> None:
        """Switch the first amplifier off and on again, with other capabilities: CAN nodes boot."""
        (line, *_), far = self.lines, self.far.a
        far.capabilities = {**far.capabilities, **capabilities}
        far.restart(line.loop.time())
        far.latch = 0
        if line.kind is KINDS["can"]:
            line.boot(1)

    def falls_silent(self) -> None:
        """Let the first amplifier end all that it plays, by itself."""
        self.far.a.playback.silence(self.lines[0].loop.time(), 0.0)

    def draws(self, session: int) -> None:
        """Let the session that is armed next have a number."""
        self.group._draw = lambda low, high: session

    def trips(self, name: str, fault: str) -> None:
        """Let an amplifier trip."""
        getattr(self.far, name).trip(fault, self.lines[0].loop.time())

    def heats(self, celsius: float) -> None:
        """Let the first amplifier be so warm."""
        self.far.a.set_temperature(celsius, self.lines[0].loop.time())

    def had_another_session(self) -> None:
        """Let the first have been armed by another: that of these tests is not taken twice."""
        self.far.a.session = 1

    def asks(self, name: str, request: str, **values: int) -> None:
        """Let another host ask something of an amplifier."""
        getattr(self.far, name).handle(request, values, self.lines[0].loop.time())

    def becomes(self, name: str, serial_number: str) -> None:
        """Have another amplifier in its place."""
        getattr(self.far, name).identity["serial_number"] = serial_number

    def sleeps(self, seconds: float) -> None:
        """Let this machine sleep."""
        self.lines[0].loop.now += seconds  # type: ignore[attr-defined]

    async def waits_for_the_loss(self) -> None:
        """Wait until an amplifier is lost, for the host."""
        await asyncio.sleep(self.group.members.lost_from - self.lines[0].loop.time())


@asynccontextmanager
async def on_lines(*names: str, **options: Any) -> AsyncIterator[OnLines]:
    """An armed group; names: of the amplifiers on each line, a letter each; wire, is_armed."""
    wire = options.pop("wire")
    made = OnLines(lines=[MemoryLine(wire, *each) for each in names])
    made.group = await group_of(*made.lines, **options)
    yield made


COURSES = courses(Path(__file__).with_name("courses.yaml"))


@pytest.mark.parametrize(
    ("name", "kind"),
    [(name, kind) for name, each in COURSES.items() for kind in each.get("wires", KINDS)],
)
def test_group_keeps_to_its_course(name: str, kind: str) -> None:
    """Every step is as it is in the file, on every kind of wire that it names, or on all."""
    course = {key: value for key, value in COURSES[name].items() if key != "wires"}
    follow({**course, "wire": kind}, on_lines)
