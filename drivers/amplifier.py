"""An amplifier as the controller sees it: arm, play, stop, whatever wire it hangs on."""

from collections.abc import Callable
from typing import final

from drivers.backend import Backend
from drivers.errors import CommandError, FrameError, LinkError
from drivers.guard import SafeCommandSet, SafeEnvelope
from drivers.link.link import REPLY_TIMEOUT, Link
from drivers.link.refusals import NO_PROTOCOL
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
OPEN_TIMEOUT = 0.5  # s; boards that restart when their port is opened need a moment
DISARM_RAMP = 0.05  # s; long enough not to click
STOP_RAMP = 0.005  # s; the shortest that is no step


@final
class Amplifier:
    """One amplifier over one backend; at most one request is on the wire at any time.

    A reply that does not come is asked for twice more (see `Link`), and so is a busy amplifier;
    tokens make that safe. After a LinkError it is lost until it is closed and opened anew: every
    other call raises LinkError at once, and nothing re-arms.
    reply_timeout [s]: how long one exchange may take; serial_number: of the amplifier that is
    expected, any one the first time if None. Another one is refused when it is opened.
    """

    def __init__(
        self,
        backend: Backend,
        *,
        reply_timeout: float = REPLY_TIMEOUT,
        serial_number: str | None = None,
    ) -> None:
        self._link = Link(backend, reply_timeout=reply_timeout, on_event=self._told)
        self._serial_number = serial_number
        self._listeners: list[Callable[[AmplifierEvent], None]] = []
        self._token = 0
        self._identity: Identity | None = None
        self._capabilities: Capabilities | None = None

    @property
    def identity(self) -> Identity:
        """Who it is; known once it is open."""
        if self._identity is None:
            raise CommandError("nobody knows yet who the amplifier is; call open() first")
        return self._identity

    @property
    def capabilities(self) -> Capabilities:
        """What it can play; known once it is open."""
        if self._capabilities is None:
            raise CommandError("nobody knows yet what the amplifier can play; call open() first")
        return self._capabilities

    @property
    def last_sent(self) -> float:
        """When the last byte of the last request went out, by the event loop's clock [s]."""
        return self._link.backend.last_sent

    @property
    def is_lost(self) -> bool:
        """Whether every further call raises LinkError."""
        return self._link.is_lost

    @property
    def bus(self) -> str | None:
        """Names what it shares with others that one broadcast reaches; None without broadcasts."""
        return self._link.backend.bus

    @property
    def statistics(self) -> LinkStatistics:
        """How well the link does; counts since it was opened, retries since it was made."""
        return self._link.statistics

    @property
    def wire_times(self) -> WireTimes:
        """How long things take on its wire."""
        return self._link.backend.wire_times

    def round_trip(self) -> float:
        """Time [s] on the wire of its longest exchange, an apply of all channels; 0 if unknown."""
        return self.wire_times.round_trip(self.capabilities.channels)

    def listen(self, on_event: Callable[[AmplifierEvent], None]) -> None:
        """Be told, in the event loop, what the amplifier says unasked; a hint that may be lost."""
        self._listeners.append(on_event)

    def next_token(self) -> int:
        """A token for the next command set: 1..65535, then from 1 again."""
        self._token = token_after(self._token)
        return self._token

    async def open(self) -> None:
        """Open the wire and ask who is there and what it can play; its state is left alone."""
        await self._link.open()
        try:
            identity = await self._link.ask(Hello(), expect=Identity, timeout=OPEN_TIMEOUT)
            if identity.protocol_version != PROTOCOL.version:
                raise LinkError(
                    f"{identity.vendor} {identity.product} {identity.serial_number} speaks version "
                    f"{identity.protocol_version} of the protocol, this program version "
                    f"{PROTOCOL.version}; update the older of the two"
                )
            if self._serial_number not in (None, identity.serial_number):
                raise LinkError(
                    f"amplifier {identity.serial_number} answers where {self._serial_number} is "
                    "expected; undo the mix-up, or close everything and begin anew with this one"
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
        """Close the wire; what plays goes on until the amplifier's watchdog: disarm before."""
        await self._link.close()

    async def arm(self, watchdog: float = WATCHDOG) -> Status:
        """High voltage on, every channel enabled at level zero; watchdog [s].

        Raises CommandError for a watchdog that the amplifier cannot keep, and CommandRefused where
        a stop or disarm came before its turn: nothing arms after it was silenced.
        """
        low, high = self.capabilities.watchdog_min, self.capabilities.watchdog_max
        if not low <= watchdog <= high:
            raise CommandError(
                f"a watchdog of {watchdog:g} s is out of the amplifier's range of {low:g} to "
                f"{high:g} s"
            )
        return await self._link.ask(
            Arm(watchdog=watchdog), expect=Status, kind=RequestPriority.APPLY
        )

    async def disarm(self, ramp: float = DISARM_RAMP) -> Status:
        """Silent along a ramp [s], then high voltage off; overtakes all that waits."""
        return await self._link.ask(
            Disarm(ramp=self._ramp(ramp)), expect=Status, kind=RequestPriority.SILENCE
        )

    async def stop(self, ramp: float = STOP_RAMP) -> Status:
        """Quick stop along a ramp [s], latched until clear; overtakes all that waits.

        It is on the wire within 8 ms, as disarm is: what else waits for an answer there gives way
        and raises CommandRefused, or follows where it silences. What is not on the wire yet gives
        way at once.
        """
        return await self._link.ask(
            Stop(ramp=self._ramp(ramp)), expect=Status, kind=RequestPriority.STOP
        )

    async def load_envelope(self, safe: SafeEnvelope) -> None:
        """Keep an envelope under its slot, for sets that come after it; at any time, armed or not.

        Raises CommandRefused where the amplifier plays no envelopes.
        """
        if type(safe) is not SafeEnvelope:
            raise TypeError(
                f"an amplifier takes a SafeEnvelope, not a {type(safe).__name__}: "
                "let Guard.check_envelope make one"
            )
        loaded = await self._link.ask(LoadEnvelope(safe), expect=Loaded)
        if (loaded.slot, loaded.knots) != (safe.slot, len(safe.knots)):
            raise FrameError(
                f"the amplifier loaded {loaded.knots} knots into slot {loaded.slot} instead of "
                f"{len(safe.knots)} into slot {safe.slot}; {NO_PROTOCOL}"
            )

    async def stage(self, safe: SafeCommandSet) -> Achieved:
        """Keep a set ready under its token; returns what commit would play.

        Raises CommandRefused where a newer set, a stop or a disarm came before its turn.
        """
        request = Stage(_safe(safe))
        achieved = await self._link.ask(request, expect=Achieved, kind=RequestPriority.APPLY)
        return _of_token(achieved, safe.token)

    async def commit(self, token: int) -> Achieved:
        """Play the staged set of this token; playing it twice is playing it once.

        Raises CommandRefused where a newer set, a stop or a disarm came before its turn.
        """
        achieved = await self._link.ask(
            Commit(token=token), expect=Achieved, kind=RequestPriority.APPLY
        )
        return _of_token(achieved, token)

    async def apply(self, safe: SafeCommandSet) -> Achieved:
        """Play a set now; returns what the amplifier makes of it.

        A silent set overtakes as a stop does. Raises CommandRefused where a newer set or a stop
        took its place.
        """
        request = Apply(_safe(safe))
        kind = RequestPriority.SILENCE if safe.is_silent else RequestPriority.APPLY
        return _of_token(await self._link.ask(request, expect=Achieved, kind=kind), safe.token)

    async def status(self) -> Status:
        """How it is; does not feed the watchdog."""
        return await self._link.ask(GetStatus(), expect=Status)

    async def faults(self) -> tuple[FaultRecord, ...]:
        """Latched and past faults, newest first."""
        return (await self._link.ask(GetFaults(), expect=FaultList)).faults

    async def clear(self) -> Status:
        """Acknowledge a stop, or faults whose cause is gone; the amplifier stays disarmed.

        Raises CommandRefused where another stop came before its turn: that is not acknowledged.
        """
        return await self._link.ask(Clear(), expect=Status, kind=RequestPriority.CLEAR)

    async def heartbeat(self) -> Status:
        """Feed the watchdog; to be called by the control loop itself, after it has run."""
        status = await self._link.ask(Ping(), expect=Status)
        self._link.heartbeat_acknowledged()
        return status

    def abort_unsent(self) -> None:
        """Do not send what still waits for the wire, and repeat nothing.

        Such requests raise Preempted; requests with stop priority are sent and repeated as usual.
        """
        self._link.abort_unsent()

    async def commit_on_bus(self, token: int) -> None:
        """Have every amplifier of the bus play what it has staged under this token, at one moment.

        Nobody answers: `status` of each tells whether it followed. Raises CommandError where the
        bus knows no broadcast.
        """
        await self._link.broadcast(Commit(token=token), RequestPriority.APPLY)

    async def stop_on_bus(self, ramp: float = STOP_RAMP) -> None:
        """Quick stop of every amplifier of the bus, before all that waits there; nobody answers."""
        await self._link.backend.broadcast(Stop(ramp=self._ramp(ramp)))

    def _told(self, event: AmplifierEvent) -> None:
        for listener in self._listeners:
            listener(event)

    def _ramp(self, ramp: float) -> float:
        """A ramp that the amplifier can play: falling silent is never refused for its ramp."""
        longest = PROTOCOL.quantities.ramp.high
        if self._capabilities is not None:
            longest = min(longest, self._capabilities.ramp_max)
        return min(ramp, longest) if ramp > 0 else 0.0


def _safe(safe: SafeCommandSet) -> SafeCommandSet:
    if type(safe) is not SafeCommandSet:
        raise TypeError(
            f"an amplifier takes a SafeCommandSet, not a {type(safe).__name__}: "
            "let Guard.check make one"
        )
    return safe


def _of_token(achieved: Achieved, token: int) -> Achieved:
    if achieved.token != token:
        raise FrameError(
            f"the amplifier answered for token {achieved.token} instead of {token}; {NO_PROTOCOL}"
        )
    return achieved
