"""The operation of the plate: the one owner of its state, and who may change it by which event.

Actions come before observers: these are called a moment later, each guarded (`DeferredCalls`). The
outcome of each action at the amplifiers is the next event; a lost link is one wherever it shows.

Dumps of what came last before the plate was stopped, written by a thread.
"""

import asyncio
import json
import logging
import math
import os
import secrets
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, TypeVar

from controller.operation.operation_states import (
    ENERGISED,
    READ_BACK_INTERVAL,
    Action,
    DaemonEvent,
    DaemonState,
    DeferredCalls,
    Lease,
    Operation,
    Trigger,
    acknowledge,
    call_guarded,
    failed,
    find_problem,
    is_any_armed,
    step,
)
from controller.play.loop import Controller
from drivers.errors import (
    CommandRefused,
    DriverError,
    LinkDegraded,
    LinkError,
    Preempted,
    WrongAmplifier,
)
from drivers.host.amplifier import Amplifier
from drivers.host.dialogue import Stopped
from drivers.host.line import Line
from registry import threads
from registry.plugins import failure_text

_EPOCHS = 2**31  # of which a daemon begins at one by chance: exact as numbers of JSON
_MAX_READ_BACKS = 15
LEASE_OVER = DaemonEvent(Trigger.DISARM, "the arming lease was not renewed", "arm again")
_REOPENING = "the daemon reconnects by itself and stays disarmed"

LinkChange = Literal["degraded", "restored", "lost", "retry", "reopened"]
StateObserver = Callable[[Operation, Operation], None]
"""Receives the operation before and after a change."""

_LOG_LEVELS = {
    DaemonState.COMM_LOST: logging.ERROR,
    DaemonState.FAULT_REACTION_ACTIVE: logging.ERROR,
}

_logger = logging.getLogger(__name__)
_T = TypeVar("_T")


