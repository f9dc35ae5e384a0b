"""One soak run: the whole chain in virtual time, from touch frames to the plate, as its plan says.

Everything between the table and the plate is the project's own: supervisor, control loop, ledgers,
lines, codecs, far ends and amplifiers. Only the lines are memory, and the clock is virtual.
"""

import asyncio
import hashlib
import logging
import random
from collections import Counter
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TextIO

from controller.api.jsonrpc import RpcError
from controller.daemon.states import DaemonEvent, DaemonState, Trigger
from controller.daemon.supervisor import Supervisor
from controller.loop.loop import Controller
from controller.loop.observer import Applied, Observer
from controller.sources.touch import Touch, TouchFrame
from drivers.errors import DriverError
from drivers.opening import Lines
from model.table.timing import Timing
from newest_contact import BuzzNewestContact
from paper_plate import make_paper_rig
from rig_on_wire import after_each, far_side, on_two_amplifiers
from sim.bench.amplifier_device import AmplifierDevice
from sim.far_ends.wires import Wire
from small_table import small_table
from soak_judges import Checks, SoakWitness, SourceContacts
from soak_plan import FaultInjection, OperatorAction, Plan, TouchSequence
from virtual_loop import START, Stuck, VirtualLoop, run_virtual

_RELEASE = 0.020  # s; from the last finger up to zero
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
_QUIET_END = 1.0  # s; duration of the check for silence after closing


@dataclass
class Outcome:
    """Outcome of a run; counts: of touches, faults, patterns, frames and so on, by name."""

    seed: int
    digest: str
    violations: list[str]
    counts: Counter[str]
    virtual: float
    busy: float


class Trace:
    """Trace of a run, one line per event: hashed, and written to a file if any."""

    def __init__(self, file: TextIO | None) -> None:
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


def run_plan(plan: Plan, *, trace: TextIO | None = None) -> Outcome:
    """Run a plan to its end."""
    written = Trace(trace)
    counts: Counter[str] = Counter(f"on {line.kind}" for line in plan.lines)
    run = _Run(plan, written, counts)

    with _errors_of(run):
        try:
            run_virtual(run.main(), rng=random.Random(plan.seed + 1))
        except Stuck as problem:
            run.violations.append(str(problem))
    return Outcome(plan.seed, written.digest, run.violations, counts, plan.lasts, plan.busy)


