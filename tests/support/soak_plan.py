"""Actions of one soak run, generated from a seed.

A plan is scenes one after the other: calm ones, without faults, and rough ones, with
faults of wires and amplifiers and random operator commands; between some of them the plate is
disarmed and untouched for up to an hour.
"""

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

from sim.faults import FaultKind, FaultWindow
from sim.transport.simulated_line import PROMPT

KINDS: Mapping[str, Sequence[int | None]] = {
    "serial": (115_200, 921_600),
    "modbus-rtu": (115_200, 57_600),
    "modbus-tcp": (None,),
    "socketcand": (500_000, 1_000_000),
    "slcan": (500_000,),
}
"""The wires, and the speeds [bit/s] at which they run."""
_SERIAL_LINES = ("native", "usb-high-speed", "usb-full-speed", "ftdi-low-latency", "ftdi")
LINES: Mapping[str, Sequence[str]] = {
    "serial": _SERIAL_LINES,
    "modbus-rtu": _SERIAL_LINES[:-1],  # in responses later than that a witness reads nothing
    "modbus-tcp": ("ethernet",),
    "socketcand": ("can",),
    "slcan": ("can-usb",),
}
"""The kinds of line behind them, where there are several amplifiers."""

PLATES = ("eras", "exciters")
"""The plates: that of the founding paper, and a board on exciters with a layout."""

SOURCES = ("panel", "table", "page")
BEGIN = 0.5  # s; all wires are open by then
SETTLED = 7.0  # s; maximum recovery time after a fault: a pause before a reopening, of 5 s at most
ENDED = 3.0  # s; after the only scene of a short plan, which nothing follows but the end
PAUSES = (60.0, 3600.0)  # s; shortest and longest between scenes, short ones more often

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
    """A wire: kind and kind of line as `sim.far_ends.wire_assignment` has them, and speed [bit/s]."""

    kind: str
    speed: int | None
    line_kind: str = PROMPT


@dataclass(frozen=True)
class TouchSequence:
    """Touches of one source: frames at times [s] after `at`, each (time, stamp, touches).

    stamp [s]: offset of its time stamp from its arrival; may be NaN.
    """

    at: float
    gesture: str
    source: str
    frames: tuple[tuple[float, float, tuple[tuple[int, float, float], ...]], ...]