class Operator:
    """Applies events to the operation of the plate, and carries out their actions by a controller.

    An unexpected exception in a transition or action ends in a stop of all amplifiers and in FAULT.
    state_changed are called a moment after every change of the state or its epoch; link_changed
    receives the kind of change, the amplifiers concerned where they are known, and a message.
    """

    controller: Controller
    """With the amplifiers; to be set before all else, since it is made with the observer."""

    def __init__(
        self,
        *,
        state_changed: Sequence[StateObserver],
        link_changed: Callable[[LinkChange, Sequence[str], str], None],
    ) -> None:
        # Not that of a daemon before, whose clients may be left.
        self.operation = Operation(epoch=secrets.randbelow(_EPOCHS))
        self._state_observers = (_log_transition, *state_changed)
        self._link_observer = link_changed
        self._loss_lock = asyncio.Lock()  # held until the lost amplifiers are closed
        self._clears: list[int] = []  # epochs of those in progress
        self._reports = DeferredCalls()
        self._tasks: set[asyncio.Task[Any]] = set()
        self._lease_timer: asyncio.TimerHandle | None = None
        self._changed = asyncio.Event()  # to another state, since `run` has looked at it

    async def handle(self, event: DaemonEvent) -> None:
        """Apply an event and carry out its actions; raises the error of an action.

        The actions are completed even if the caller is cancelled.
        """
        try:
            await asyncio.shield(self._spawn(self._applied(event)))
        except (DriverError, asyncio.CancelledError):
            raise
        except Exception as error:
            await self._fail(error)
            raise

    def post(self, event: DaemonEvent) -> None:
        """Apply an event at once and carry out its actions in a task."""
        self._spawn(self._in_background(self._applied(event)))

    def renew(self, lease: Lease) -> Lease:
        """Renew the lease of who armed, which must not have ended."""
        renewed = lease.renewed(threads.now())
        self.operation = replace(self.operation, lease=renewed)
        return renewed

    def withdraw(self, token: str, cause: str) -> None:
        """Disarm, unless the lease of a token has ended."""
        lease = self.operation.lease
        if lease is not None and lease.token == token:
            self.post(DaemonEvent(Trigger.DISARM, cause, "arm again"))

    def note_lost(self, names: tuple[str, ...], error: Exception) -> None:
        """Note which amplifiers are lost now, where that is known, and the present cause."""
        lost = self.operation.lost
        if lost is not None:
            lost = lost._replace(names=names or lost.names)
            self.operation = replace(
                self.operation, cause=str(error), remedy=remedy_of(error), lost=lost
            )

    def tick(self) -> None:
        """End the lease if it has expired, else look again when it will have."""
        operation, now = self.operation, threads.now()
        if operation.is_lease_over(now):
            self.post(LEASE_OVER)
        elif operation.lease is not None:
            pause = operation.lease.expires_at - now
            self._lease_timer = asyncio.get_running_loop().call_later(pause, self.tick)

    def _spawn(self, work: Coroutine[Any, Any, _T]) -> "asyncio.Task[_T]":
        """Run work in a task that `run` waits for."""
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    def _step(self, event: DaemonEvent) -> tuple[Action, ...]:
        """Apply one transition; return its actions."""
        before, now = self.operation, threads.now()
        try:
            self.operation, actions = step(before, event, now)
        except Exception as error:
            self.operation, actions = failed(before, failure_text(error)), (Action.STOP,)
        self._report_transition(before)
        return actions

    def _report_transition(self, before: Operation) -> None:
        """Notify the observers of a new epoch, deferred; look after a lease that has begun."""
        if self.operation.epoch == before.epoch:
            return
        self._changed.set()
        for observer in self._state_observers:
            call_guarded(partial(self._reports.add, partial(observer, before, self.operation)))
        if self._lease_timer is not None:
            self._lease_timer.cancel()
        if self.operation.state is DaemonState.OPERATION_ENABLED:
            self.tick()

    def _applied(self, event: DaemonEvent) -> Coroutine[Any, Any, None]:
        """Apply an event; await its actions."""
        actions = self._step(event)
        return self._carry_out(actions, self.operation.epoch)

    async def _fail(self, error: Exception) -> None:
        """Stop all amplifiers after an unexpected exception, which is a fault."""
        before, self.operation = self.operation, failed(self.operation, failure_text(error))
        self._report_transition(before)
        await asyncio.shield(self._spawn(self._stop()))

    async def _in_background(self, work: Awaitable[object]) -> None:
        """Await work without a caller: its errors are already part of the state."""
        try:
            await work
        except DriverError as error:
            _logger.info("failed: %s", error)
        except Exception as error:
            _logger.exception("failed, stopping all amplifiers")
            await self._fail(error)

    def stop(self, cause: str, remedy: str | None = None) -> Awaitable[Mapping[str, Stopped]]:
        """Quick-stop all amplifiers in any state; await the outcome of each, by name.

        The requests to the amplifiers are queued when this returns.
        """
        stopping = self._spawn(self._stopped(self.controller.stop_all()))
        self._step(DaemonEvent(Trigger.STOP, cause, remedy))
        return asyncio.shield(stopping)

    def stop_anyhow(self) -> Awaitable[object]:
        """Stop all amplifiers where a client's stop has failed on its way, and latch that."""
        cause = "stopped, though the request failed on its way"
        try:
            return asyncio.ensure_future(self.controller.group.stop())
        finally:
            call_guarded(partial(self._step, DaemonEvent(Trigger.STOP, cause, acknowledge(cause))))

    def assume_energised(self, now: float) -> bool:
        """Whether a lost amplifier may still be playing at a time [s], as a stop would say."""
        return self.operation.lost is not None and any(
            now < self.what_may_play(name).may_play_until for name in self.controller.urls
        )

    def what_may_play(self, name: str) -> Stopped:
        """What an amplifier may play as far as is known, and why no more is."""
        lost = self.operation.lost
        is_named = lost is not None and name in (lost.names or self.controller.urls)
        return self.controller.what_may_play(name, self.operation.cause if is_named else "")

    def _link_changed(self, change: LinkChange, lost: Sequence[str], message: str) -> None:
        report = partial(self._link_observer, change, lost, message)
        call_guarded(partial(self._reports.add, report))

    async def _carry_out(self, actions: Sequence[Action], epoch: int) -> None:
        """Carry out the actions of a transition to an epoch, one after the other."""
        for action in actions:
            match action:
                case Action.VERIFY:
                    await self._over_link(self._verify(epoch), epoch)
                case Action.ARM:
                    await self._over_link(self._arm(), epoch)
                case Action.DISARM:
                    await self._over_link(self.controller.disarm(), epoch)
                case Action.STOP:
                    await self._stop()
                case Action.REACT:
                    await self._stop()
                    await self.handle(DaemonEvent(Trigger.REACTION_DONE))
                case Action.CLEAR:
                    await self._over_link(self._clear(epoch), epoch)
                case Action.RECONNECT:
                    await self.controller.release()
                    self._changed.set()
                case Action.CLOSE:
                    await self.controller.close()

    async def _over_link(self, work: Awaitable[object], epoch: int) -> None:
        """Await work that needs the link; a loss or refusal becomes an event, then is raised.

        Not where it is explained: by what has raised the epoch since, or by a stop that goes on.
        """
        try:
            await work
        except LinkError as error:
            if isinstance(error, LinkDegraded) and self.operation.state is DaemonState.SWITCHED_ON:
                await self.handle(DaemonEvent(Trigger.DISARM, "an amplifier did not reply to arm"))
            else:
                await self._handle_loss(error)
            raise
        except DriverError as error:
            is_stopping = isinstance(error, Preempted) and self.operation.is_latched
            if epoch == self.operation.epoch and not is_stopping:
                await self.handle(DaemonEvent(Trigger.FAULT, str(error)))
            raise

    async def _stopped(self, stopping: Awaitable[Mapping[str, Stopped]]) -> Mapping[str, Stopped]:
        """Await a stop; an amplifier that is lost is a lost link, handled after its return."""
        stopped = await stopping
        self._spawn(self._check_links())  # which may stop all once more
        return stopped

    async def _stop(self) -> None:
        await self._stopped(self.controller.stop())

    @property
    def _is_loss_handled(self) -> bool:
        """Whether amplifiers are lost or closed already."""
        return self.operation.state in (DaemonState.COMM_LOST, DaemonState.NOT_READY)

    async def _check_links(self) -> None:
        """Handle the loss of an amplifier unless it is handled already."""
        causes = self.controller.group.members.lost_by.values()
        if causes and not self._is_loss_handled:
            try:
                await self._handle_loss(LinkError(next(iter(causes))))
            except Exception:
                _logger.exception("handling of a lost link failed")

    async def _arm(self) -> None:
        await self.controller.arm()
        await self.handle(DaemonEvent(Trigger.ARMED, self.operation.cause))

    async def _verify(self, epoch: int) -> None:
        """Disarm what still plays, then read back all amplifiers."""
        is_armed = is_any_armed(await self.controller.group.statuses())
        if is_armed and epoch == self.operation.epoch:
            await self.controller.disarm()
        problem = await self._read_back(epoch)
        if epoch != self.operation.epoch:
            return  # stopped, or verified and armed, in the meantime
        if problem is None:
            cause = "all amplifiers are disarmed, at level zero and without a fault"
            await self.handle(DaemonEvent(Trigger.VERIFIED, cause))
        else:
            await self.handle(DaemonEvent(Trigger.FAULT, problem))

    async def _clear(self, epoch: int) -> None:
        self._clears.append(epoch)
        try:
            problem = await self._read_back(epoch, clears=True)
        finally:
            self._clears.remove(epoch)
        self._check_none_since(epoch)
        if problem is None:
            await self.handle(DaemonEvent(Trigger.VERIFIED, "acknowledged, and the cause is gone"))
            return
        await self.handle(DaemonEvent(Trigger.FAULT, problem))
        raise CommandRefused(f"{problem}; the cause persists, so nothing was cleared")

    def _check_none_since(self, epoch: int) -> None:
        """Raise Preempted if a stop, fault or other clear came after an acknowledgement."""
        if epoch != self.operation.epoch:
            raise Preempted(
                "not cleared: a stop, fault or other clear came after the request; find the cause "
                "of what is latched, then clear again"
            )

    async def _read_back(self, epoch: int, *, clears: bool = False) -> str | None:
        """Read back until all amplifiers are silent; return the problem that remains, if any.

        clears: before each read, for one that is still ramping down ignores Clear. Ends early
        when the epoch rises.
        """
        problem = None
        for _ in range(_MAX_READ_BACKS):
            if clears:
                self._check_none_since(epoch)
                await self.controller.clear()
            group = self.controller.group
            problem = find_problem(await group.statuses(), group.amplifiers)
            if problem is None or epoch != self.operation.epoch:
                break
            await asyncio.sleep(READ_BACK_INTERVAL)
        return problem

    async def _handle_loss(self, error: LinkError) -> None:
        """Handle a loss; concurrent reports of the same loss wait until it is handled."""
        async with self._loss_lock:
            group = self.controller.group
            lost = *group.members.lost_by, *group.members.degraded
            if self.operation.state is not DaemonState.COMM_LOST:
                self._link_changed("lost", lost, str(error))
            cause = f"amplifier {', '.join(lost)}: {error}" if lost else str(error)
            event = DaemonEvent(Trigger.LINK_LOST, cause, remedy_of(error), amplifiers=lost)
            await self.handle(event)


