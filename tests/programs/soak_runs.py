"""Soak runs: actions that are drawn from a seed, and the chain on which they are played.

A plan is scenes one after the other: calm ones, without faults, and rough ones, with faults of
wires and amplifiers and random operator commands; between some of them the plate is disarmed and
untouched for up to an hour. The chain has its supervisor, and the founding paper's plate or that of
a weekend on exciters, with a layout.
"""

import asyncio
import logging
import math
import random
from collections import Counter
from collections.abc import Coroutine, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from controller.api.jsonrpc import RpcError
from controller.content.pattern import Pattern, Transient
from controller.effects.effect import Region
from controller.effects.file_effect import File
from controller.effects.kinds import Buzz, Texture
from controller.effects.layout import SurfaceLayout, default_effects
from controller.effects.player import EffectPlayer
from controller.operation.operation_states import DaemonEvent, DaemonState, Trigger
from controller.operation.supervisor import Supervisor
from controller.play.intent import IntentSource
from controller.play.reports import PlayReport
from controller.sources.touch import Touch, TouchFrame
from drivers.errors import DriverError
from kit.chain import Chain
from kit.clock import VirtualLoop, run_virtual
from kit.host_rules import HostTimes
from kit.plates import make_paper_rig, small_table
from kit.wires import after_each, on_amplifiers
from model.answer.answer_report import Timing
from model.config.shapes import Rectangle
from model.finger import STRONG_DB_SL, Grid
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.table.table import LocalizationTable
from model.table.table_file import TableProblem, solve_table
from registry.virtual_time import START, Stuck
from sim.far_ends.wire_assignment import SimulatedWire
from sim.faults import FaultKind, FaultWindow
from sim.plant.imperfections import Imperfections, draw_imperfections
from sim.transport.simulated_line import LINE_KINDS, PROMPT

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
    "modbus-rtu": _SERIAL_LINES[:-1],  # a response that is later ends the exchange
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
    lines: tuple[SimulatedWire, ...]
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
        lines.append(SimulatedWire(kind, rng.choice(KINDS[kind]), line_kind=line_kind))
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


_WEEKEND = Path(__file__).parents[2] / "examples/weekend/rig.yaml"
_FREQUENCIES = np.array([110.0, 170.0, 250.0])
_COURSE = Pattern(
    0.8,
    ((0.0, 0.3), (0.4, 1.0), (0.8, 0.2)),
    ((0.0, 0.2), (0.8, 0.8)),
    (Transient(0.1, 1.0, 0.5),),
)
_EFFECTS: Mapping[str, tuple[str | None, str | None]] = {
    "course": ("course", None),
    "clicks": ("click", "texture"),
    "taps": ("success", None),
    "short": ("short", "click"),
}
"""What is felt on a press and on a move in a quarter of the plate each; a buzz on its rims."""


def soak_table(plate: str) -> LocalizationTable:
    """The table of a plate by name."""
    return small_table() if plate == "eras" else _board_table()


@cache
def soak_timing(plate: str) -> Timing:
    """Its timing."""
    return Timing(soak_table(plate))


@cache
def soak_rig(plate: str, amplifiers: tuple[str, ...]) -> Rig:
    """Its rig, on amplifiers of these names in turn, or on its own one."""
    rig = make_paper_rig(12, 9) if plate == "eras" else load_rig(_WEEKEND)
    return on_amplifiers(rig, amplifiers) if amplifiers else rig


def soak_source(plate: str) -> IntentSource:
    """What its fingers shall feel, as a new process begins it."""
    return EffectPlayer(SurfaceLayout() if plate == "eras" else _layout())


@cache
def _board_table() -> LocalizationTable:
    problem = TableProblem(load_rig(_WEEKEND), _FREQUENCIES, Grid(4, 3))
    return solve_table(problem, drive_mode="phased")


@cache
def _layout() -> SurfaceLayout:
    """Four quarters of the board with effects of their own, and a buzz around them."""
    plate = _board_table().plate
    width, height, rim = 0.42 * plate.length, 0.42 * plate.width, 0.04 * plate.length
    corners = [(rim, rim), (plate.length - rim - width, rim)]
    corners += [(x, plate.width - rim - height) for x, _ in corners]
    regions = [
        Region(name, Rectangle(*corner, width, height), on_press=press, on_move=move)
        for (name, (press, move)), corner in zip(_EFFECTS.items(), corners, strict=True)
    ]
    effects = {
        **default_effects(STRONG_DB_SL),
        "course": File.of(_COURSE, name="course", level_db_sl=STRONG_DB_SL, loop=True),
        "short": Buzz(level=STRONG_DB_SL, duration=0.1),
        "texture": Texture(level=STRONG_DB_SL),
    }
    return SurfaceLayout(tuple(regions), effects).for_table(_board_table().frequencies)