@dataclass
class _Run:
    """The chain of one plan."""

    plan: Plan
    trace: Trace
    counts: Counter[str]
    violations: list[str] = field(default_factory=list)

    def note(self, *words: object) -> None:
        """Write a line of the trace."""
        self.trace.note(self.loop.time() - START, *words)

    async def main(self) -> None:
        """Run from the start of the far ends to their end."""
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        self.loop = loop
        loop.set_exception_handler(self._unhandled)
        rig = make_paper_rig(12, 9)
        self.rig = rig if self.plan.amplifiers == 1 else on_two_amplifiers(rig)
        self.contacts = SourceContacts()
        self.stalled_for = 0.0
        self.turning = asyncio.Event()  # unless the control loop stalls
        self.turning.set()
        self.running: asyncio.Task[None] | None = None
        self.tasks: list[asyncio.Task[Any]] = []
        lines, names = self.plan.lines, [*self.rig.amplifiers]
        wires = {
            name: Wire(
                lines[number % len(lines)].kind,
                speed=lines[number % len(lines)].speed,
                shared=len(lines) < len(names),
                unpluggable=True,
                line=str(number % len(lines)),
            )
            for number, name in enumerate(names)
        }
        async with far_side(wires, self.rig, seed=self.plan.seed) as far:
            self.far = far
            self.witness = SoakWitness(
                far.urls,
                self.contacts,
                channels=1 + max(channel.number for channel in self.rig.wiring.values()),
                release=self._release(),
                heartbeat=self._release(_BYTES_BETWEEN_FEEDS)
                + any(line.kind == "modbus-rtu" for line in lines) * _GAPS_BETWEEN_FEEDS,
            )
            loop.seen = self._seen
            self.checks = Checks(
                far.bench, begin=loop.time(), contacts=self.contacts, sense=self.witness.sense
            )
            self.checks.violations = self.violations
            for name, device in far.devices.items():
                self._listen(name, device)
            self._host()
            await self._play()
            await self._end()
            self.checks.check()
            self.violations += self.witness.found()
            self.counts["frames seen by the witness"] = self.witness.frames
        self.checks.close()
        await asyncio.sleep(2.0)  # until all bytes in flight have arrived
        left = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        if left:
            names = sorted(str(task.get_coro()) for task in left)
            self.checks.violate(f"{len(left)} tasks are left: {names}")

    def _host(self) -> None:
        """Start a host: a supervisor with its control loop; the witness hears what they do."""
        table = small_table()
        supervisor = self.supervisor = Supervisor(
            state_changed=(lambda old, new: self.note("state", new.state),),
            link_changed=self._link_changed,
            alive=lambda: None,
        )
        controller = self.controller = Controller(
            self.rig,
            table,
            lines=Lines,
            intent_source=BuzzNewestContact(),
            timing=Timing(table),
            urls=self.far.urls,
            connected=supervisor.connected,
            observer=supervisor.observer(),
        )
        controller.observers.append(
            Observer(
                pattern_applied=self._applied,
                refused=lambda why: self.note("observer refused", why),
            )
        )
        self.witness.follow(controller)
        controller.run = partial(self._run_on, controller.run)  # type: ignore[method-assign]
        supervisor.controller = controller
        self.hosting = asyncio.create_task(supervisor.run())

    def _seen(self, link: str, toward: str, data: bytes) -> None:
        """Note bytes on a wire."""
        self.counts["pieces on the wires"] += 1
        self.counts["bytes on the wires"] += len(data)
        self.note("bytes", link, toward, data.hex())
        self.witness.seen(link, toward, data)

    def _link_changed(self, change: str, lost: Sequence[str], message: str) -> None:
        self.note("link", change, message)
        self.counts["links lost"] += change == "lost"

    def _release(self, preceding: int = _BYTES) -> float:
        """How long after the last finger the plate may play, without faults [s].

        preceding: bytes that may be on the line before.
        """
        on_wire = [preceding * 10 / line.speed if line.speed else 0.0 for line in self.plan.lines]
        return _RELEASE + max(on_wire) + _ON_THE_WIRE

    def _listen(self, name: str, device: AmplifierDevice) -> None:
        """Note what an amplifier is asked, and what becomes of it."""

        def note(request: str, *_: object) -> None:
            self.counts["requests"] += 1
            self.checks.exchanged(name, request)

        after_each(device, note)
        device.listeners.append(
            lambda event, at: self.note("amplifier", name, event["state"], event["fault"])
        )

    async def _play(self) -> None:
        """Run the actions."""
        by_number = [*self.far.devices.values()]
        for action in self.plan.actions:
            await self._until(action.at)
            match action:
                case TouchSequence():
                    self.counts["gestures"] += 1
                    self._spawn(self._touch(action))
                case FaultInjection(number=number, window=window):
                    self.counts[f"fault {window.fault}"] += 1
                    self.note("fault", by_number[number].name, window)
                    self.witness.inject_fault(window)
                    by_number[number].inject_fault(window)
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
        begin = self.loop.time()
        for time, stamp, touches in sequence.frames:
            await asyncio.sleep(max(0.0, begin + time - self.loop.time()))
            now = self.loop.time()
            self.note("touch", sequence.source, stamp, touches)
            self.counts["touch frames"] += 1
            was_touched = now < self.contacts.last
            self.contacts.frame(sequence.source, now + stamp, touches, now)
            is_new = not was_touched and now < self.contacts.last and sequence.gesture == "hold"
            must_be_felt = is_new and self._must_be_felt()
            self.witness.touched(must_be_felt=must_be_felt)
            placed = tuple(Touch(*touch) for touch in touches)
            self.controller.deliver(TouchFrame(sequence.source, now + stamp, placed))
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
        host, running = self.supervisor, self.running

        def look() -> None:
            is_other = running is None or self.running is not running  # stalled meanwhile
            if self.supervisor is host and self._is_armed and not is_other:
                self.checks.violate("a wire is unplugged and the controller still armed")

        self.loop.call_later(_NOTICED, look)

    async def _operate(self, action: OperatorAction) -> None:
        if action.what == "kill":
            await self._kill()
        elif action.what == "stall":
            self._stall(action.lasts)
        elif action.what == "ready":
            if not self._is_armed:
                if not await self._request("clear"):  # what no client had seen yet
                    await self._request("clear")
                await self._request("arm")
            at = self.loop.time() - START
            if self.plan.is_calm(action.at - 0.1, at) and not self._is_armed:
                state = self.supervisor.operation
                self.checks.violate(f"could not be armed without a fault: {state}")
        else:
            await self._request(action.what)

    async def _request(self, what: str) -> bool:
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
        assert self.far.machine is not None
        self.far.machine.kill_host()
        self.loop.kill_hosts()
        self.witness.closes()
        work = [self.hosting, *self.supervisor._tasks]
        for task in work:
            task.cancel()
        await asyncio.gather(*work, return_exceptions=True)
        await self.controller.release()
        self._host()

    def _stall(self, lasts: float) -> None:
        """Stall the control loop for a time [s], unless it arms."""
        is_arming = self.supervisor.operation.state is DaemonState.SWITCHED_ON
        if self.running is not None and not is_arming:
            self.stalled_for = lasts
            self.running.cancel()

    async def _run_on(self, run: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Run the control loop, across stalls."""
        while True:
            self.running = asyncio.create_task(run())
            try:
                await self.running
                return
            except asyncio.CancelledError:
                if not self.stalled_for:
                    self.running.cancel()
                    raise
                lasts, self.stalled_for = self.stalled_for, 0.0
            finally:
                self.running = None
            self.turning.clear()
            try:
                await asyncio.sleep(_ON_THE_WIRE)
                self.witness.set_stalled(self.loop.time())
                await asyncio.sleep(lasts)
            finally:
                self.witness.set_stalled(self.loop.time(), False)
                self.turning.set()

    def _applied(self, applied: Applied) -> None:
        self.counts["patterns"] += 1
        drive = dict(sorted(applied.drive.items()))
        self.note("pattern", f"{applied.latency or 0.0:.9f}", drive)

    async def _end(self) -> None:
        """Close all, and check for silence and for tasks left."""
        await self.supervisor.close("the plan has ended")
        await asyncio.gather(self.hosting, *self.tasks, return_exceptions=True)
        for task in (self.hosting, *self.tasks):
            error = None if task.cancelled() else task.exception()
            if error is not None:
                self.checks.violate(f"{task.get_coro()} ended with {error!r}")
        await asyncio.sleep(_QUIET_END)
        for name in self.far.devices:
            if any(self.far.summary(name).levels):
                self.checks.violate(f"{name} plays after everything was closed")
        if len(self.loop._scheduled) > _TIMERS_MAX:
            self.checks.violate(f"{len(self.loop._scheduled)} timers wait")

    def _unhandled(self, loop: Any, context: dict[str, Any]) -> None:
        error = context.get("exception")
        self.checks.violate(f"unhandled: {context['message']} {error!r}")


@contextmanager
def _errors_of(run: _Run) -> Iterator[None]:
    """Count logged tracebacks as violations."""

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if record.exc_info:
                run.violations.append(f"logged: {record.getMessage()} {record.exc_info[1]!r}")

    handler = Handler(logging.ERROR)
    names = ("controller", "drivers", "sim")
    for name in names:
        logging.getLogger(name).addHandler(handler)
    try:
        yield
    finally:
        for name in names:
            logging.getLogger(name).removeHandler(handler)
