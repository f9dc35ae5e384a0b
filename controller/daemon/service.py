"""The methods of the API, as the daemon carries them out."""

import asyncio
import time
from collections.abc import Mapping

from controller.api.connection import Connection
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.methods import (
    ArmParams,
    ArmResult,
    HelloParams,
    HelloResult,
    PlayParams,
    RenewParams,
    RenewResult,
    StatusResult,
    SubscribeParams,
    TouchParams,
    UnsubscribeParams,
)
from controller.api.schema import (
    Empty,
    PhaseName,
)
from controller.api.server import Handler
from controller.daemon.config import DaemonConfig
from controller.daemon.inputs import ApiTouches
from controller.daemon.introduction import introduction
from controller.daemon.lease import LeaseBook
from controller.daemon.meaning import Meaning
from controller.daemon.news import News
from controller.daemon.states import Event, Kind, Machine, State
from controller.daemon.supervisor import Supervisor
from controller.loop.loop import Controller
from drivers import clock
from drivers.amplifier import WATCHDOG, Amplifier
from model.table.table import LocalizationTable

_ARMABLE = (State.SWITCHED_ON, State.OPERATION_ENABLED)
_NEXT = {
    State.SWITCH_ON_DISABLED: "wait a moment and ask again",
    State.READY_TO_SWITCH_ON: "arm first (era arm)",
}
"""What to do in states that need no remedy, for whoever asks for more than they allow."""