_RELEASE = 0.020  # s; from the last finger up to zero
_RAMP = 0.040  # s; along which what plays may fall silent after the last lift
_TOUCH = 0.19  # s; from a touch to its pattern
_HEARTBEAT = 0.055  # s; between two signs of life on an idle line
_ON_THE_WIRE = 0.002  # s; through driver, adapter and back
# Bytes of a silent set for four channels and what may precede it on the line, there and back.
_BYTES = 200
# Bytes between two feeds of one of two amplifiers on a line, there and back: another request, a
# status and a heartbeat of both, a silent set of both, and, as one of those that have waited goes
# before each heartbeat, an operator's clear of both.
_BYTES_BETWEEN_FEEDS = 620
# Modbus RTU is silent before each of the four frames of those eight requests.
_GAPS_BETWEEN_FEEDS = 8 * 4 * 0.00175  # s
_PATTERN = 0.25  # s; from a touch to its pattern
_NOTICED = 0.3  # s; from an unplugged wire to the controller's reaction
_TIMERS_MAX = 2_000
NAMES = ("east", "west", "north")
_QUIET_END = 1.0  # s; duration of the check for silence after closing


def run_plan(plan: Plan, *, trace: list[str] | None = None) -> tuple[list[str], Counter[str]]:
    """Run a plan to its end; trace: takes a line of each event, if it is kept.

    Returns what was violated, and the counts of touches, faults, patterns, frames and so on.
    """
    counts: Counter[str] = Counter(f"on {line.kind}" for line in plan.lines)
    counts[f"of {plan.plate}"] += 1
    violations: list[str] = []
    errors = logging.Handler(logging.ERROR)
    errors.emit = lambda record: _note_traceback(record, violations)  # type: ignore[method-assign]
    loggers = [logging.getLogger(name) for name in ("controller", "drivers", "sim")]
    for logger in loggers:
        logger.addHandler(errors)
    try:
        run_virtual(_run(plan, trace, counts, violations), rng=random.Random(plan.seed + 1))
    except Stuck as problem:
        violations.append(str(problem))
    finally:
        for logger in loggers:
            logger.removeHandler(errors)
    return violations, counts


def _note_traceback(record: logging.LogRecord, violations: list[str]) -> None:
    if record.exc_info:
        violations.append(f"logged: {record.getMessage()} {record.exc_info[1]!r}")


async def _run(
    plan: Plan, trace: list[str] | None, counts: Counter[str], violations: list[str]
) -> None:
    """Run a plan from the start of the far ends to their end."""
    rig = soak_rig(plan.plate, NAMES[: plan.amplifiers] if plan.amplifiers > 1 else ())
    own = {"shared": len(plan.lines) < len(rig.amplifiers), "unpluggable": True, "seed": plan.seed}
    wires = {
        name: replace(line, line=str(number % len(plan.lines)), **own)
        for number, (name, line) in enumerate(zip(rig.amplifiers, 3 * plan.lines, strict=False))
    }
    options: dict[str, Any] = {
        "timing": soak_timing(plan.plate),
        "intent_source": soak_source(plan.plate),
        "times": _times_of(plan),
        "seed": plan.seed,
    }
    if plan.amplifiers > 1:
        crystals = draw_imperfections(rig, seed=plan.seed).crystals
        options["imperfections"] = Imperfections(crystals=crystals)
    async with Soak.on(wires, rig, soak_table(plan.plate), **options) as soak:
        soak.plate_judge.violations = violations
        soak.plan, soak.trace, soak.counts = plan, trace, counts
        await soak.play()
        await soak.end()
    await asyncio.sleep(2.0)  # until all bytes in flight have arrived
    left = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
    if left:
        names = sorted(str(task.get_coro()) for task in left)
        soak.plate_judge.violate(f"{len(left)} tasks are left: {names}")


