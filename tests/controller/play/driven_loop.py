"""A control loop that drives obedient amplifiers on lines in memory, with fingers of a test."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

from controller.effects.effect import Region
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from drivers.host.group_states import GroupState
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Command
from kit.chain import FINGER, OTHER, Chain, FarEnd, Sent
from model.config.shapes import Circle
from model.vibration import Tone
from registry import threads

MOVED_FINGER = (FINGER[0], 0.18, 0.1)
"""The finger of the chain at another position."""
FINGER_ELSEWHERE = (FINGER[0], *OTHER[1:])
"""The finger of the chain at the position of the other finger."""


class Planted(Exception):
    """A bug."""


def but_the_other() -> EffectPlayer:
    """Return a layout with a buzz everywhere except at the other finger."""
    region = Region("rest", Circle(*OTHER[1:], 0.02))
    return EffectPlayer(SurfaceLayout((region,)))


@dataclass
class DrivenLoop(Chain):
    """A chain, and the sets and silences of its first amplifier."""

    @property
    def state(self) -> GroupState:
        """The state of the group of amplifiers."""
        return self.controller.group.state

    @property
    def amplifier_states(self) -> list[str]:
        """The state of each amplifier."""
        return [far_end.state for far_end in self.far_ends]

    @property
    def is_loud(self) -> bool:
        """Whether any channel plays."""
        return any(max(levels) > 0 for levels in self.levels().values())

    @property
    def latencies(self) -> list[float | None]:
        """The latency of each report of active layers [s]."""
        return [report.latency for report in self.applied]

    @property
    def vibrations(self) -> list[Sent]:
        """The sets of the first amplifier that vibrate."""
        return [sent for sent in self.far_end.sent() if not sent.is_silent]

    @property
    def first_commands(self) -> list[Command]:
        """The command of the first channel in each of these sets."""
        return [vibration.layer.commands[0] for vibration in self.vibrations]

    @property
    def continued_phases(self) -> list[list[bool]]:
        """The channels of each of these sets that continue their phase."""
        return [
            [command.keep_phase for command in vibration.layer.commands]
            for vibration in self.vibrations
        ]

    @property
    def expiries(self) -> list[float]:
        """When each of these sets ends by itself [s]."""
        valid_for = QUANTITIES["valid_for"]
        return [
            vibration.time + valid_for.from_wire(vibration.layer.valid_for)
            for vibration in self.vibrations
        ]

    @property
    def pauses(self) -> list[float]:
        """Times between these sets [s]."""
        return [after.time - sooner.time for sooner, after in pairwise(self.vibrations)]

    @property
    def gaps(self) -> list[float]:
        """Times between the end of a set and the next set, where there is silence [s]."""
        successors = self.vibrations[1:]
        pairs = zip(self.expiries, successors, strict=False)
        return [vibration.time - end for end, vibration in pairs if vibration.time > end]

    def count(self, request: str, of: int = 0) -> int:
        """How often an amplifier got a request since requests were last forgotten."""
        return len(self.far_ends[of].requests(request))

    def forget_requests(self) -> None:
        """Forget all requests to amplifiers so far."""
        for far_end in self.far_ends:
            far_end.asked.clear()

    def delay_replies(self, seconds: float) -> None:
        """Let the replies of all amplifiers leave so much later [s]."""
        for far_end in self.far_ends:
            far_end.delay(seconds)

    def delay_replies_from(self, request: str, seconds: float) -> asyncio.Event:
        """Delay the reply to the next request of a name, and those after it; set when it comes."""
        requested = asyncio.Event()

        def delay(name: str, _: Values) -> None:
            if name == request and not requested.is_set():
                self.far_end.delay(seconds)
                requested.set()

        self.far_end.answer = delay
        return requested

    def answer_by(self, **tones: Tone) -> None:
        """Have the table answer by a tone for each of these ERAs."""
        self.table.excitation = tones

    async def tap(self) -> None:
        """Put the finger down for 10 ms, and wait for 10 ms."""
        await self.leave(0.01, FINGER)
        await self.leave(0.01)

    async def look(
        self, seconds: float, touch: Callable[[], None] = lambda: None
    ) -> list[tuple[float, float]]:
        """Return the level of the first channel at each millisecond [s]; touch every ten."""
        looks = []
        for number in range(round(1000 * seconds)):
            if number % 10 == 0:
                touch()
            looks.append((threads.now(), self.far_end.levels[0]))
            await asyncio.sleep(0.001)
        return looks


def refuse(far_end: FarEnd, request: str) -> None:
    """Let an amplifier refuse requests of a name."""

    def answer(name: str, _: Values) -> None:
        if name == request:
            raise Refusal("planned", "WRONG_STATE")

    far_end.lie(answer)
