"""API methods, implemented by the daemon."""

import asyncio
import itertools
import logging
import math
import secrets
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from functools import partial

from controller.api.jsonrpc import ErrorCode, NotSilent, RpcError
from controller.api.methods import (
    METHODS,
    ArmParams,
    ArmResult,
    ClearParams,
    DisarmParams,
    EffectsResult,
    HelloParams,
    HelloResult,
    LayoutParams,
    LayoutResult,
    PlayParams,
    PlayResult,
    ReloadResult,
    RenewParams,
    RenewResult,
    RequestedBy,
    StatusResult,
    StopResult,
    StrengthParams,
    StrengthResult,
    SubscribeParams,
    TouchParams,
    UnsubscribeParams,
)
from controller.api.schema import AmplifierSilence, Empty, TouchPoint, headline
from controller.api.server import Connection, Handler
from controller.daemon.config import API_SOURCES, DaemonConfig
from controller.daemon.layouts import LayoutChoice
from controller.daemon.messages import EventPublisher, effects_result, hello_result
from controller.daemon.plate_view import playing_of
from controller.daemon.play_outcomes import PlayOutcomes
from controller.daemon.requested_effect import requested_effect
from controller.effects.effect import Effect
from controller.operation.operation_states import (
    ENERGISED,
    DaemonEvent,
    DaemonState,
    Lease,
    Operation,
    Trigger,
)
from controller.operation.plate_controller import Controller
from controller.operation.supervisor import LEASE_OVER, Supervisor
from controller.sources.touch import Contact, Touch, TouchFrame
from drivers.by_hand.rows import silence_rows
from drivers.host.stops import StopOutcome
from model.compiled.kernels import why_slow
from model.structure.plate import Plate
from model.table.table import LocalizationTable
from registry import threads
from registry.plugins import did_you_mean
from registry.threads import in_thread

_logger = logging.getLogger(__name__)

PLAY_RADIUS = 0.020
"""Largest distance [m] from the position of a requested effect to the finger that feels it."""

_SAVE_TIMEOUT = 0.2  # s; for a pending write when the daemon ends

_ENABLED = DaemonState.OPERATION_ENABLED


