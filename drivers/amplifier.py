"""An amplifier: arm, play, stop, whatever its wire."""

import asyncio
import logging
import math
from collections.abc import Callable, Sequence
from typing import final

from drivers import clock, trace
from drivers.backend import Backend
from drivers.errors import (
    CommandError,
    CommandRefused,
    DriverError,
    FrameError,
    LinkError,
    Preempted,
)
from drivers.guard import SafeCommandSet, SafeEnvelope, require_safe, require_safe_set
from drivers.guard.recorder import RECORDED, PlayRecorder
from drivers.line.sender import SUPERSEDED
from drivers.link.link import REPLY_TIMEOUT, Link, ReplyT
from drivers.link.pacing import Pacing
from drivers.link.refusals import PROTOCOL_VIOLATION
from drivers.protocol.definition import (
    PROTOCOL,
    is_newer_latch,
    random_session,
    random_token,
    token_after,
)
from drivers.protocol.messages import (
    Achieved,
    AmplifierEvent,
    AmplifierState,
    Apply,
    Arm,
    Capabilities,
    Clear,
    Commit,
    Disarm,
    FaultList,
    FaultRecord,
    Feature,
    GetBlock,
    GetCaps,
    GetFaults,
    GetMeasured,
    GetReading,
    GetSensors,
    GetStatus,
    Hello,
    Identity,
    Loaded,
    LoadEnvelope,
    Measure,
    Measured,
    Measurement,
    Ping,
    Request,
    SetAddress,
    Stage,
    Status,
    Stop,
)
from drivers.protocol.wire_times import WireTimes
from drivers.sensor_client import SensorClient
from drivers.statistics import LinkStatistics

WATCHDOG = 0.25  # s; five heartbeats of 50 ms
_FEEDS_PER_WATCHDOG = 5  # while a set waits
OPEN_TIMEOUT = 0.5  # s; for boards that restart when their port is opened
DISARM_RAMP = 0.05  # s; long enough to avoid a click
STOP_RAMP = 0.005  # s; the shortest without a step
# s; from the expiry of a watchdog until the outputs are silent, by the protocol
WATCHDOG_REACTION = 0.005 + PROTOCOL.reaction

_POSITIVE = ("channels", "voices", "frequency_step", "level_step", "phase_step")
"""Capabilities that must be above 0."""

_logger = logging.getLogger(__name__)

# Requests that do not feed the watchdog, or silence the amplifier where they arrive.
_NOT_FEEDING = frozenset(
    (
        *(Hello, GetCaps, GetStatus, GetFaults, GetMeasured, LoadEnvelope),
        *(GetSensors, Measure, GetReading, GetBlock),
        *(Clear, Stop, Disarm),
    )
)