def remedy_of(error: Exception) -> str:
    """What to do about amplifiers that cannot be opened: that of the error itself comes first."""
    return (
        _REOPENING
        if isinstance(error, WrongAmplifier)
        else f"check cables and supply; {_REOPENING}"
    )


def _log_transition(before: Operation, after: Operation) -> None:
    if after.state is before.state:
        return
    _logger.log(
        _LOG_LEVELS.get(after.state, logging.INFO),
        "%s -> %s: %s",
        before.state,
        after.state,
        after.cause,
        extra={"topic": "state", "cause": after.cause, "remedy": after.remedy},
    )


DUMP_PATTERN = "era-fault-*.jsonl"
"""File names of dumps of faults and losses; those of stops have `stop` for `fault`."""

MAX_DUMPS = 20  # files of a kind in a folder; the oldest are deleted
MAX_RECORDS = 400  # over all lines: the last seconds under load, ten seconds at rest
MAX_REQUESTS = 60  # methods of clients
MAX_DECISIONS = 200  # the last second of many moving fingers
_MAX_TRANSITIONS = 20
MAX_LINE = 8192  # characters; a longer record is left out, and says so
_MAX_TEXT = 400  # characters of a cause
_MIN_INTERVAL = 1.0  # s; one dump for faults that come together
_DUMPED = (DaemonState.FAULT_REACTION_ACTIVE, DaemonState.FAULT, DaemonState.COMM_LOST)