class Service:
    """Answers clients. Whoever arms has a lease; disarm and stop are anybody's.

    Everything that it is made of is run by others; it starts only the timer of the lease.
    """

    def __init__(
        self,
        config: DaemonConfig,
        table: LocalizationTable,
        controller: Controller,
        supervisor: Supervisor,
        *,
        amplifiers: Mapping[str, Amplifier],
        news: News,
        touches: ApiTouches,
        meaning: Meaning,
    ) -> None:
        self.longest_lease = config.section.longest_lease
        self._config = config
        self._table = table
        self._controller = controller
        self._supervisor = supervisor
        self._amplifiers = amplifiers
        self._news = news
        self._touches = touches
        self._meaning = meaning
        self._lease = LeaseBook()
        self._expiry: asyncio.TimerHandle | None = None
        self._numbers: dict[Connection, int] = {}
        self._clients = 0
        self._begun = clock.now()

    def handlers(self) -> Mapping[str, Handler]:
        """By method."""
        return {
            "hello": self._hello,
            "status": lambda client, params: self.status(),
            "arm": self._arm,
            "renew": self._renew,
            "disarm": lambda client, params: self._disarm(client),
            "stop": lambda client, params: self._stop(client),
            "clear": lambda client, params: self._clear(client),
            "touch": self._touch,
            "effects": lambda client, params: self._meaning.effects(),
            "play": self._play,
            "subscribe": self._subscribe,
            "unsubscribe": self._unsubscribe,
        }

    def state_changed(self, new: Machine) -> None:
        """Whatever ends the armed state ends the lease with it."""
        if new.state not in _ARMABLE:
            self._lease.end()
            self._news.scene.ended()

    def left(self, client: Connection) -> None:
        """A client is gone: its fingers are lifted."""
        self._news.hub.forget(client)
        self._numbers.pop(client, None)
        self._touches.leave(client, now=clock.now())

    def keeps(self, client: Connection) -> bool:
        """Whether a client must not give way to another: it listens to something."""
        return self._news.hub.is_subscribed(client)

    def status(self) -> StatusResult:
        """How everything is."""
        machine, scene, now = self._supervisor.machine, self._news.scene, clock.now()
        held = self._lease.held(now)
        pattern = scene.pattern_event()
        return StatusResult(
            time_s=now,
            unix_time_s=time.time(),
            state=machine.state.value,
            cause=machine.cause,
            remedy=machine.remedy,
            phase=_phase(self._controller),
            assume_energised=machine.assume_energised(now),
            lost_for_s=machine.lost_for(now),
            watchdog_s=WATCHDOG,
            armed_by=held.owner if held else None,
            lease_left_s=held.ends - now if held else None,
            contacts=scene.contact_statuses(),
            drive=scene.drive(),
            silent_because=scene.silent_because if held else None,
            plain_because=self._controller.plain_because,
            predicted_contrast_db=pattern.predicted_contrast_db if pattern else None,
            robust_contrast_db=pattern.robust_contrast_db if pattern else None,
            predicted_level_db_sl=pattern.predicted_level_db_sl if pattern else None,
            amplifiers=self._news.amplifiers(),
            latency_ms=self._news.latencies.summary(),
            rejected_touches=dict(self._controller.rejected_touches),
            uptime_s=now - self._begun,
        )

    def _hello(self, client: Connection, params: HelloParams) -> HelloResult:
        client.name = params.client
        return introduction(
            self._config,
            self._table,
            self._amplifiers,
            drive_mode=self._controller.capabilities.drive_mode,
            layout=self._news.layout_event().layout,
        )

    async def _arm(self, client: Connection, params: ArmParams) -> ArmResult:
        machine, now = self._supervisor.machine, clock.now()
        if machine.state not in (State.READY_TO_SWITCH_ON, *_ARMABLE):
            raise _wrong_state(machine)
        if machine.state is State.SWITCHED_ON:
            raise RpcError(ErrorCode.LEASE, "somebody else is arming", remedy="wait, or disarm")
        lasts = min(params.lease_s, self.longest_lease)
        lease = self._lease.grant(params.owner, lasts=lasts, now=now)
        try:
            await self._supervisor.handle(
                Event(Kind.ARM, f"armed by {params.owner!a}", "era disarm, or era stop")
            )
        except BaseException:
            self._end_lease(lease.token)
            raise
        if self._supervisor.machine.state is not State.OPERATION_ENABLED:
            self._end_lease(lease.token)
            raise _wrong_state(self._supervisor.machine)
        # Arming took a moment, longer perhaps than the lease: that counts from when it was done.
        lease = self._lease.begin(lease.token, now=clock.now())
        self._watch_lease()
        # Once the answer has gone out, or could not.
        asyncio.get_running_loop().call_soon(self._look_at_holder, client, lease.token)
        return ArmResult(lease=lease.token, lease_s=lease.lasts)

    def _renew(self, client: Connection, params: RenewParams) -> RenewResult:
        lease = self._lease.renew(params.lease, now=clock.now())
        self._watch_lease()
        return RenewResult(lease_s=lease.lasts)

    async def _disarm(self, client: Connection) -> Empty:
        await self._supervisor.handle(Event(Kind.DISARM, f"disarmed by {client.name!a}"))
        return Empty()

    async def _stop(self, client: Connection) -> Empty:
        await self._supervisor.handle(
            Event(Kind.STOP, f"stopped by {client.name!a}", "clear (era clear), then arm again")
        )
        return Empty()

    async def _clear(self, client: Connection) -> Empty:
        machine = self._supervisor.machine
        if machine.state is State.COMM_LOST:
            raise _wrong_state(machine, ErrorCode.LINK)
        await self._supervisor.handle(Event(Kind.CLEAR, f"acknowledged by {client.name!a}"))
        return Empty()

    def _touch(self, client: Connection, params: TouchParams) -> Empty:
        if client not in self._numbers:
            self._clients += 1
            self._numbers[client] = self._clients
        self._touches.take(
            client, params, client_name=str(self._numbers[client]), now=client.heard_at
        )
        return Empty()

    def _play(self, client: Connection, params: PlayParams) -> Empty:
        machine = self._supervisor.machine
        if machine.state is not State.OPERATION_ENABLED:
            raise _wrong_state(machine)
        self._meaning.play(params, self._news.scene.contacts, now=clock.now())
        self._controller.reconsider()
        return Empty()

    def _subscribe(self, client: Connection, params: SubscribeParams) -> Empty:
        # After the answer, so that nothing comes before it is known to have worked.
        asyncio.get_running_loop().call_soon(self._subscribe_now, client, params)
        return Empty()

    def _subscribe_now(self, client: Connection, params: SubscribeParams) -> None:
        if client.is_open:
            self._news.hub.subscribe(client, params.topics, rate=params.rate_hz)

    def _unsubscribe(self, client: Connection, params: UnsubscribeParams) -> Empty:
        self._news.hub.unsubscribe(client, params.topics)
        return Empty()

    def _end_lease(self, token: str) -> None:
        """End a lease, unless another has taken its place."""
        held = self._lease.held(clock.now())
        if held is not None and held.token == token:
            self._lease.end()

    def _watch_lease(self) -> None:
        """Look again when the lease is over."""
        if self._expiry is not None:
            self._expiry.cancel()
        ends = self._lease.ends
        if ends is not None:
            self._expiry = asyncio.get_running_loop().call_later(
                max(0.0, ends - clock.now()), self._look_at_lease
            )

    def _look_at_holder(self, client: Connection, token: str) -> None:
        """Disarm where nobody knows the lease that runs: whoever armed was gone by then."""
        held = self._lease.held(clock.now())
        if held is not None and held.token == token and not client.is_open:
            self._supervisor.tell(
                Event(Kind.LEASE_LOST, "whoever armed has hung up meanwhile", "arm again")
            )

    def _look_at_lease(self) -> None:
        self._expiry = None
        if self._lease.ends is None:
            return
        if self._lease.held(clock.now()) is not None:
            self._watch_lease()
            return
        self._supervisor.tell(
            Event(Kind.LEASE_LOST, "whoever armed has not renewed the lease", "arm again")
        )


def _wrong_state(machine: Machine, code: ErrorCode = ErrorCode.WRONG_STATE) -> RpcError:
    return RpcError(
        code,
        f"the daemon is in {machine.state.value}: {machine.cause}",
        where="state",
        remedy=machine.remedy or _NEXT.get(machine.state),
    )


def _phase(controller: Controller) -> PhaseName:
    names: dict[str, PhaseName] = {
        "CLOSED": "closed",
        "DISARMED": "disarmed",
        "ARMED": "armed",
        "LOST": "lost",
    }
    return names[controller.phase.name]
