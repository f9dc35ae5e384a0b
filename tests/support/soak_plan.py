"""What happens in one soak run, all of it decided before it begins, by one number.

A plan is scenes one after the other: calm ones, in which everything must work, and rough ones, in
which wires and amplifiers fail and the operator does anything; between some of them the plate is
disarmed and alone for up to an hour.
"""

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

from sim.faults.fault_window import FaultKind, FaultWindow

KINDS: Mapping[str, Sequence[int | None]] = {
    "serial": (115_200, 921_600),
    "modbus-rtu": (115_200, 57_600),
    "modbus-tcp": (None,),
    "socketcand": (500_000, 1_000_000),
    "slcan": (500_000,),
}
"""The wires, and the speeds [bit/s] at which they run."""

SOURCES = ("panel", "table", "page")
BEGIN = 0.5  # s; by then everything is open
SETTLED = 3.0  # s; how long after a trouble everything must work again

FRAME_FAULTS: Sequence[FaultKind] = (
    "drop",
    "delay",
    "duplicate",
    "corrupt",
    "truncate",
    "incomplete_set",
)
AMPLIFIER_FAULTS: Sequence[FaultKind] = (
    "unplug",
    "hang",
    "reboot",
    "nak_storm",
    "over_temperature",
    "over_voltage",
    "arc",
    "channel",
)
GESTURES = ("tap", "hold", "drag", "chord", "vanish", "flood", "wrong")


@dataclass(frozen=True)
class Line:
    """A wire: kind as `sim.far_ends.wires` has it, and speed [bit/s]."""

    kind: str
    speed: int | None


@dataclass(frozen=True)
class TouchSequence:
    """Touches of one source: frames at times [s] after `at`, each (time, stamp, touches).

    stamp [s]: how much later than it arrives a frame says that it was made; may be NaN.
    """

    at: float
    gesture: str
    source: str
    frames: tuple[tuple[float, float, tuple[tuple[int, float, float], ...]], ...]


@dataclass(frozen=True)
class OperatorAction:
    """Something that the operator does, or that happens to the host.

    ready: clears and arms; kill: the process dies and another is started; stall: the control loop
    stands still for `lasts` [s].
    """

    at: float
    what: str
    lasts: float = 0.0


@dataclass(frozen=True)
class FaultInjection:
    """A fault of the amplifier `number`, or of its wire."""

    at: float
    number: int
    window: FaultWindow


Action: TypeAlias = TouchSequence | OperatorAction | FaultInjection


@dataclass(frozen=True)
class Plan:
    """All that happens: lines, one for each amplifier or one for all, and actions by their time."""

    seed: int
    lines: tuple[Line, ...]
    amplifiers: int
    actions: tuple[Action, ...]
    lasts: float
    busy: float  # s; without the minutes in which the plate is alone

    @property
    def wire(self) -> str:
        """The kinds of its lines."""
        return "+".join(line.kind for line in self.lines)

    def is_calm(self, since: float, until: float) -> bool:
        """Whether nothing but touches happens in a window [s], nor shortly before it."""
        return not any(begin < until and since < end for begin, end in self._troubled)

    @cached_property
    def _troubled(self) -> list[tuple[float, float]]:
        spans = []
        for action in self.actions:
            if isinstance(action, FaultInjection):
                spans.append((action.at, action.at + action.window.lasts + SETTLED))
            elif isinstance(action, OperatorAction) and action.what != "ready":
                spans.append((action.at, action.at + action.lasts + SETTLED))
        return spans


def make_plan(seed: int, wire: str | None = None, *, short: bool = False) -> Plan:
    """The plan of a seed; on one kind of wire where one is named; short: one scene of seconds."""
    dice = random.Random(seed)
    amplifiers = dice.choice((1, 1, 1, 2))
    count = 1 if amplifiers == 1 else dice.choice((1, 2))
    lines = []
    for _ in range(count):
        kind = wire or dice.choice(tuple(KINDS))
        lines.append(Line(kind, dice.choice(KINDS[kind])))
    actions: list[Action] = []
    time, busy = BEGIN, BEGIN
    for _ in range(1 if short else dice.randint(2, 5)):
        scene = dice.choice((_calm, _calm, _rough, _rough, _operated))
        length = dice.uniform(2.0, 4.0) if short else dice.uniform(4.0, 15.0)
        actions.append(OperatorAction(time, "ready"))
        actions += scene(dice, time + 1.0, length, amplifiers)
        time += 1.0 + length + SETTLED
        busy += 1.0 + length + SETTLED
        if not short and dice.random() < 0.3:
            actions.append(OperatorAction(time, "disarm"))
            time += 60 * dice.uniform(2, 60)
    ordered = tuple(sorted(actions, key=lambda action: action.at))
    return Plan(seed, tuple(lines), amplifiers, ordered, time, busy)


def _calm(dice: random.Random, begin: float, length: float, amplifiers: int) -> list[Action]:
    """Touches only."""
    return [*_touch_sequences(dice, begin, length)]


