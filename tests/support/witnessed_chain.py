"""The chain with a table of two patterns, played scenarios: touches and operator commands.

What each touch must give is known by hand.
"""

import asyncio
import math
import random
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from operator import methodcaller
from typing import Any

import hand_written as hand
from chain import Chain
from controller.sources.touch import Touch, TouchFrame
from drivers.host.amplifier import Amplifier
from era_haptics.lab.witness.capture import Violation
from model.vibration import Excitation, Tone
from plate_witness import OperatorCommand
from registry import threads
from registry.limits import GuardLimits
from set_table import STROKE, SetTable, make_rig
from sim.far_ends.wire_assignment import Wire
from virtual_loop import run_virtual

SENSED_EVERY = 0.001  # s
_LONGEST = 5.0  # s; a planted bug may cause a deadlock
ALONE: Excitation = {"SW": Tone(110.0, 20e-6, math.pi / 2), "NE": Tone(150.0, 40e-6, -math.pi)}
SHARED: Excitation = {"SW": Tone(90.0, 30e-6, 0.0)}
WITNESSED = ("serial", "modbus-tcp", "modbus-rtu", "socketcand", "slcan")
"""Every kind of wire."""


@dataclass
class Scene(Chain):
    """A chain whose source repeats its touches; errors: what its callers were told."""

    errors: list[BaseException] = field(default_factory=list)
    _holding: "asyncio.Task[None] | None" = None

    def __post_init__(self) -> None:
        """Have a source whose fingers do not load the plate."""
        super().__post_init__()
        self.is_felt = False

    @property
    def amplifier(self) -> Amplifier:
        """The first amplifier."""
        return next(iter(self.controller.amplifiers.values()))

    async def rest(self, seconds: float) -> None:
        """Sleep for a time [s]."""
        if seconds:
            await asyncio.sleep(seconds)

    async def operate(self, command: OperatorCommand, *, rest: float = 0.0) -> None:
        """Carry out an operator's command, then sleep for `rest` [s]."""
        await self.tried(super().operate(command))
        await self.rest(rest)

    def run(self) -> None:
        """Start the control loop, or let it go on."""
        self.turning.set()
        if self.running is None:
            self.running = asyncio.create_task(self.tried(self.controller.cycle.run()))

    def hang(self) -> None:
        """Stall the control loop."""
        self.turning.clear()

    def touch_beside(self) -> None:
        """Deliver a touch beside the plate."""
        self.deliver(TouchFrame("panel", threads.now(), (Touch(9, 1.3, 0.5),)))

    async def touch(self, *fingers: int, answerable: bool = True, rest: float = 0.0) -> None:
        """Replace the fingers on the plate, which the source repeats, then sleep for `rest` [s]."""
        self.must_be_felt = answerable
        self.at = {number: (0.03 + 0.06 * number, 0.1) for number in fingers}
        self.witness.expect(self.expected())
        self.report()
        if self._holding is None:
            self._holding = asyncio.create_task(self.hold(math.inf))
        await self.rest(rest)

    def expected(self) -> dict[str, dict[int, list[tuple[float, float, float]]]]:
        """Expected patterns on the wire, by hand: metres over 100 um, radians in degrees."""
        alone = {0: [(110.0, 0.2, 90.0)]}, {1: [(150.0, 0.4, 180.0)]}
        parts = alone if len(self.at) < 2 else ({0: [(90.0, 0.3, 0.0)]}, {})
        names = tuple(self.far.devices)
        if len(names) == 1:
            return {names[0]: {**parts[0], **parts[1]}}
        return {names[0]: parts[0], names[1]: parts[1]}

    async def reopen(self) -> None:
        """Close and reopen all, including the control loop."""
        await super().close()
        self.running = None
        await self.rest(0.01)
        await self.open()

    def trip(self) -> None:
        """Trip the first amplifier by an arc."""
        self.far.bench.advance(threads.now())
        self.far.amplifier.trip("ARC", threads.now())

    async def fall_silent(self) -> None:
        """Stop the source with fingers down: after its lease of 150 ms they count as lifted."""
        self.report()
        if self._holding is not None:
            self._holding.cancel()
        await self.rest(0.150)

    def inject(self, kind: int, words: Sequence[int]) -> None:
        """Inject a request of another program toward the amplifier on the first wire."""
        link, data = self.witness.wires[0], hand.frame(kind, words, sequence=999)
        self.operation.deliver(link, "amplifier", data, self.operation._terminals[link].inward)

    async def poll(self, times: int) -> None:
        """Read the status of the amplifier every 20 ms."""
        for _ in range(times):
            await self.rest(0.02)
            await self.amplifier.read_status()

    async def ask(self, name: str) -> None:
        """Ask the amplifier something."""
        await self.amplifier.request(name, {})

    async def identify(self) -> None:
        """Identify the amplifier again."""
        await self.amplifier.identify()

    def delayed(self, seconds: float) -> None:
        """Delay what goes to the host from now on."""
        for end in self.far_ends:
            end.delay(seconds)

    async def touch_for(self, frequency: float, level: float, phase: float = 0.0) -> None:
        """Touch where the table has this tone for one ERA, which may not be played."""
        self.table.excitation = {**ALONE, "NE": Tone(frequency, level * STROKE, phase)}
        await self.touch(1, answerable=False)
        self.witness.expect(None)

    async def close(self) -> None:
        """Lift what is down, disarm and close all."""
        if self._holding is not None:
            self._holding.cancel()
        self.witness.contacts(threads.now(), ())
        await self.tried(super().close())

    async def tried(self, work: Awaitable[Any]) -> None:
        """Do something, and note its error."""
        try:
            await work
        except Exception as error:
            self.errors.append(error)