@dataclass(frozen=True)
class OperatorAction:
    """An operator command or a failure of the host.

    ready: clears and arms; kill: the process is killed and restarted; stall: the control loop
    stalls for `lasts` [s].
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
    """Lines, one for each amplifier or one for all, actions in order of time; plate: by name."""

    seed: int
    lines: tuple[Line, ...]
    amplifiers: int
    actions: tuple[Action, ...]
    lasts: float
    busy: float  # s; without the time in which the plate is untouched
    plate: str = PLATES[0]

    @property
    def wire(self) -> str:
        """The kinds of its lines."""
        return "+".join(line.kind for line in self.lines)

    def is_calm(self, since: float, until: float) -> bool:
        """Whether a window [s] and the time shortly before it have touches only."""
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


def make_plan(
    seed: int, wire: str | None = None, plate: str | None = None, *, short: bool = False
) -> Plan:
    """The plan of a seed; wire, plate: its kind, None for any; short: one scene of seconds."""
    rng = random.Random(seed)
    amplifiers = rng.choice((1, 1, 2, 3))
    lines = []
    for _ in range(rng.choice((1, amplifiers))):
        kind = wire or rng.choice(tuple(KINDS))
        line_kind = PROMPT if amplifiers == 1 else rng.choice(LINES[kind])
        lines.append(Line(kind, rng.choice(KINDS[kind]), line_kind))
    actions: list[Action] = []
    time, busy = BEGIN, BEGIN
    for _ in range(1 if short else rng.randint(2, 5)):
        scene = rng.choice((_calm, _calm, _rough, _rough, _operated))
        length = rng.uniform(2.0, 4.0) if short else rng.uniform(4.0, 15.0)
        actions.append(OperatorAction(time, "ready"))
        actions += scene(rng, time + 1.0, length, amplifiers)
        lasts = 1.0 + length + (ENDED if short else SETTLED)
        time += lasts
        busy += lasts
        if not short and rng.random() < 0.3:
            actions.append(OperatorAction(time, "disarm"))
            time += math.exp(rng.uniform(*map(math.log, PAUSES)))
    ordered = tuple(sorted(actions, key=lambda action: action.at))
    plate = plate or rng.choices(PLATES, (2, 1))[0]
    return Plan(seed, tuple(lines), amplifiers, ordered, time, busy, plate)


def _calm(rng: random.Random, begin: float, length: float, amplifiers: int) -> list[Action]:
    """Touches only."""
    return [*_touch_sequences(rng, begin, length)]


def _rough(rng: random.Random, begin: float, length: float, amplifiers: int) -> list[Action]:
    """Touches, faults, and repeated arming."""
    actions: list[Action] = [*_touch_sequences(rng, begin, length)]
    for _ in range(rng.randint(1, 6)):
        at = begin + rng.uniform(0, length)
        actions.append(FaultInjection(at, rng.randrange(amplifiers), _fault_window(rng)))
    if rng.random() < 0.3:
        what, lasts = rng.choice((("kill", 0.0), ("stall", rng.uniform(0.05, 1.0))))
        actions.append(OperatorAction(begin + rng.uniform(0, length), what, lasts))
    return actions + _rearming(rng, begin, length)


def _operated(rng: random.Random, begin: float, length: float, amplifiers: int) -> list[Action]:
    """Touches, and random operator commands."""
    actions: list[Action] = [*_touch_sequences(rng, begin, length)]
    for _ in range(rng.randint(2, 15)):
        what = rng.choice(("arm", "arm", "disarm", "stop", "clear", "clear"))
        actions.append(OperatorAction(begin + rng.uniform(0, length), what))
        if rng.random() < 0.3:  # at the same moment, or nearly
            at = actions[-1].at + rng.choice((0.0, 0.0005, 0.003, 0.02))
            actions.append(OperatorAction(at, rng.choice(("arm", "disarm", "stop", "clear"))))
    return actions + _rearming(rng, begin, length)


def _rearming(rng: random.Random, begin: float, length: float) -> list[Action]:
    moments, at = [], begin
    while (at := at + rng.uniform(0.5, 3.0)) < begin + length:
        moments.append(OperatorAction(at, "ready"))
    return [*moments]


def _fault_window(rng: random.Random) -> FaultWindow:
    if rng.random() < 0.6:
        return FaultWindow(
            fault=rng.choice(FRAME_FAULTS),
            lasts=rng.choice((0.02, 0.1, 0.5, 2.0)) * rng.uniform(0.5, 1.5),
            share=rng.choice((0.05, 0.2, 0.5, 1.0)),
            toward=rng.choice((None, "host", "amplifier")),
            delay=rng.choice((0.005, 0.04, 0.1, 0.4)),
        )
    fault = rng.choice(AMPLIFIER_FAULTS)
    scale = {"over_temperature": 2.0, "unplug": 0.6}.get(fault, 0.3)
    return FaultWindow(fault=fault, lasts=scale * rng.uniform(0.05, 1.5))


def _touch_sequences(rng: random.Random, begin: float, length: float) -> list[TouchSequence]:
    """Gestures of up to three sources, those of one source one after the other."""
    sequences = []
    for source in SOURCES[: rng.choice((1, 1, 2, 3))]:
        at = begin + rng.uniform(0, 0.5)
        while at < begin + length:
            sequence = _touch_sequence(rng, at, source)
            sequences.append(sequence)
            at += sequence.frames[-1][0] + rng.choice((0.0, 0.02, 0.2, 1.0)) * rng.uniform(0.2, 2)
    return sequences


def _touch_sequence(rng: random.Random, at: float, source: str) -> TouchSequence:
    gesture = rng.choice(GESTURES)
    lasts = rng.uniform(0.03, 0.3) if gesture == "tap" else rng.uniform(0.2, 1.5)
    every = 0.002 if gesture == "flood" else rng.choice((0.01, 0.033, 0.08))
    lasts = min(lasts, 0.1) if gesture == "flood" else lasts
    fingers = rng.randint(2, 4) if gesture in ("chord", "flood") else 1
    places = [[rng.random(), rng.random()] for _ in range(fingers)]
    comes = [0.0, *(rng.uniform(0, lasts) for _ in range(fingers - 1))]
    goes = [rng.uniform(come, lasts) if n else lasts for n, come in enumerate(comes)]
    step = rng.uniform(0, 0.05) if gesture in ("drag", "flood") else 0.0
    first = rng.randrange(1000)
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
                place[axis] = min(max(place[axis] + rng.uniform(-step, step), 0.0), 1.0)
        time += every
    if gesture == "wrong":
        frames = [_malformed(rng, frame) if rng.random() < 0.5 else frame for frame in frames]
    if gesture != "vanish":
        frames.append((lasts, 0.0, ()))
    return TouchSequence(at, gesture, source, tuple(frames))


def _malformed(
    rng: random.Random, frame: tuple[float, float, tuple[tuple[int, float, float], ...]]
) -> tuple[float, float, tuple[tuple[int, float, float], ...]]:
    """An invalid variant of a frame."""
    time, stamp, touches = frame
    number = touches[0][0] if touches else 1
    match rng.randrange(6):
        case 0:
            touches = ((number, math.nan, 0.5),)
        case 1:
            touches = ((number, rng.choice((-0.1, 1.1, math.inf)), 0.5),)
        case 2:
            touches = (*touches, *touches)
        case 3:
            drawn = [(n, rng.random(), rng.random()) for n in range(15)]
            touches = (*drawn, *((n, n / 25, 0.5) for n in range(15, 25)))
        case 4:
            stamp = rng.choice((math.nan, 5.0, -5.0))
        case _:
            touches = (*touches, (-1, 0.1, 0.1))
    return time, stamp, touches