@final
class Amplifier(SensorClient):
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
        self._link = Link(
            backend,
            reply_timeout=reply_timeout,
            on_event=self._notify,
            silent_from=self._silent_from,
        )
        self._recorder = PlayRecorder()
        self._pacing = Pacing()
        self._serial_number = serial_number
        self._listeners: list[Callable[[AmplifierEvent], None]] = []
        self._token = 0
        self.session = 0
        """Number of the last arming that was granted; requests carry it."""
        self.latch: int | None = None
        """Newest latch that a status has shown since it was connected."""
        self._stop_count = 0
        self._watchdog: float | None = None
        self._last_fed_at: float | None = None
        self._feeding_count = 0  # requests in progress that feed the watchdog
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
        """Its capabilities; known once open."""
        if self._capabilities is None:
            raise CommandError("capabilities are known only after opening; call open() first")
        return self._capabilities

    @property
    def is_identified(self) -> bool:
        """Whether identity and capabilities are known."""
        return self._capabilities is not None

    @property
    def last_sent_at(self) -> float:
        """Time [s] when the last byte of the last request went out, by the event loop's clock."""
        return self._link.backend.last_sent_at

    @property
    def last_fed_at(self) -> float | None:
        """Latest time [s] at which a request of this host may have fed the watchdog.

        By the event loop's clock; None before the first such request.
        """
        return clock.now() if self._feeding_count else self._last_fed_at

    @property
    def watchdog(self) -> float | None:
        """The longest watchdog [s] that may be in force since it was armed.

        None before, and of an amplifier that has none.
        """
        return self._watchdog

    @property
    def is_lost(self) -> bool:
        """Whether every further call but `stop` raises LinkError."""
        return self._link.is_lost

    @property
    def is_degraded(self) -> bool:
        """Whether several requests in a row had no reply and it may still play its last set.

        Calls that would play or arm raise LinkDegraded then. Any reply ends it: the caller checks
        the token of the status.
        """
        return self._link.is_degraded

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

    @property
    def carries_sessions(self) -> bool:
        """Whether its wire carries sessions; else the host itself is the session."""
        return self._link.backend.carries_sessions

    def round_trip(self) -> float:
        """Wire time [s] of its longest exchange, an apply of all channels; 0 if unknown."""
        return self.wire_times.round_trip(self.capabilities.channels)

    def listen(self, on_event: Callable[[AmplifierEvent], None]) -> None:
        """Register a callback for unsolicited events, in the event loop; events may be lost."""
        self._listeners.append(on_event)

    def next_token(self) -> int:
        """Return a token for the next command set: from a random one to 65535, then 1."""
        self._token = token_after(self._token)
        return self._token

    async def open(self, *, take_over: bool = True) -> None:
        """Open the wire, read identity and capabilities, and leave the amplifier disarmed.

        take_over: whether to disarm it; False for callers that only look. A latched stop or fault
        stays.
        """
        await self.connect()
        try:
            await self.identify()
            if take_over:
                await self._disarm_inherited()
        except BaseException:
            await self.close()
            raise

    async def connect(self) -> None:
        """Open the wire and send nothing: enough for a stop."""
        self._token = random_token()  # a set of an earlier host must not be taken for a new one
        self.latch = None  # it may have lost its supply
        await self._link.open()

    async def identify(self) -> None:
        """Read identity and capabilities; raises LinkError for another amplifier or version."""
        identity = await self._request(Hello(), expect=Identity, timeout=OPEN_TIMEOUT)
        if PROTOCOL.version not in identity.versions:
            spoken = ", ".join(map(str, identity.versions)) or "none"
            raise LinkError(
                f"protocol version must be {PROTOCOL.version}, got {spoken} from "
                f"{identity.vendor} {identity.product} {identity.serial_number}; update "
                "the older side"
            )
        if self._serial_number not in (None, identity.serial_number):
            raise LinkError(
                f"serial number must be {self._serial_number}, got {identity.serial_number}; "
                "connect the expected amplifier, or restart with this one"
            )
        capabilities = await self._request(GetCaps(), expect=Capabilities, timeout=OPEN_TIMEOUT)
        _check_capabilities(capabilities)
        self._capabilities = capabilities
        self._identity = identity
        self._serial_number = identity.serial_number
        self._link.allow_longest_exchange(self.round_trip())

    async def close(self) -> None:
        """Close the wire; disarm before, or the vibration lasts until the watchdog trips."""
        self._pacing.supersede()
        await self._link.close()

    async def arm(self, watchdog: float = WATCHDOG, *, session: int | None = None) -> Status:
        """Switch the high voltage on and enable every channel at level zero; watchdog [s].

        session: the number of this arming, the same for amplifiers that start together; None: a
        random one.

        Raises CommandError for a watchdog outside the amplifier's range, and CommandRefused if a
        stop or disarm came first or it is armed already.
        """
        low, high = self.capabilities.watchdog_min, self.capabilities.watchdog_max
        has_watchdog = Feature.WATCHDOG in self.capabilities.features
        if has_watchdog and not low <= watchdog <= high:
            raise CommandError(
                f"watchdog must be {low:g} to {high:g} s, as the amplifier reports, got "
                f"{watchdog:g} s"
            )
        self._watchdog = max(watchdog, self._watchdog or 0.0) if has_watchdog else None
        arm = Arm(watchdog, session or random_session())
        status = await self._request(arm, expect=Status)
        self.session = arm.session
        self._watchdog = watchdog if has_watchdog else None
        return status

    async def disarm(self, ramp: float = DISARM_RAMP) -> Status:
        """Ramp [s] to silence, then switch the high voltage off; overtakes the queue."""
        self._pacing.supersede()
        return await self._request(Disarm(ramp=self._ramp(ramp)), expect=Status)

    async def stop(self, ramp: float = STOP_RAMP) -> Status:
        """Quick stop along a ramp [s], latched until clear; overtakes the queue.

        Like disarm it waits for the exchange on the line for at most PREEMPTION_GRACE, over Modbus
        RTU until the line is free (docs/measured/wire-benchmarks.md). A pending request raises
        CommandRefused, or is repeated afterwards if it is of the stop class. A request that is not
        on the wire yet is preempted at once.
        """
        self._stop_count += 1
        self._pacing.supersede()
        return await self._request(Stop(ramp=self._ramp(ramp)), expect=Status)

    async def load_envelope(self, safe: SafeEnvelope) -> None:
        """Load an envelope into its slot, for later sets; at any time, armed or not.

        Raises CommandRefused if the amplifier does not support envelopes.
        """
        loaded = await self._request(LoadEnvelope(safe), expect=Loaded)
        if (loaded.slot, loaded.knots) != (safe.slot, len(safe.knots)):
            raise FrameError(
                f"the amplifier must load {len(safe.knots)} knots into slot {safe.slot}, got "
                f"{loaded.knots} in slot {loaded.slot}; {PROTOCOL_VIOLATION}"
            )

    async def wait_for_room(self, safe: SafeCommandSet) -> None:
        """Wait until every channel that a set drives has a voice for it, feeding the watchdog.

        Of several sets the newest goes on; the others raise Preempted, as a set does if silence, a
        stop or a disarm comes.
        """
        require_safe_set(safe)
        interval = (self._watchdog or WATCHDOG) / _FEEDS_PER_WATCHDOG
        await self._pacing.wait_for_room(safe, self.heartbeat, interval=interval)

    async def stage(self, safe: SafeCommandSet) -> Achieved:
        """Keep a set ready under its token; returns what its commit would achieve.

        Waits for room. Raises CommandRefused if a newer set, a stop or a disarm came first.
        """
        await self.wait_for_room(safe)
        achieved = await self._request(Stage(safe, self.session), expect=Achieved)
        return _of_token(achieved, safe.token)

    async def commit(self, token: int) -> Achieved:
        """Play the staged set of this token; idempotent.

        Raises CommandRefused if a newer set, a stop or a disarm came first.
        """
        achieved = await self._request(Commit(token, self.session), expect=Achieved)
        return _of_token(achieved, token)

    async def apply(self, safe: SafeCommandSet) -> Achieved:
        """Play a set now; returns the achieved set.

        Waits for room. A silent set does not wait, and overtakes the queue as a stop does. Raises
        CommandRefused if a newer set or a stop superseded it.
        """
        await self.wait_for_room(safe)
        achieved = await self._request(Apply(safe, self.session), expect=Achieved)
        return _of_token(achieved, safe.token)

    async def status(self) -> Status:
        """Read the status; does not feed the watchdog."""
        return await self._request(GetStatus(), expect=Status)

    async def faults(self) -> tuple[FaultRecord, ...]:
        """Read latched and past faults, newest first."""
        return (await self._request(GetFaults(), expect=FaultList)).faults

    async def measured(self) -> tuple[Measurement, ...]:
        """Read voltage and current of each channel; empty if it does not measure them."""
        if Feature.ELECTRICAL not in self.capabilities.features:
            return ()
        return (await self._request(GetMeasured(), expect=Measured)).channels

    async def clear(self, latch: int | None = None) -> Status:
        """Acknowledge a stop, or faults whose cause is gone; the amplifier stays disarmed.

        latch: its number in a status; None: that of the last one, which is read first. Raises
        CommandRefused if another stop or fault has come: that one is not acknowledged.
        """
        before = self._stop_count
        if latch is None:
            latch = (await self.status()).latch
        if self._stop_count != before:
            raise Preempted(SUPERSEDED)
        return await self._request(Clear(latch), expect=Status)

    async def heartbeat(self) -> Status:
        """Feed the watchdog; called by the control loop itself, after it has run.

        On a degraded link it only reads the status, so that the watchdog expires without replies.
        """
        request = GetStatus() if self.is_degraded else Ping(self.session)
        return await self._request(request, expect=Status)

    def abort_unsent(self) -> None:
        """Discard unsent requests and retry none: they raise Preempted.

        Stop-class requests are exempt.
        """
        self._pacing.supersede()
        self._link.abort_unsent()

    def expect_stop(self) -> None:
        """Discard what is unsent, and a clear in progress, since a stop is about to be sent."""
        self._stop_count += 1
        self.abort_unsent()

    async def commit_on_bus(self, token: int, others: Sequence["Amplifier"] = ()) -> None:
        """Let every amplifier of the bus play its staged set of this token at the same time.

        others: those on the bus beside this one that have staged it, whose watchdogs it feeds, too.
        They must be armed by the same session. There are no replies: read the status of each.
        Raises CommandError if the bus does not support broadcasts.
        """
        commit = Commit(token, self.session)
        receivers = (self, *others)
        for each in receivers:
            each._recorder.sending(commit)
        feeds = self._start_feeding(commit)
        for each in others:
            each._feeding_count += feeds
        try:
            await self._link.broadcast(commit)
        finally:
            for each in receivers:
                each._end_feeding(feeds)
                each._recorder.left(commit)

    async def stop_on_bus(self, ramp: float = STOP_RAMP) -> None:
        """Stop every amplifier of the bus, before all queued requests; there are no replies."""
        self._stop_count += 1
        self._pacing.supersede()
        request = Stop(ramp=self._ramp(ramp))
        _note(request, self._recorder.sending)
        await self._link.broadcast(request)

    async def set_address(self, address: int, serial_number: str) -> None:
        """Give the amplifier of this serial number another address, disarmed; there is no reply.

        Enough for it that the wire is connected, so that two of one address can be told apart.
        """
        await self._link.broadcast(SetAddress(address, serial_number))

    async def _disarm_inherited(self) -> None:
        """Disarm an amplifier that an earlier host may have left playing."""
        status = await self.disarm()
        if status.state is AmplifierState.OPERATION_ENABLED:
            raise LinkError(
                f"amplifier must be disarmed by Disarm, got {status.state.name}; switch it off"
            )
        if status.state is AmplifierState.SWITCHED_ON:
            await asyncio.sleep(DISARM_RAMP)

    async def _request(
        self,
        request: Request,
        *,
        expect: type[ReplyT],
        timeout: float | None = None,
    ) -> ReplyT:
        require_safe(request)
        is_recorded = type(request) in RECORDED
        if is_recorded:
            _note(request, self._recorder.sending)
        started_at = clock.now() if trace.has_requests() else None
        outcome: object = "cancelled"
        feeds = self._start_feeding(request)
        try:
            outcome = reply = await self._link.request(request, expect=expect, timeout=timeout)
            if isinstance(reply, Status):
                self._check_status(reply)
        except DriverError as error:
            outcome = error
            if isinstance(error, CommandRefused) and not isinstance(error, Preempted):
                self._recorder.refused(request, may_play=error.may_play)
            raise
        finally:
            self._end_feeding(feeds)
            if is_recorded:
                self._recorder.left(request)
            self._pacing.notice()
            if started_at is not None:
                _note(request, trace.request, outcome, clock.now() - started_at)
        _note(request, self._recorder.replied, reply)
        return reply

    def _check_status(self, status: Status) -> None:
        """Note the latch of a status; FrameError unless it has the level of every channel."""
        levels, channels = len(status.levels), self._capabilities and self._capabilities.channels
        if channels not in (None, levels):
            raise FrameError(
                f"status must have the levels of all {channels} channels, got {levels}; "
                f"{PROTOCOL_VIOLATION}"
            )
        if self.latch is None or is_newer_latch(status.latch, self.latch):
            self.latch = status.latch

    def _start_feeding(self, request: Request) -> bool:
        """Note a request that may feed the watchdog until `_end_feeding`; returns whether it may.

        Nothing that feeds it, and may play, is sent on a lost or degraded link.
        """
        feeds = type(request) not in _NOT_FEEDING and not (self.is_lost or self.is_degraded)
        self._feeding_count += feeds
        return feeds

    def _end_feeding(self, feeds: bool) -> None:
        """Note that a request, which feeds the watchdog or does not, is not pending any more."""
        if feeds:
            self._feeding_count -= 1
            self._last_fed_at = clock.now()

    def _silent_from(self) -> float:
        """Return the time [s] by which its watchdog must have expired, if nothing feeds it."""
        if self._watchdog is None or self.last_fed_at is None:
            return -math.inf
        return self.last_fed_at + self._watchdog + WATCHDOG_REACTION

    def _notify(self, event: AmplifierEvent) -> None:
        for listener in self._listeners:
            listener(event)

    def _ramp(self, ramp: float) -> float:
        """Clip a ramp to the amplifier's range, so that a stop is never refused for it."""
        max_ramp = PROTOCOL.quantities.ramp.high
        if self._capabilities is not None:
            max_ramp = min(max_ramp, self._capabilities.ramp_max)
        return min(ramp, max_ramp) if ramp > 0 else 0.0


def _note(request: Request, record: Callable[..., object], *details: object) -> None:
    """Call `record` with a request; of a Stop or Disarm, log its error instead of raising it.

    Bookkeeping must not prevent it.
    """
    try:
        record(request, *details)
    except Exception:
        if not isinstance(request, Stop | Disarm):
            raise
        _logger.exception("amplifier: %s is not recorded", type(request).__name__)


def _check_capabilities(reported: Capabilities) -> None:
    """Raise FrameError for numbers of 0 with which nothing can be played."""
    zero = [name for name in _POSITIVE if not getattr(reported, name) > 0]
    if zero:
        raise FrameError(
            f"capabilities must be above 0, got 0 as {', '.join(zero)}; {PROTOCOL_VIOLATION}"
        )


def _of_token(achieved: Achieved, token: int) -> Achieved:
    if achieved.token != token:
        raise FrameError(
            f"reply must be for token {token}, got token {achieved.token}; {PROTOCOL_VIOLATION}"
        )
    return achieved
