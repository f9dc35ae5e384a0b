"""What the operation of a plate does at its amplifiers: arm, disarm, stop, clear and read back.

The outcome of each action is the next event; a lost link is one wherever it shows.
"""

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable, Mapping, Sequence
from functools import partial
from typing import Literal

from controller.daemon.deferred_calls import call_guarded
from controller.daemon.operation import Operation, StateObserver
from controller.daemon.read_back import READ_BACK_INTERVAL, find_problem, is_any_armed
from controller.daemon.states import ACKNOWLEDGE, Action, DaemonEvent, DaemonState, Trigger
from controller.loop.loop import Controller
from drivers.errors import CommandRefused, DriverError, LinkDegraded, LinkError, Preempted
from drivers.host.stop import Stopped

_MAX_READ_BACKS = 15
_WATCHDOG_MARGIN = 0.1  # s; of an amplifier that another host may have armed
SEARCHING = "check cables and supply; the daemon reconnects by itself and stays disarmed"

LinkChange = Literal["degraded", "restored", "lost", "retry", "reopened"]

_rate_limited_logger = logging.getLogger(f"{__name__}.background")


class PlateActions(Operation):
    """The operation of the plate with its actions, carried out by a controller once it runs.

    link_changed receives the kind of change, the lost amplifiers ("lost" only) and a message.
    """

    def __init__(
        self,
        *,
        state_changed: Sequence[StateObserver],
        link_changed: Callable[[LinkChange, Sequence[str], str], None],
    ) -> None:
        super().__init__(state_changed)
        self._link_observer = link_changed
        self._controller_if_running: Controller | None = None
        self._loss_lock = asyncio.Lock()  # held until the lost amplifiers are closed
        self._clears: list[int] = []  # epochs of those in progress

    def stop(self, cause: str, remedy: str | None = None) -> Awaitable[Mapping[str, Stopped]]:
        """Quick-stop all amplifiers in any state; await the outcome of each, by name.

        The requests to the amplifiers are queued when this returns.
        """
        stopping = self._spawn(self._stopped(self._controller.stop()))
        self._step(DaemonEvent(Trigger.STOP, cause, remedy))
        return asyncio.shield(stopping)

    def assume_energised(self, now: float) -> bool:
        """Whether a lost amplifier may still be playing at a time [s].

        Over a network for longer: there a request without reply may arrive late, and feed its
        watchdog.
        """
        lost = self.machine.lost
        return lost is not None and now < max(lost.energised_until, self._may_play_until)

    @property
    def _controller(self) -> Controller:
        if self._controller_if_running is None:
            raise RuntimeError("supervisor is not running")
        return self._controller_if_running

    @property
    def _may_play_until(self) -> float:
        """When [s] the watchdog must have silenced each amplifier as identified last."""
        known = self._controller.amplifiers.values()
        return max((each.feeding.may_play_until for each in known), default=-math.inf)

    def _energised_until(self, now: float) -> float:
        """When [s] amplifiers that are lost now must be silent; one never seen may be armed."""
        if self._controller.amplifiers:
            return self._may_play_until
        return now + self._controller.watchdog + _WATCHDOG_MARGIN

    def _link_changed(self, change: LinkChange, lost: Sequence[str], message: str) -> None:
        report = partial(self._link_observer, change, lost, message)
        call_guarded(partial(self._reports.add, report))

    async def _do(self, action: Action, epoch: int) -> None:
        match action:
            case Action.VERIFY:
                await self._over_link(self._verify(epoch), epoch)
            case Action.ARM:
                await self._over_link(self._arm(), epoch)
            case Action.DISARM:
                await self._over_link(self._controller.disarm(), epoch)
            case Action.STOP:
                await self._stop()
            case Action.REACT:
                await self._stop()
                cause, remedy = self.machine.cause, self.machine.remedy
                await self.handle(DaemonEvent(Trigger.REACTION_DONE, cause, remedy))
            case Action.CLEAR:
                await self._over_link(self._clear(epoch), epoch)
            case Action.RECONNECT:
                await self._controller.release()
                self._changed.set()
            case Action.CLOSE:
                await self._controller.close()

    async def _over_link(self, work: Awaitable[object], epoch: int) -> None:
        """Await work that needs the link; a loss or refusal becomes an event, then is raised.

        Not where it is explained: by what has raised the epoch since, or by a stop that goes on.
        """
        try:
            await work
        except LinkError as error:
            if isinstance(error, LinkDegraded) and self.machine.state is DaemonState.SWITCHED_ON:
                await self.handle(DaemonEvent(Trigger.DISARM, "an amplifier did not reply to arm"))
            else:
                await self._handle_loss(error)
            raise
        except DriverError as error:
            is_stopping = isinstance(error, Preempted) and self.machine.is_latched
            if epoch == self.machine.epoch and not is_stopping:
                await self.handle(DaemonEvent(Trigger.FAULT, str(error), ACKNOWLEDGE))
            raise

    async def _stopped(self, stopping: Awaitable[Mapping[str, Stopped]]) -> Mapping[str, Stopped]:
        """Await a stop of all amplifiers; one that is lost is a lost link."""
        outcomes = await stopping
        try:
            await self._check_links()
        except Exception:
            _rate_limited_logger.exception("handling of a lost link failed")
        return outcomes

    async def _stop(self) -> None:
        await self._stopped(self._controller.stop())

    @property
    def _is_loss_handled(self) -> bool:
        """Whether amplifiers are lost or closed already."""
        return self.machine.state in (DaemonState.COMM_LOST, DaemonState.NOT_READY)

    async def _check_links(self) -> None:
        """Handle the loss of an amplifier unless it is handled already."""
        causes = self._controller.group.lost_by.values()
        if causes and not self._is_loss_handled:
            await self._handle_loss(LinkError(next(iter(causes))))

    async def _arm(self) -> None:
        await self._controller.arm()
        await self.handle(DaemonEvent(Trigger.ARMED, self.machine.cause))

    async def _verify(self, epoch: int) -> None:
        """Disarm what still plays, then read back all amplifiers."""
        is_armed = is_any_armed(await self._controller.group.statuses())
        if is_armed and epoch == self.machine.epoch:
            await self._controller.disarm()
        problem = await self._read_back(epoch)
        if epoch != self.machine.epoch:
            return  # stopped, or verified and armed, in the meantime
        if problem is None:
            cause = "all amplifiers are disarmed, at level zero and without a fault"
            await self.handle(DaemonEvent(Trigger.VERIFIED, cause))
        else:
            await self.handle(DaemonEvent(Trigger.FAULT, problem, ACKNOWLEDGE))

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
        await self.handle(DaemonEvent(Trigger.FAULT, problem, ACKNOWLEDGE))
        raise CommandRefused(f"{problem}; the cause persists, so nothing was cleared")

    def _check_none_since(self, epoch: int) -> None:
        """Raise Preempted if a stop, fault or other clear came after an acknowledgement."""
        if epoch != self.machine.epoch:
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
                await self._controller.clear()
            group = self._controller.group
            problem = find_problem(await group.statuses(), group.amplifiers)
            if problem is None or epoch != self.machine.epoch:
                break
            await asyncio.sleep(READ_BACK_INTERVAL)
        return problem

    async def _handle_loss(self, error: LinkError) -> None:
        """Handle a loss; concurrent reports of the same loss wait until it is handled."""
        async with self._loss_lock:
            group = self._controller.group
            lost = [name for name in group.amplifiers if name in (*group.lost_by, *group.degraded)]
            text = str(error)
            if self.machine.state is not DaemonState.COMM_LOST:
                self._link_changed("lost", lost, text)
            cause = f"amplifier {', '.join(lost)}: {text}" if lost else text
            await self.handle(DaemonEvent(Trigger.LINK_LOST, cause, SEARCHING))