def _times_of(plan: Plan) -> HostTimes:
    """The bounds by which a host without faults is judged, on the slowest wire."""

    def release(preceding: int) -> float:
        """How long after the last finger the plate may play [s], after bytes on the line."""
        on_wire = [preceding * 10 / line.speed if line.speed else 0.0 for line in plan.lines]
        return _RELEASE + max(on_wire) + _ON_THE_WIRE + _late(plan)

    gaps = any(line.kind == "modbus-rtu" for line in plan.lines) * _GAPS_BETWEEN_FEEDS
    return HostTimes(
        heartbeat=_HEARTBEAT + release(_BYTES_BETWEEN_FEEDS) + gaps,
        lift=release(_BYTES),
        release=release(_BYTES) + _RAMP,
        touch=_TOUCH + _late(plan),
        stop=release(_BYTES),
    )


def _late(plan: Plan) -> float:
    """By how much the slowest line lets an exchange take longer [s]."""
    kinds = [LINE_KINDS[line.line_kind] for line in plan.lines if line.line_kind != PROMPT]
    return max([kind.max_delay for kind in kinds], default=0.0)


@dataclass
class Soak(Chain):
    """A chain whose control loop a supervisor runs, and what a plan does to it."""

    plan: Plan = field(init=False)
    trace: list[str] | None = None
    counts: Counter[str] = field(default_factory=Counter)
    tasks: list[asyncio.Task[Any]] = field(default_factory=list)
    supervisor: Supervisor = field(init=False)
    hosting: asyncio.Task[None] = field(init=False)

    def __post_init__(self) -> None:
        """Note what passes on the wires, and what is requested."""
        super().__post_init__()
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        self.loop = loop
        loop.seen = self._seen
        self.host_rules.set_contacts(())
        loop.set_exception_handler(self._unhandled)
        for name, device in self.far.devices.items():
            after_each(device, self._count_request)
            device.listeners.append(
                lambda event, at, name=name: self.note(
                    "amplifier", name, event["state"], event["fault"]
                )
            )

    def note(self, *words: object) -> None:
        """Write a line of the trace: seconds since the start, and what happens."""
        if self.trace is not None:
            line = " ".join(map(str, words))
            self.trace.append(f"{self.loop.time() - START:.9f} {line}\n")

    def _count_request(self, *_: object) -> None:
        self.counts["requests"] += 1

    def _seen(self, link: str, toward: str, data: bytes) -> None:
        """Note bytes on a wire."""
        self.counts["pieces on the wires"] += 1
        self.counts["bytes on the wires"] += len(data)
        if self.trace is not None:
            self.note("bytes", link, toward, data.hex())

    def make_host(self, **more: Any) -> None:
        """Make a supervisor with its control loop."""
        super().make_host(**more)
        self.supervisor = Supervisor(self.controller, alive=lambda: None)
        self.supervisor.current.observers.append(lambda old, new: self.note("state", new.state))
        self.supervisor.link_observers.append(self._link_changed)
        loop = self.controller.cycle.observers
        loop.reported.append(self._applied)
        loop.refused.append(lambda why: self.note("observer refused", why))

    async def open(self) -> None:
        """Have the supervisor open all wires, and run the control loop."""
        self.hosting = asyncio.create_task(self.supervisor.run())

    def _link_changed(self, change: str, lost: Sequence[str], message: str) -> None:
        self.note("link", change, message)
        self.counts["links lost"] += change == "lost"

    def _applied(self, applied: PlayReport) -> None:
        if not applied.contents:
            return
        self.counts["patterns"] += 1
        drive = dict(sorted(applied.drive.items()))
        self.note("pattern", f"{applied.latency or 0.0:.9f}", drive)

    def _unhandled(self, loop: Any, context: dict[str, Any]) -> None:
        error = context.get("exception")
        self.plate_judge.violate(f"unhandled: {context['message']} {error!r}")

    async def play(self) -> None:
        """Open the chain, and run the actions of the plan."""
        await self.open()
        devices = [*self.far.devices.values()]
        for action in self.plan.actions:
            await self._until(action.at)
            match action:
                case TouchSequence():
                    self.counts["gestures"] += 1
                    self._spawn(self._touch(action))
                case FaultInjection(number=number, window=window):
                    self.counts[f"fault {window.fault}"] += 1
                    self.note("fault", devices[number].name, window)
                    self.host_rules.inject_fault(window)
                    devices[number].inject_fault(window)
                    if window.fault == "unplug":
                        self._expect_loss(number)
                case OperatorAction():
                    self.counts[f"operator {action.what}"] += 1
                    self.note("operator", action.what)
                    self._spawn(self._operate(action))
        await self._until(self.plan.lasts)

    async def _until(self, at: float) -> None:
        await asyncio.sleep(max(0.0, START + at - self.loop.time()))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        self.tasks = [task for task in self.tasks if not task.done()]
        self.tasks.append(asyncio.create_task(work))

    async def _touch(self, sequence: TouchSequence) -> None:
        for time, stamp, touches in sequence.frames:
            await self._until(sequence.at + time)
            now = self.loop.time()
            self.note("touch", sequence.source, stamp, touches)
            self.counts["touch frames"] += 1
            must_be_felt = (
                sequence.gesture == "hold"
                and bool(touches)
                and self.plate_judge.contacts.last <= now
                and self._must_be_felt()
            )
            placed = tuple(Touch(*touch) for touch in touches)
            frame = TouchFrame(sequence.source, now + stamp, placed)
            self.deliver(frame, must_be_felt=must_be_felt)
            self.counts["touches that must be felt"] += must_be_felt

    @property
    def _is_armed(self) -> bool:
        return self.supervisor.operation.state is DaemonState.OPERATION_ENABLED

    def _must_be_felt(self) -> bool:
        """Whether a first touch now must lead to a pattern."""
        at = self.loop.time() - START
        return self._is_armed and self.plan.is_calm(at - 0.1, at + _PATTERN)

    def _expect_loss(self, number: int) -> None:
        """Check that an armed host detects an unplugged wire in time."""
        if not self._is_armed or (number and len(self.plan.lines) == 1):
            return  # a shared line is unplugged at its first amplifier
        host, stalls = self.supervisor, self.counts["operator stall"]

        def look() -> None:
            is_other = host is not self.supervisor or stalls != self.counts["operator stall"]
            if self._is_armed and not is_other and self.turning.is_set():
                self.plate_judge.violate("a wire is unplugged and the controller still armed")

        self.loop.call_later(_NOTICED, look)

    async def _operate(self, action: OperatorAction) -> None:
        match action.what:
            case "kill":
                await self._kill()
            case "stall" if self.supervisor.operation.state is not DaemonState.SWITCHED_ON:
                self.turning.clear()
                self.loop.call_later(action.lasts, self.turning.set)
            case "stall":  # not while it arms
                pass
            case "ready":
                if not self._is_armed:
                    if not await self.tried("clear"):  # what no client had seen yet
                        await self.tried("clear")
                    await self.tried("arm")
                at = self.loop.time() - START
                if self.plan.is_calm(action.at - 0.1, at) and not self._is_armed:
                    state = self.supervisor.operation
                    self.plate_judge.violate(f"could not be armed without a fault: {state}")
            case _:
                await self.tried(action.what)

    async def tried(self, what: str) -> bool:
        """Carry out a request of an operator; a refusal is a valid outcome, False.

        It waits while the loop stalls, as in a process, but for a stop.
        """
        try:
            if what == "stop":
                await self.supervisor.stop("as told")
            else:
                await self.turning.wait()
                await self.supervisor.handle(DaemonEvent(Trigger[what.upper()], "as told"))
        except (DriverError, RpcError) as problem:
            self.note("refused", what, type(problem).__name__, problem)
            return False
        self.note("done", what)
        return True

    async def _kill(self) -> None:
        """Kill the host's process, and start another."""
        self.operation.kill_host()
        self.loop.kill_hosts()
        self.host_rules.closed()
        work = [self.hosting, *self.supervisor.tasks]
        for task in work:
            task.cancel()
        await asyncio.gather(*work, return_exceptions=True)
        await self.controller.release()
        self.make_host(intent_source=soak_source(self.plan.plate))
        await self.open()

    async def end(self) -> None:
        """Close all, and check for silence and for what is left."""
        await self.supervisor.close("the plan has ended")
        await asyncio.gather(self.hosting, *self.tasks, return_exceptions=True)
        for task in (self.hosting, *self.tasks):
            error = None if task.cancelled() else task.exception()
            if error is not None:
                self.plate_judge.violate(f"{task.get_coro()} ended with {error!r}")
        await asyncio.sleep(_QUIET_END)
        for name, levels in self.levels().items():
            if any(levels):
                self.plate_judge.violate(f"{name} plays after everything was closed")
        if len(self.loop._scheduled) > _TIMERS_MAX:
            self.plate_judge.violate(f"{len(self.loop._scheduled)} timers wait")
        self.plate_judge.check()
        self.plate_judge.violations += map(str, self.host_rules.finish())
        self.counts["requests judged"] = self.host_rules.requests