class FaultDumps:
    """Keeps what came last unformatted, and writes it in a thread: a disk may be slow or gone.

    One dump at a time, so that a hanging disk costs one thread. folder: None for no dumps.
    records: messages of the amplifiers; decisions: of the control loop.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self.records: deque[Mapping[str, object]] = deque(maxlen=MAX_RECORDS)
        self.decisions: deque[Mapping[str, object]] = deque(maxlen=MAX_DECISIONS)
        self._requests: dict[tuple[str, str], dict[str, Any]] = {}  # by client and method
        self._transitions: deque[Mapping[str, object]] = deque(maxlen=_MAX_TRANSITIONS)
        self._written_at = dict.fromkeys(("fault", "stop"), -math.inf)
        self._writer: threading.Thread | None = None

    def follow(self, amplifiers: Mapping[str, Amplifier]) -> None:
        """Record the messages of the lines of amplifiers, by name, from now on, if for a dump."""
        if self._folder is None:
            return
        by_line: dict[Line, dict[int, str]] = {}
        for name, amplifier in amplifiers.items():
            by_line.setdefault(amplifier.line, {})[amplifier.address] = name
        for line, names in by_line.items():
            line.seen = partial(self._seen, line.name, names)

    def _seen(
        self,
        line: str,
        names: Mapping[int, str],
        way: str,
        address: int,
        message: str,
        content: object = "",
    ) -> None:
        """Record a message of an amplifier or line; a stop depends on no record."""
        try:
            where = {"time_s": threads.now(), "link": names.get(address, line)}
            self.records.append({**where, "way": way, "message": message, "content": content})
        except Exception:
            _logger.exception("recorder failed")

    def requested(self, client: str, method: str, at: float) -> dict[str, Any]:
        """Note that a client has called a method at a time [s]; return the record for the outcome.

        Of each method of a client the last call, how often it was, and why one was refused last:
        what is repeated without end leaves the others. Parameters, as a lease, are not kept.
        """
        before = self._requests.pop((client, method), {"times": 0, "refused": ""})
        record = self._requests[client, method] = {
            "time_s": at,
            "request": method or "not read",
            "client": client,
            "times": before["times"] + 1,
            "outcome": "not replied yet",
            "refused": before["refused"],
        }
        if len(self._requests) > MAX_REQUESTS:
            del self._requests[next(iter(self._requests))]
        return record

    def state_changed(self, old: Operation, new: Operation) -> None:
        """Write a dump at a fault, a loss, or a stop of an armed plate.

        Unless one of that kind was written within the last second.
        """
        now, folder, kind = threads.now(), self._folder, "fault"
        change = {"time_s": now, "state": f"{old.state} -> {new.state}", "cause": new.cause}
        self._transitions.append(change)
        if new.state is DaemonState.QUICK_STOP_ACTIVE and old.state in ENERGISED:
            kind = "stop"
        elif new.state not in _DUMPED:
            return
        if folder is None or now - self._written_at[kind] < _MIN_INTERVAL:
            return
        self._written_at[kind] = now
        if self._writer is not None and self._writer.is_alive():
            _logger.warning("dump in %s skipped: previous dump still being written", folder)
            return
        requests = map(dict, self._requests.values())  # whose outcome may come meanwhile
        records = [*self.records, *requests, *self.decisions, *self._transitions]

        def write() -> None:
            try:
                path = write_dump(folder, records, cause=new.cause, kind=kind)
                _logger.info("dump: wrote %s", path)
            except Exception as error:
                _logger.warning("dump in %s failed: %s", folder, error)

        self._writer = threading.Thread(target=write, name="dump", daemon=True)
        self._writer.start()


def write_dump(
    folder: Path, records: Iterable[Mapping[str, Any]], *, cause: str, kind: str = "fault"
) -> Path:
    """Write records in order of time to a new file; keep the newest `MAX_DUMPS` of its kind.

    A file that cannot be written completely is deleted. Raises OSError.
    """
    pattern = DUMP_PATTERN.replace("fault", kind)
    folder.mkdir(parents=True, exist_ok=True)
    stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
    path = folder / pattern.replace("*", f"{stamp}-{time.monotonic_ns() % 10**9:09d}")
    opened = open(path, "x", encoding="utf-8", opener=_owner_only)  # noqa: SIM115
    try:
        with opened as stream:
            stream.write(_line({"cause": cause, "unix_time_s": time.time()}))
            stream.writelines(map(_line, sorted(records, key=itemgetter("time_s"))))
    except Exception:
        path.unlink(missing_ok=True)
        raise
    # The new file may sort first: boards without a battery start in 1970.
    others = sorted(each for each in folder.glob(pattern) if each != path)
    for old in others[: max(0, len(others) + 1 - MAX_DUMPS)]:
        old.unlink(missing_ok=True)
    return path


def _owner_only(path: str, flags: int) -> int:
    """Open a file with mode 0600 from its creation on."""
    return os.open(path, flags, 0o600)


def _line(record: Mapping[str, Any]) -> str:
    """A record as a line of JSON; what is not finite is null."""
    known = {
        key: value[:_MAX_TEXT] if isinstance(value, str) else value
        for key, value in record.items()
        if value != ""
    }
    text = json.dumps(known, default=_content)
    if len(text) > MAX_LINE:
        text = json.dumps({"time_s": record["time_s"], "skipped": f"{len(text)} characters"})
    return json.dumps(json.loads(text, parse_constant=lambda _: None)) + "\n"


def _content(value: Any) -> object:
    """What an arrival on a wire, a contact or a prediction says."""
    return value.values if hasattr(value, "values") else asdict(value)