class ApiService:
    """Handles requests of clients. Arming takes a lease; every client can disarm and stop."""

    def __init__(
        self,
        config: DaemonConfig,
        table: LocalizationTable,
        controller: Controller,
        supervisor: Supervisor,
        *,
        publisher: EventPublisher,
        layouts: LayoutChoice,
        reload: Callable[[], Awaitable[ReloadResult]],
    ) -> None:
        self._config = config
        self._table = table
        self._controller = controller
        self._supervisor = supervisor
        self._publisher = publisher
        self._layouts = layouts
        self._reload = reload
        self._next_number = itertools.count(1)
        self._started = threads.now()
        self._clients = set[Connection]()  # connected, and introduced or have touched
        self._numbers: dict[Connection, int] = {}  # of the clients that have touched
        self._lease_tokens: dict[Connection, str] = {}  # last lease that each armed or renewed
        self._strengths = layouts.player.strengths
        self._saving: asyncio.Task[None] | None = None
        self._save_problem = ""  # error of the last attempt
        self._outcomes = PlayOutcomes(supervisor, layouts.player, publisher.view)
        self._preparing = asyncio.Lock()  # held while an effect that a client plays is prepared

    def handlers(self) -> Mapping[str, Handler]:
        """Handlers by method name."""
        return {name: getattr(self, name) for name in METHODS}

    def client_left(self, client: Connection) -> None:
        """Forget a disconnected client and lift its fingers; its lease runs until it expires."""
        self._publisher.hub.forget(client)
        if client in self._numbers:
            self._controller.cycle.lift(f"{self._origin(client)}:")
        self._numbers.pop(client, None)
        self._lease_tokens.pop(client, None)
        self._clients.discard(client)
        self._clients_changed()

    def _clients_changed(self) -> None:
        """Pass the names of all clients to the strengths, which the control loop reads."""
        self._strengths.clients = [(self._origin(client), client.name) for client in self._clients]

    def _origin(self, client: Connection) -> str:
        """Return the origin of a client's touches: the prefix of its source names."""
        return f"{API_SOURCES}:{self._numbers.get(client)}"

    def holds_lease(self, client: Connection) -> bool:
        """Whether a client armed or renewed the current lease: it is never evicted."""
        lease = self._supervisor.operation.lease_at(threads.now())
        return lease is not None and self._lease_tokens.get(client) == lease.token

    def hello(self, client: Connection, params: HelloParams) -> HelloResult:
        """Introduce the client; returns the daemon's rig, table and layout."""
        client.name = params.client
        self._clients.add(client)
        self._clients_changed()
        if self._strengths.gains_db:  # fingers of this client may be resting
            self._controller.cycle.request_update()
        return hello_result(
            self._config,
            self._table,
            self._controller.amplifiers,
            drive_mode=self._controller.drive_mode,
            layout=self._layouts.event().layout,
        )

    def status(self, client: Connection, params: Empty) -> StatusResult:
        """Show the state of the daemon, the amplifiers and the contacts."""
        now = threads.now()
        operation = self._supervisor.operation
        lease = operation.lease_at(now)
        view = self._publisher.view
        is_enabled = operation.state is _ENABLED
        cycle = self._controller.cycle
        return StatusResult(
            time_s=now,
            unix_time_s=time.time(),
            state=operation.state.value,
            cause=operation.cause,
            remedy=operation.remedy,
            epoch=operation.epoch,
            assume_energised=self._supervisor.reopening.assume_energised(now),
            lost_for_s=None if operation.lost is None else now - operation.lost.at,
            watchdog_s=self._controller.watchdog,
            armed_by=lease.owner if lease else None,
            lease_left_s=lease.expires_at - now if lease else None,
            contacts=view.statuses_now(self._controller.table),
            silence_reason=view.silence_reason if is_enabled else None,
            **playing_of(view.applied if is_enabled else None),
            amplifiers=self._publisher.amplifiers(),
            latency_ms=self._publisher.latencies.summary(),
            lift_latency_ms=self._publisher.lift_latencies.summary(),
            lost_events=dict(self._publisher.hub.lost),
            rejected_touches=dict(cycle.rejects.counts),
            rejected_examples=dict(cycle.rejects.examples),
            inputs=self._publisher.inputs().inputs,
            clicks_too_late=cycle.clicks_too_late,
            layout=self._layouts.name,
            layouts=self._layouts.names,
            strengths=self._publisher.strengths().strengths,
            slow_reason=why_slow(),
            threshold=self._config.rig.threshold,
            uptime_s=now - self._started,
        )

    async def arm(self, client: Connection, params: ArmParams) -> ArmResult:
        """Switch the high voltage on. Touches are felt until the lease expires."""
        if self._supervisor.operation.is_lease_over(threads.now()):  # current playback ends
            await self._supervisor.handle(LEASE_OVER)
        lease = Lease(params.owner, params.lease_s)
        cause = f"armed by {params.owner!a}"
        try:
            await self._supervisor.handle(
                DaemonEvent(Trigger.ARM, cause, "era disarm, or era stop", lease)
            )
            operation = self._supervisor.operation
            is_own = operation.lease is not None and operation.lease.token == lease.token
            if operation.state in ENERGISED and not is_own:
                raise _armed_already(operation)
            if operation.state is not _ENABLED:
                raise _wrong_state(operation)
        except BaseException:
            self._supervisor.withdraw(lease.token, "arming failed")
            raise
        self._lease_tokens[client] = lease.token
        # After the reply was sent, or could not be sent.
        asyncio.get_running_loop().call_soon(self._check_holder, client, lease.token)
        return ArmResult(lease=lease.token, lease_s=lease.duration)

    def renew(self, client: Connection, params: RenewParams) -> RenewResult:
        """Extend the lease."""
        lease = check_lease(self._supervisor.operation.lease, params.lease, threads.now())
        self._supervisor.renew(lease)
        self._lease_tokens[client] = lease.token
        return RenewResult(lease_s=lease.duration)

    async def disarm(self, client: Connection, params: DisarmParams) -> Empty:
        """Ramp to silence, then switch the high voltage off.

        Any client can disarm. While a link is lost, this stops all amplifiers.
        """
        if params.lease is not None:
            check_lease(self._supervisor.operation.lease, params.lease, threads.now())
        if self._supervisor.operation.state is DaemonState.COMM_LOST:  # only a stop is possible
            await self.stop(client, params)
        cause = f"disarmed by {params.client or client.name!a}"
        await self._supervisor.handle(DaemonEvent(Trigger.DISARM, cause))
        operation = self._supervisor.operation
        if operation.state is not DaemonState.READY_TO_SWITCH_ON:  # disarmed and read back
            raise _wrong_state(operation)
        return Empty()

    def stop(self, client: Connection, params: RequestedBy) -> Awaitable[StopResult]:
        """Quick-stop all amplifiers. The stop is latched until `clear`.

        Not an emergency stop. Every client can stop the plate at any time. Fails with error 1006 if
        an amplifier is not confirmed silent.
        """
        # The requests to the amplifiers are queued when this returns.
        cause = f"stopped by {params.client or client.name!a}"
        stopping = self._supervisor.stop(cause, "clear (era clear), then arm again")
        return _silence(stopping, self._supervisor.operation.epoch)

    async def clear(self, client: Connection, params: ClearParams) -> Empty:
        """Clear a stop, or a fault that no longer exists. The plate stays disarmed."""
        operation = self._supervisor.operation
        if operation.state is DaemonState.COMM_LOST:
            raise _wrong_state(operation, ErrorCode.LINK)
        if operation.state in (DaemonState.QUICK_STOP_ACTIVE, DaemonState.FAULT):
            if params.epoch not in (None, operation.epoch):
                raise RpcError(
                    ErrorCode.WRONG_STATE,
                    f"epoch must be the current one, {operation.epoch}, got "
                    f"{params.epoch}: there was another stop, fault or loss since",
                    where="epoch",
                    remedy="check the status, then clear again",
                )
            cause = f"acknowledged by {params.client or client.name!a}"
            await self._supervisor.handle(DaemonEvent(Trigger.CLEAR, cause))
            operation = self._supervisor.operation
        if operation.state is not DaemonState.READY_TO_SWITCH_ON:
            raise _wrong_state(operation)
        return Empty()

    def touch(self, client: Connection, params: TouchParams) -> Empty:
        """Report all fingers of a touch source."""
        if client not in self._numbers:
            self._numbers[client] = next(self._next_number)
            self._clients.add(client)
            self._clients_changed()
        touches = [_touch_at(point, self._config.rig.plate) for point in params.touches]
        # Two clients with the same source name are two sources.
        origin = self._origin(client)
        source = f"{origin}:{params.source}"
        frame = TouchFrame(source, client.received_at, tuple(touches), origin=origin)
        self._controller.cycle.deliver(frame)
        return Empty()

    def layout(self, client: Connection, params: LayoutParams) -> LayoutResult:
        """Switch to another of the daemon's layouts.

        Continuous effects under resting fingers change immediately. Effects of limited duration,
        and effects that a program plays, continue to their end.
        """
        self._layouts.use(params.name)
        return LayoutResult(layout=params.name, layouts=self._layouts.names)

    def reload(self, client: Connection, params: Empty) -> Awaitable[ReloadResult]:
        """Read the daemon's files again and apply their layouts.

        All other changes are rejected; they need a restart.
        """
        return self._reload()

    def effects(self, client: Connection, params: Empty) -> EffectsResult:
        """List the available effects."""
        return effects_result(self._layouts.player.layout)

    async def play(self, client: Connection, params: PlayParams) -> PlayResult:
        """Play an effect, or points and taps, at a finger; only while armed.

        Returns the outcome: when it starts and at which level, or why it is not played.
        """
        # At the contact nearest to the position, at most at the effect's own level.
        requested = requested_effect(params, self._layouts.player.layout)
        effect = requested.effect
        level = params.level_db_sl
        if level is not None:
            requested.check_level(level, is_named=params.effect is not None)
        contact = self._nearest(params)
        played_level = effect.level_db_sl if level is None else level
        if not effect.is_prepared(played_level):
            epoch = self._supervisor.operation.epoch
            effect = await self._prepared(effect, level)
            contact = self._nearest(params)
            if self._supervisor.operation.epoch != epoch:
                raise RpcError(
                    ErrorCode.WRONG_STATE, "stopped or disarmed meanwhile", remedy="play it again"
                )
        play = self._layouts.player.play(
            requested.name,
            contact,
            threads.now(),
            level_db_sl=level,
            player=client.name,
            effect=effect,
        )
        self._controller.cycle.request_update()
        return await self._outcomes.wait_for(play, contact)

    async def _prepared(self, effect: Effect, level: float | None) -> Effect:
        """Return a copy of an effect, rendered in a thread for a level [dB SL] or its own."""
        rendered = effect.for_table(self._table.frequencies)  # a copy with its own renditions
        rendered_level = rendered.level_db_sl if level is None else level
        async with self._preparing:
            await in_thread(partial(rendered.prepare, rendered_level), name="content")
        return rendered

    def _nearest(self, params: PlayParams) -> Contact:
        """Return the contact to play at; raises RpcError without one, or if disarmed."""
        operation = self._supervisor.operation
        if operation.state is not _ENABLED or self._controller.group.members.degraded:
            raise _wrong_state(operation)

        def distance(contact: Contact) -> float:
            return math.dist((contact.x, contact.y), (params.x_m, params.y_m))

        def precedence(contact: Contact) -> tuple[bool, float]:
            return bool(contact.why_load_alone), distance(contact)

        contacts = self._publisher.view.contacts
        candidates = [contact for contact in contacts if distance(contact) <= PLAY_RADIUS]
        nearest = min(candidates, key=precedence, default=None)
        if nearest is None:
            raise RpcError(
                ErrorCode.REFUSED,
                f"no finger within {1e3 * PLAY_RADIUS:g} mm of ({params.x_m:g}, {params.y_m:g}) m",
                where="x_m",
                remedy="touch the plate there, or send a touch over the API",
            )
        if nearest.why_load_alone:
            raise RpcError(ErrorCode.REFUSED, nearest.why_load_alone, where="x_m")
        return nearest

    def strength(self, client: Connection, params: StrengthParams) -> StrengthResult:
        """Set or show the strength of a source, client or region.

        The status shows all strengths. Active effects fade to the new strength within 100 ms.
        """
        name = params.name
        names = [*self._publisher.strengths().strengths]
        if name not in names:
            raise RpcError(
                ErrorCode.REFUSED,
                f"name must be a touch source, client or region, got {name!a}",
                where="name",
                remedy=f"{did_you_mean(name, names)}choose one of {', '.join(names) or 'none'}",
            )
        if params.gain_db is not None:
            self._strengths.set(name, params.gain_db)
            self._controller.cycle.request_update()
            if self._saving is None or self._saving.done():
                self._saving = asyncio.create_task(self._save_strengths(), name="strengths")
        return StrengthResult(strengths={name: self._strengths.gains_db.get(name, 0.0)})

    async def _save_strengths(self) -> None:
        """Save the strengths; no request waits for the disk."""
        file = self._config.strengths
        saved_gains: Mapping[str, float] | None = None
        while file is not None and saved_gains is not self._strengths.gains_db:
            saved_gains = self._strengths.gains_db
            try:
                await asyncio.to_thread(self._strengths.save, file)
            except (OSError, RuntimeError) as error:  # no thread available
                if self._save_problem != str(error):  # log it once
                    _logger.error("strengths: not saved: %s", error)
                self._save_problem = str(error)
            else:
                self._save_problem = ""

    async def close(self) -> None:
        """Wait until the strengths are saved, at most 0.2 s."""
        if self._saving is not None:
            with suppress(TimeoutError):
                await asyncio.wait_for(self._saving, _SAVE_TIMEOUT)

    def subscribe(self, client: Connection, params: SubscribeParams) -> Empty:
        """Subscribe to notifications of topics."""
        # After the reply, so that no event precedes it.
        asyncio.get_running_loop().call_soon(self._subscribe_now, client, params)
        return Empty()

    def _subscribe_now(self, client: Connection, params: SubscribeParams) -> None:
        if client.is_open:
            self._publisher.hub.subscribe(client, params.topics, rate=params.rate_hz)

    def unsubscribe(self, client: Connection, params: UnsubscribeParams) -> Empty:
        """Unsubscribe from notifications of topics."""
        self._publisher.hub.unsubscribe(client, params.topics)
        return Empty()

    def _check_holder(self, client: Connection, token: str) -> None:
        """Disarm if the client disconnected before it received its lease."""
        if client.has_left:
            self._lease_tokens.pop(client, None)
            self._supervisor.withdraw(token, "the arming client disconnected")