def _rough(dice: random.Random, begin: float, length: float, amplifiers: int) -> list[Action]:
    """Touches, faults, and an operator who rearms."""
    actions: list[Action] = [*_touch_sequences(dice, begin, length)]
    for _ in range(dice.randint(1, 6)):
        at = begin + dice.uniform(0, length)
        actions.append(FaultInjection(at, dice.randrange(amplifiers), _fault_window(dice)))
    if dice.random() < 0.3:
        what, lasts = dice.choice((("kill", 0.0), ("stall", dice.uniform(0.05, 1.0))))
        actions.append(OperatorAction(begin + dice.uniform(0, length), what, lasts))
    return actions + _rearming(dice, begin, length)


def _operated(dice: random.Random, begin: float, length: float, amplifiers: int) -> list[Action]:
    """Touches, and an operator who does anything at any time."""
    actions: list[Action] = [*_touch_sequences(dice, begin, length)]
    for _ in range(dice.randint(2, 15)):
        what = dice.choice(("arm", "arm", "disarm", "stop", "clear", "clear"))
        actions.append(OperatorAction(begin + dice.uniform(0, length), what))
        if dice.random() < 0.3:  # at the same moment, or nearly
            at = actions[-1].at + dice.choice((0.0, 0.0005, 0.003, 0.02))
            actions.append(OperatorAction(at, dice.choice(("arm", "disarm", "stop", "clear"))))
    return actions + _rearming(dice, begin, length)


def _rearming(dice: random.Random, begin: float, length: float) -> list[Action]:
    moments, at = [], begin
    while (at := at + dice.uniform(0.5, 3.0)) < begin + length:
        moments.append(OperatorAction(at, "ready"))
    return [*moments]


def _fault_window(dice: random.Random) -> FaultWindow:
    if dice.random() < 0.6:
        return FaultWindow(
            dice.choice(FRAME_FAULTS),
            lasts=dice.choice((0.02, 0.1, 0.5, 2.0)) * dice.uniform(0.5, 1.5),
            share=dice.choice((0.05, 0.2, 0.5, 1.0)),
            toward=dice.choice((None, "host", "amplifier")),
            delay=dice.choice((0.005, 0.04, 0.1, 0.4)),
        )
    fault = dice.choice(AMPLIFIER_FAULTS)
    scale = {"over_temperature": 2.0, "unplug": 0.6}.get(fault, 0.3)
    return FaultWindow(fault, lasts=scale * dice.uniform(0.05, 1.5))


def _touch_sequences(dice: random.Random, begin: float, length: float) -> list[TouchSequence]:
    """Gestures of up to three sources, those of one source one after the other."""
    sequences = []
    for source in SOURCES[: dice.choice((1, 1, 2, 3))]:
        at = begin + dice.uniform(0, 0.5)
        while at < begin + length:
            sequence = _touch_sequence(dice, at, source)
            sequences.append(sequence)
            at += sequence.frames[-1][0] + dice.choice((0.0, 0.02, 0.2, 1.0)) * dice.uniform(0.2, 2)
    return sequences


def _touch_sequence(dice: random.Random, at: float, source: str) -> TouchSequence:
    gesture = dice.choice(GESTURES)
    lasts = dice.uniform(0.03, 0.3) if gesture == "tap" else dice.uniform(0.2, 1.5)
    every = 0.002 if gesture == "flood" else dice.choice((0.01, 0.033, 0.08))
    lasts = min(lasts, 0.1) if gesture == "flood" else lasts
    fingers = dice.randint(2, 4) if gesture in ("chord", "flood") else 1
    places = [[dice.random(), dice.random()] for _ in range(fingers)]
    comes = [0.0, *(dice.uniform(0, lasts) for _ in range(fingers - 1))]
    goes = [dice.uniform(come, lasts) if n else lasts for n, come in enumerate(comes)]
    step = dice.uniform(0, 0.05) if gesture in ("drag", "flood") else 0.0
    first = dice.randrange(1000)
    frames = []
    time = 0.0
    while time < lasts:
        touches = tuple(
            (first + n, x, y)
            for n, (x, y) in enumerate(places)
            if comes[n] <= time and (n == 0 or time < goes[n])
        )
        frames.append((time, 0.0, touches))
        for place in places:
            for axis in (0, 1):
                place[axis] = min(max(place[axis] + dice.uniform(-step, step), 0.0), 1.0)
        time += every
    if gesture == "wrong":
        frames = [_malformed(dice, frame) if dice.random() < 0.5 else frame for frame in frames]
    if gesture != "vanish":
        frames.append((lasts, 0.0, ()))
    return TouchSequence(at, gesture, source, tuple(frames))


def _malformed(
    dice: random.Random, frame: tuple[float, float, tuple[tuple[int, float, float], ...]]
) -> tuple[float, float, tuple[tuple[int, float, float], ...]]:
    """A frame as no source should send it."""
    time, stamp, touches = frame
    number = touches[0][0] if touches else 1
    match dice.randrange(6):
        case 0:
            touches = ((number, math.nan, 0.5),)
        case 1:
            touches = ((number, dice.choice((-0.1, 1.01, math.inf)), 0.5),)
        case 2:
            touches = (*touches, *touches)
        case 3:
            touches = tuple((n, dice.random(), dice.random()) for n in range(15))
        case 4:
            stamp = dice.choice((math.nan, 5.0, -5.0))
        case _:
            touches = (*touches, (-1, 0.1, 0.1))
    return time, stamp, touches
