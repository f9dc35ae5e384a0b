"""One soak run: the one chain with its supervisor, used and misused as its plan says."""

import asyncio
import hashlib
import logging
import random
from collections import Counter
from collections.abc import Coroutine, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TextIO

from chain import Chain
from controller.api.jsonrpc import RpcError
from controller.operation.links import Supervisor
from controller.operation.operation_states import DaemonEvent, DaemonState, Trigger
from controller.play.planner import PlayReport
from controller.sources.touch import Touch, TouchFrame
from drivers.errors import DriverError
from era_haptics.lab.witness.capture import TimeLimits
from plate_witness import PlateTimes
from registry import threads
from rig_on_wire import after_each
from sim.far_ends.wire_assignment import Wire
from sim.plant.imperfections import Imperfections, draw_imperfections
from sim.transport.simulated_line import LINE_KINDS, PROMPT
from soak_plan import FaultInjection, OperatorAction, Plan, TouchSequence
from soak_plates import soak_rig, soak_source, soak_table, soak_timing
from virtual_loop import START, Stuck, VirtualLoop, run_virtual

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


@dataclass
class Outcome:
    """Outcome of a run; counts: of touches, faults, patterns, frames and so on, by name."""

    seed: int
    violations: list[str]
    counts: Counter[str]
    virtual: float
    busy: float


class Trace:
    """Trace of a run, one line per event: hashed, and written to a file if any."""

    def __init__(self, file: TextIO | None = None) -> None:
        self._hash = hashlib.sha256()
        self._file = file

    @property
    def digest(self) -> str:
        """Hash of all lines so far."""
        return self._hash.hexdigest()

    def note(self, time: float, *words: object) -> None:
        """One line; time [s] since the start."""
        line = f"{time:.9f} {' '.join(map(str, words))}\n"
        self._hash.update(line.encode())
        if self._file is not None:
            self._file.write(line)


def run_plan(plan: Plan, *, trace: Trace | None = None) -> Outcome:
    """Run a plan to its end; trace: of all that happens, if it is kept."""
    counts: Counter[str] = Counter(f"on {line.kind}" for line in plan.lines)
    counts[f"of {plan.plate}"] += 1
    violations: list[str] = []
    with _errors_in(violations):
        try:
            run_virtual(_run(plan, trace, counts, violations), rng=random.Random(plan.seed + 1))
        except Stuck as problem:
            violations.append(str(problem))
    return Outcome(plan.seed, violations, counts, plan.lasts, plan.busy)


async def _run(
    plan: Plan, trace: Trace | None, counts: Counter[str], violations: list[str]
) -> None:
    """Run a plan from the start of the far ends to their end."""
    rig = soak_rig(plan.plate, NAMES[: plan.amplifiers] if plan.amplifiers > 1 else ())
    wires = {
        name: Wire(
            line.kind,
            speed=line.speed,
            shared=len(plan.lines) < len(rig.amplifiers),
            unpluggable=True,
            line=str(number % len(plan.lines)),
            line_kind=line.line_kind,
            seed=plan.seed,
        )
        for number, (name, line) in enumerate(zip(rig.amplifiers, 3 * plan.lines, strict=False))
    }
    options: dict[str, Any] = {
        "timing": soak_timing(plan.plate),
        "intent_source": soak_source(plan.plate),
        "judged": _judged(plan),
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


def _judged(plan: Plan) -> Mapping[str, Any]:
    """By what the witness judges: bounds without faults, on the slowest wire."""

    def release(preceding: int) -> float:
        """How long after the last finger the plate may play [s], after bytes on the line."""
        on_wire = [preceding * 10 / line.speed if line.speed else 0.0 for line in plan.lines]
        return _RELEASE + max(on_wire) + _ON_THE_WIRE + _late(plan)

    gaps = any(line.kind == "modbus-rtu" for line in plan.lines) * _GAPS_BETWEEN_FEEDS
    return {
        "limits": PlateTimes(
            lift=release(_BYTES),
            release=release(_BYTES) + _RAMP,
            touch=_TOUCH + _late(plan),
            stop=release(_BYTES),
        ),
        "times": TimeLimits(heartbeat=_HEARTBEAT + release(_BYTES_BETWEEN_FEEDS) + gaps),
    }


def _late(plan: Plan) -> float:
    """By how much the slowest line lets an exchange take longer [s]."""
    kinds = [LINE_KINDS[line.line_kind] for line in plan.lines if line.line_kind != PROMPT]
    return max([kind.max_delay for kind in kinds], default=0.0)


@dataclass
class Soak(Chain):
    """A chain whose control loop a supervisor runs, and what a plan does to it."""

    plan: Plan = field(init=False)
    trace: Trace | None = None
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
        self.witness.contacts(loop.time(), ())
        loop.set_exception_handler(self._unhandled)
        for name, device in self.far.devices.items():
            after_each(device, self._count_request)
            device.listeners.append(
                lambda event, at, name=name: self.note(
                    "amplifier", name, event["state"], event["fault"]
                )
            )

    def note(self, *words: object) -> None:
        """Write a line of the trace."""
        if self.trace is not None:
            self.trace.note(self.loop.time() - START, *words)

    def _count_request(self, *_: object) -> None:
        self.counts["requests"] += 1

    def _seen(self, link: str, toward: str, data: bytes) -> None:
        """Note bytes on a wire."""
        self.counts["pieces on the wires"] += 1
        self.counts["bytes on the wires"] += len(data)
        if self.trace is not None:
            self.note("bytes", link, toward, data.hex())
        self.witness.seen(link, toward, data)

    def make_host(self, **more: Any) -> None:
        """Make a supervisor with its control loop."""
        supervisor = self.supervisor = Supervisor(
            state_changed=(lambda old, new: self.note("state", new.state),),
            link_changed=self._link_changed,
            alive=lambda: None,
        )
        super().make_host(connected=supervisor.connected, **more)
        loop = self.controller.cycle.observers
        supervisor.observe(loop)
        loop.pattern_applied.append(self._applied)
        loop.refused.append(lambda why: self.note("observer refused", why))
        supervisor.controller = self.controller

    async def open(self) -> None:
        """Have the supervisor open all wires, and run the control loop."""
        self.hosting = asyncio.create_task(self.supervisor.run())

    def _link_changed(self, change: str, lost: Sequence[str], message: str) -> None:
        self.note("link", change, message)
        self.counts["links lost"] += change == "lost"

    def _applied(self, applied: PlayReport) -> None:
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
                    self.witness.inject_fault(window)
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
        self.witness.closes()
        work = [self.hosting, *self.supervisor._tasks]
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
        self.plate_judge.violations += map(str, self.witness.finish(threads.now()))
        self.counts["frames seen by the witness"] = self.witness.frames


@contextmanager
def _errors_in(violations: list[str]) -> Iterator[None]:
    """Count logged tracebacks as violations."""

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if record.exc_info:
                violations.append(f"logged: {record.getMessage()} {record.exc_info[1]!r}")

    handler = Handler(logging.ERROR)
    names = ("controller", "drivers", "sim")
    for name in names:
        logging.getLogger(name).addHandler(handler)
    try:
        yield
    finally:
        for name in names:
            logging.getLogger(name).removeHandler(handler)
