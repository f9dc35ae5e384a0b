"""An amplifier: arm, play, stop, whatever its wire."""

from collections.abc import Callable
from typing import final

from drivers.backend import Backend
from drivers.errors import CommandError, FrameError, LinkError
from drivers.guard import SafeCommandSet, SafeEnvelope
from drivers.link.link import REPLY_TIMEOUT, Link
from drivers.link.refusals import PROTOCOL_VIOLATION
from drivers.link.turns import RequestPriority
from drivers.protocol.definition import PROTOCOL, token_after
from drivers.protocol.messages import (
    Achieved,
    AmplifierEvent,
    Apply,
    Arm,
    Capabilities,
    Clear,
    Commit,
    Disarm,
    FaultList,
    FaultRecord,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    Identity,
    Loaded,
    LoadEnvelope,
    Ping,
    Stage,
    Status,
    Stop,
)
from drivers.protocol.wire_times import WireTimes
from drivers.statistics import LinkStatistics

WATCHDOG = 0.25  # s; five heartbeats of 50 ms
OPEN_TIMEOUT = 0.5  # s; for boards that restart when their port is opened
DISARM_RAMP = 0.05  # s; long enough to avoid a click
STOP_RAMP = 0.005  # s; the shortest without a step


@final
class Amplifier:
    """One amplifier over one backend, with at most one request on the wire at a time.

    Requests without a reply, or to a busy amplifier, are repeated up to twice (see `Link`), which
    tokens make safe. After a LinkError it is lost until it is closed and reopened: every other call
    raises LinkError at once, and nothing re-arms.
    reply_timeout [s]: of one exchange; serial_number: the expected one, which opening enforces;
    None: that of the first opening.
    """

    def __init__(
        self,
        backend: Backend,
        *,
        reply_timeout: float = REPLY_TIMEOUT,
        serial_number: str | None = None,
    ) -> None:
        self._link = Link(backend, reply_timeout=reply_timeout, on_event=self._notify)
        self._serial_number = serial_number
        self._listeners: list[Callable[[AmplifierEvent], None]] = []
        self._token = 0
        self._identity: Identity | None = None
        self._capabilities: Capabilities | None = None

    @property
    def identity(self) -> Identity:
        """Its identity; known once open."""
        if self._identity is None:
            raise CommandError("identity is known only after opening; call open() first")
        return self._identity

    @property
    def capabilities(self) -> Capabilities:
        """What it can play; known once open."""
        if self._capabilities is None:
            raise CommandError("capabilities are known only after opening; call open() first")
        return self._capabilities

    @property
    def last_sent(self) -> float:
        """Time [s] when the last byte of the last request went out, by the event loop's clock."""
        return self._link.backend.last_sent

    @property
    def is_lost(self) -> bool:
        """Whether every further call raises LinkError."""
        return self._link.is_lost

    @property
    def bus(self) -> str | None:
        """Identifier of what one broadcast reaches; None without broadcasts."""
        return self._link.backend.bus

    @property
    def statistics(self) -> LinkStatistics:
        """Link statistics; counted since opening or construction, see `LinkStatistics`."""
        return self._link.statistics

    @property
    def wire_times(self) -> WireTimes:
        """Durations on its wire."""
        return self._link.backend.wire_times

    def round_trip(self) -> float:
        """Wire time [s] of its longest exchange, an apply of all channels; 0 if unknown."""
        return self.wire_times.round_trip(self.capabilities.channels)

    def listen(self, on_event: Callable[[AmplifierEvent], None]) -> None:
        """Register a callback for unsolicited events, in the event loop; events may be lost."""
        self._listeners.append(on_event)

    def next_token(self) -> int:
        """Return a token for the next command set: 1..65535, then 1 again."""
        self._token = token_after(self._token)
        return self._token

    async def open(self) -> None:
        """Open the wire and read identity and capabilities; its state does not change."""
        await self._link.open()
        try:
            identity = await self._link.ask(Hello(), expect=Identity, timeout=OPEN_TIMEOUT)
            if identity.protocol_version != PROTOCOL.version:
                raise LinkError(
                    f"protocol version must be {PROTOCOL.version}, got {identity.protocol_version} "
                    f"from {identity.vendor} {identity.product} {identity.serial_number}; update "
                    "the older side"
                )
            if self._serial_number not in (None, identity.serial_number):
                raise LinkError(
                    f"serial number must be {self._serial_number}, got {identity.serial_number}; "
                    "connect the expected amplifier, or restart with this one"
                )
            self._capabilities = await self._link.ask(
                GetCaps(), expect=Capabilities, timeout=OPEN_TIMEOUT
            )
            self._identity = identity
            self._serial_number = identity.serial_number
            self._link.allow_for(self.round_trip())
        except BaseException:
            await self.close()
            raise

    async def close(self) -> None:
        """Close the wire; disarm before, or the vibration lasts until the watchdog trips."""
        await self._link.close()

    async def arm(self, watchdog: float = WATCHDOG) -> Status:
        """Switch the high voltage on and enable every channel at level zero; watchdog [s].

        Raises CommandError for a watchdog outside the amplifier's range, and CommandRefused if a
        stop or disarm came first.
        """
        low, high = self.capabilities.watchdog_min, self.capabilities.watchdog_max
        if not low <= watchdog <= high:
            raise CommandError(
                f"watchdog must be {low:g} to {high:g} s, as the amplifier reports, got "
                f"{watchdog:g} s"
            )
        return await self._link.ask(
            Arm(watchdog=watchdog), expect=Status, priority=RequestPriority.APPLY
        )

    async def disarm(self, ramp: float = DISARM_RAMP) -> Status:
        """Fall silent along a ramp [s], then switch the high voltage off; overtakes the queue."""
        return await self._link.ask(
            Disarm(ramp=self._ramp(ramp)), expect=Status, priority=RequestPriority.SILENCE
        )

    async def stop(self, ramp: float = STOP_RAMP) -> Status:
        """Quick stop along a ramp [s], latched until clear; overtakes the queue.

        Like disarm it is on the wire within 8 ms: a pending request is preempted and raises
        CommandRefused, or is repeated afterwards if it is of the stop class. A request that is not
        on the wire yet is preempted at once.
        """
        return await self._link.ask(
            Stop(ramp=self._ramp(ramp)), expect=Status, priority=RequestPriority.STOP
        )

    async def load_envelope(self, safe: SafeEnvelope) -> None:
        """Load an envelope into its slot, for later sets; at any time, armed or not.

        Raises CommandRefused if the amplifier does not support envelopes.
        """
        if type(safe) is not SafeEnvelope:
            raise TypeError(
                "envelope must be a SafeEnvelope made by Guard.check_envelope, got "
                f"{type(safe).__name__}"
            )
        loaded = await self._link.ask(LoadEnvelope(safe), expect=Loaded)
        if (loaded.slot, loaded.knots) != (safe.slot, len(safe.knots)):
            raise FrameError(
                f"the amplifier must load {len(safe.knots)} knots into slot {safe.slot}, got "
                f"{loaded.knots} in slot {loaded.slot}; {PROTOCOL_VIOLATION}"
            )

    async def stage(self, safe: SafeCommandSet) -> Achieved:
        """Keep a set ready under its token; returns what its commit would play.

        Raises CommandRefused if a newer set, a stop or a disarm came first.
        """
        request = Stage(_safe(safe))
        achieved = await self._link.ask(request, expect=Achieved, priority=RequestPriority.APPLY)
        return _of_token(achieved, safe.token)

    async def commit(self, token: int) -> Achieved:
        """Play the staged set of this token; idempotent.

        Raises CommandRefused if a newer set, a stop or a disarm came first.
        """
        achieved = await self._link.ask(
            Commit(token=token), expect=Achieved, priority=RequestPriority.APPLY
        )
        return _of_token(achieved, token)

    async def apply(self, safe: SafeCommandSet) -> Achieved:
        """Play a set now; returns what it really plays.

        A silent set overtakes the queue as a stop does. Raises CommandRefused if a newer set or a
        stop superseded it.
        """
        request = Apply(_safe(safe))
        priority = RequestPriority.SILENCE if safe.is_silent else RequestPriority.APPLY
        return _of_token(
            await self._link.ask(request, expect=Achieved, priority=priority), safe.token
        )

    async def status(self) -> Status:
        """Read the status; does not feed the watchdog."""
        return await self._link.ask(GetStatus(), expect=Status)

    async def faults(self) -> tuple[FaultRecord, ...]:
        """Read latched and past faults, newest first."""
        return (await self._link.ask(GetFaults(), expect=FaultList)).faults

    async def clear(self) -> Status:
        """Acknowledge a stop, or faults whose cause is gone; the amplifier stays disarmed.

        Raises CommandRefused if another stop came first: that one is not acknowledged.
        """
        return await self._link.ask(Clear(), expect=Status, priority=RequestPriority.CLEAR)

    async def heartbeat(self) -> Status:
        """Feed the watchdog; called by the control loop itself, after it has run."""
        status = await self._link.ask(Ping(), expect=Status)
        self._link.heartbeat_acknowledged()
        return status

    def abort_unsent(self) -> None:
        """Do not send unsent requests, and retry none.

        Such requests raise Preempted; stop-class requests are sent and retried as usual.
        """
        self._link.abort_unsent()

    async def commit_on_bus(self, token: int) -> None:
        """Let every amplifier of the bus play its staged set of this token at the same time.

        There are no replies: read the status of each. Raises CommandError if the bus does not
        support broadcasts.
        """
        await self._link.broadcast(Commit(token=token), RequestPriority.APPLY)

    async def stop_on_bus(self, ramp: float = STOP_RAMP) -> None:
        """Stop every amplifier of the bus, before all queued requests; there are no replies."""
        await self._link.backend.broadcast(Stop(ramp=self._ramp(ramp)))

    def _notify(self, event: AmplifierEvent) -> None:
        for listener in self._listeners:
            listener(event)

    def _ramp(self, ramp: float) -> float:
        """Clip a ramp to the amplifier's range, so that a stop is never refused for it."""
        max_ramp = PROTOCOL.quantities.ramp.high
        if self._capabilities is not None:
            max_ramp = min(max_ramp, self._capabilities.ramp_max)
        return min(ramp, max_ramp) if ramp > 0 else 0.0


def _safe(safe: SafeCommandSet) -> SafeCommandSet:
    if type(safe) is not SafeCommandSet:
        raise TypeError(
            f"set must be a SafeCommandSet made by Guard.check, got {type(safe).__name__}"
        )
    return safe


def _of_token(achieved: Achieved, token: int) -> Achieved:
    if achieved.token != token:
        raise FrameError(
            f"reply must be for token {token}, got token {achieved.token}; {PROTOCOL_VIOLATION}"
        )
    return achieved