def play(
    wire: str, scenario: Sequence[Callable[[Scene], Any]], *, amplifiers: Sequence[str] = ("main",)
) -> tuple[Scene, list[Violation]]:
    """Play the steps of a scenario on a wire of this kind; returns what the witness found."""

    async def steps(scene: Scene) -> None:
        for step in scenario:
            done = step(scene)
            if done is not None:
                await done

    async def run() -> tuple[Scene, list[Violation]]:
        rig = make_rig(amplifiers, GuardLimits(40.0, 500.0, 0.5))
        table = SetTable(ALONE, rig.plate, SHARED)
        judged = {"channels": 3, "level": 0.5, "slew": 100}
        options: dict[str, Any] = {"judged": judged, "sensed_every": SENSED_EVERY}
        async with Scene.on(Wire(wire), rig, table, **options) as scene:
            scene.witness.contacts(threads.now(), ())
            await scene.tried(scene.open())
            if not scene.errors:
                with suppress(TimeoutError):
                    async with asyncio.timeout(_LONGEST):
                        await scene.tried(steps(scene))
            await scene.close()
            return scene, scene.witness.finish(threads.now())

    return run_virtual(run(), rng=random.Random(1))


Step = Callable[[Scene], Any]
operate, touch, rest = (partial(methodcaller, name) for name in ("operate", "touch", "rest"))
"""Each makes a step: a method of the scene with its arguments."""

SCENARIOS: Mapping[str, Sequence[Step]] = {
    # An amplifier trips amid a touch, is asked for its faults, cleared and identified again.
    "arc": [
        *(operate("arm"), touch(1, rest=0.06), methodcaller("trip"), methodcaller("poll", 5)),
        *(methodcaller("ask", "GetFaults"), touch(rest=0.1), operate("clear", rest=0.05)),
        *(methodcaller("identify"), methodcaller("trip"), methodcaller("ask", "GetFaults")),
    ],
    # Touches, a neighbour, a lift, a stop amid a touch, clearing, arming, disarming.
    "day": [
        *(operate("arm", rest=0.12), touch(1, rest=0.12), touch(1, 2, rest=0.12)),
        *(touch(1, rest=0.05), touch(rest=0.1), touch(1, rest=0.1), touch(rest=0.1)),
        *(touch(3, rest=0.1), operate("stop", rest=0.1), touch(), operate("clear")),
        *(operate("arm"), touch(4, rest=0.06), operate("disarm", rest=0.1), touch()),
    ],
    # Other fingers touch every 4 ms, within the ramp of a pattern; then all is opened again.
    "hasty": [
        operate("arm", rest=0.12),
        *(touch(1, rest=0.004), touch(1, 2, rest=0.004)) * 5,
        *(rest(0.1), touch(rest=0.06), methodcaller("reopen")),
        *(operate("arm"), touch(1, rest=0.06), touch(rest=0.05)),
    ],
    # The control loop stalls during a touch; a client polls the status, clears and rearms.
    "hung": [
        *(operate("arm"), touch(1, rest=0.1), methodcaller("hang"), methodcaller("poll", 20)),
        *(touch(), operate("clear", rest=0.05), methodcaller("run"), operate("arm")),
        *(touch(2, rest=0.06), touch(rest=0.06)),
    ],
    # The last finger is lifted, then an amplifier is stopped, each before a late reply.
    "slow": [
        *(operate("arm", rest=0.02), methodcaller("delayed", 0.025), touch(1, rest=0.001)),
        *(touch(rest=0.05), touch(1, rest=0.001), operate("stop"), touch(rest=0.05)),
        *(methodcaller("delayed", 0.0), rest(0.05)),
    ],
    # A finger beside the plate is none; the source of touches dies with a finger down.
    "source_dies": [
        *(operate("arm", rest=0.05), methodcaller("touch_beside"), rest(0.1)),
        *(touch(1, rest=0.1), methodcaller("fall_silent"), rest(0.1)),
    ],
    # Another program sends a silent set while disarmed, later a heartbeat of its own session.
    "stranger": [
        rest(0.1),
        methodcaller("inject", hand.SET, hand.part(7, hand.layer(0), now=True)),
        *(rest(0.01), operate("arm", rest=0.05), touch(1, rest=0.06)),
        lambda scene: scene.inject(hand.PING, (scene.amplifier.session % 65535 + 1, 0)),
        *(rest(0.01), touch(rest=0.05)),
    ],
    # The table asks for more than full level on one ERA, 620 Hz, or is damaged: NaN.
    "too_much": [
        operate("arm"),
        *(
            step
            for tone in ((150.0, 0.7), (620.0, 0.4), (150.0, 0.4, float("nan")))
            for step in (methodcaller("touch_for", *tone), rest(0.1), touch(rest=0.05))
        ),
    ],
}
"""By name, in the order of the names."""