def _touch_at(point: TouchPoint, plate: Plate) -> Touch:
    """Return a touch of a client in the coordinates of touch frames: 0 to 1, down from the top."""
    size: tuple[float, float] | None = None
    if point.radius_m is not None:
        diameter = 2 * point.radius_m
        size = (diameter / plate.length, diameter / plate.width)
    return Touch(point.id, point.x_m / plate.length, 1 - point.y_m / plate.width, size=size)


def check_lease(lease: Lease | None, token: str, now: float) -> Lease:
    """Return the lease; raises RpcError if it has expired, or has another token."""
    if lease is None or now >= lease.expires_at:
        raise RpcError(ErrorCode.LEASE, "lease has expired", remedy="arm again")
    if not secrets.compare_digest(lease.token.encode(), token.encode()):
        raise RpcError(
            ErrorCode.LEASE,
            f"lease belongs to {lease.owner!a}",
            remedy="wait until it expires, or disarm first (any client can disarm)",
        )
    return lease


def _armed_already(operation: Operation) -> RpcError:
    """Return the error for arming while another client has armed, or is arming."""
    lease = operation.lease
    problem = "another client is arming"
    if operation.state is _ENABLED and lease is not None:
        remaining = lease.expires_at - threads.now()
        problem = f"armed by {lease.owner!a} for {remaining:.1f} s more"
    remedy = "wait, or disarm first (any client can disarm)"
    return RpcError(ErrorCode.LEASE, problem, remedy=remedy)


async def _silence(stopping: Awaitable[Mapping[str, StopOutcome]], epoch: int) -> StopResult:
    """Await a stop of an epoch; raises NotSilent unless every amplifier is confirmed silent."""
    outcomes = await stopping
    now = threads.now()
    amplifiers = {}
    is_silent = len(outcomes) > 0
    for name, outcome in outcomes.items():
        amplifiers[name] = AmplifierSilence(**silence_rows(outcome, now))
        is_silent = is_silent and outcome.is_confirmed
    if not is_silent:
        raise NotSilent(amplifiers)
    return StopResult(epoch=epoch, amplifiers=amplifiers)


def _wrong_state(operation: Operation, code: ErrorCode = ErrorCode.WRONG_STATE) -> RpcError:
    return RpcError(
        code,
        headline(operation.state.value, operation.cause),
        where="state",
        remedy=operation.next_step,
    )
