"""Groups on lines in virtual time: courses, of the sentence that they prove.

What a person would feel is read from the simulated amplifiers themselves.
"""

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from courses import Taken, courses, follow
from drivers.host.dialogue import Stopped
from drivers.host.group import Group
from drivers.playing import Layer, Tone
from drivers.protocol.definition import STATES
from drivers.protocol.records import Values
from virtual_lines import KINDS, MemoryLine, group_of, losing


def _layer(number: float, channel: float = 0, level: float = 0, frequency: float = 0) -> Layer:
    """A layer with a ramp of 1 ms and a tone, or none without a frequency."""
    tones = (Tone(int(channel), frequency, level),) if frequency else ()
    return Layer(int(number), tones, 0.001)


@dataclass
class OnLines(Taken):
    """A group on lines, which takes steps; lines are given by number, amplifiers by name."""

    lines: Sequence[MemoryLine] = ()
    group: Group = field(init=False)
    stopped: dict[str, Stopped] = field(default_factory=dict)
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

    def loses_reply(self, name: str) -> None:
        """Lose a reply to a request of a name on the first line."""
        self.lines[0].outward = losing(name)

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
