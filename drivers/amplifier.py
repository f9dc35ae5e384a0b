"""An amplifier as the controller sees it: arm, play, stop, whatever wire it hangs on."""

import asyncio
from collections.abc import Callable
from typing import TypeVar, final

from drivers import clock
from drivers.backend import Backend
from drivers.command import token_after
from drivers.errors import CommandError, FrameError, LinkError, LinkTimeout
from drivers.guard import SafeCommand, SafeEnvelope
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    Achieved,
    Apply,
    Arm,
    Capabilities,
    Clear,
    Commit,
    Disarm,
    Event,
    FaultList,
    FaultRecord,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    Identity,
    Loaded,
    LoadEnvelope,
    Nak,
    Ping,
    Reply,
    Request,
    Stage,
    Status,
    Stop,
)
from drivers.refusals import is_busy, refusal
from drivers.statistics import LinkStatistics
from drivers.turns import Kind, Turns

WATCHDOG = 0.25  # s; five heartbeats of 50 ms
REPLY_TIMEOUT = 0.05  # s; three unanswered requests are three heartbeats
OPEN_TIMEOUT = 0.5  # s; boards that restart when their port is opened need a moment
RETRIES = 2
BUSY_PAUSE = 0.005  # s; before a busy amplifier is asked again: short enough for a touch to be felt
DISARM_RAMP = 0.05  # s; long enough not to click
STOP_RAMP = 0.005  # s; the shortest that is no step

_ReplyT = TypeVar("_ReplyT", Identity, Capabilities, Status, Achieved, FaultList, Loaded)


@final
class Amplifier:
    """One amplifier over one backend; at most one request is on the wire at any time.

    A reply that does not come is asked for twice more, and so is a busy amplifier; tokens make that
    safe. After a LinkError
    it is lost until it is closed and opened anew: every other call raises LinkError at once, and
    nothing re-arms.
    reply_timeout [s]: how long it may take over one request; serial_number: of the amplifier that
    is expected, any one the first time if None. Another one is refused when it is opened.
    """

    def __init__(
        self,
        backend: Backend,
        *,
        reply_timeout: float = REPLY_TIMEOUT,
        serial_number: str | None = None,
    ) -> None:
        self._backend = backend
        self._reply_timeout = reply_timeout
        self._serial_number = serial_number
        self._listeners: list[Callable[[Event], None]] = []
        self._retries = self._timeouts = self._refusals = 0
        self._is_stuck = False  # it was busy to the last: until it is not, nothing is repeated
        self._last_round_trip: float | None = None
        self._last_heartbeat: float | None = None
        backend.listen(self._told, self._found_lost)
        self._turns = Turns()
        self._token = 0
        self._unanswered = 0
        self._loss: str | None = "the amplifier is not open yet; call open() first"
        self._identity: Identity | None = None
        self._capabilities: Capabilities | None = None

    @property
    def identity(self) -> Identity:
        """Who it is; known once it is open."""
        if self._identity is None:
            raise CommandError("the amplifier is not open yet: nobody knows who it is")
        return self._identity

    @property
    def capabilities(self) -> Capabilities:
        """What it can play; known once it is open."""
        if self._capabilities is None:
            raise CommandError("the amplifier is not open yet: nobody knows what it can play")
        return self._capabilities

    @property
    def last_sent(self) -> float:
        """When the last byte of the last request went out, on time.monotonic() [s]."""
        return self._backend.last_sent

    @property
    def lost(self) -> bool:
        """Whether every further call raises LinkError."""
        return self._loss is not None

    @property
    def bus(self) -> str | None:
        """Names what it shares with others that one broadcast reaches; None without broadcasts."""
        return self._backend.bus

    @property
    def statistics(self) -> LinkStatistics:
        """How well the link does; counts since it was opened, retries since it was made."""
        seen, now = self._backend.counters, clock.now()
        return LinkStatistics(
            frames_out=seen.frames_out,
            frames_in=seen.frames_in,
            bad=seen.bad,
            foreign=seen.foreign,
            events=seen.events,
            retries=self._retries,
            timeouts=self._timeouts,
            refusals=self._refusals,
            last_round_trip=self._last_round_trip,
            heartbeat_age=None if self._last_heartbeat is None else now - self._last_heartbeat,
        )

    def round_trip(self) -> float:
        """Time [s] on the wire of an apply of all channels and its answer; 0 where not known."""
        return self._backend.round_trip(self.capabilities.channels)

    def listen(self, on_event: Callable[[Event], None]) -> None:
        """Be told, in the event loop, what the amplifier says unasked; a hint that may be lost."""
        self._listeners.append(on_event)

    def next_token(self) -> int:
        """A token for the next command set: 1..65535, then from 1 again."""
        self._token = token_after(self._token)
        return self._token

    async def open(self) -> None:
        """Open the wire and ask who is there and what it can play; its state is left alone."""
        await self._backend.open()
        self._loss = None
        self._unanswered = 0
        try:
            identity = await self._ask(Hello(), expect=Identity, timeout=OPEN_TIMEOUT)
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
            self._capabilities = await self._ask(
                GetCaps(), expect=Capabilities, timeout=OPEN_TIMEOUT
            )
            self._identity = identity
            self._serial_number = identity.serial_number
        except BaseException:
            await self.close()
            raise

    async def close(self) -> None:
        """Close the wire; what plays goes on until the amplifier's watchdog: disarm before."""
        if self._loss is None:
            self._loss = "the amplifier was closed; open a new one"
        await self._backend.close()

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
        return await self._ask(Arm(watchdog=watchdog), expect=Status, kind=Kind.APPLY)

    async def disarm(self, ramp: float = DISARM_RAMP) -> Status:
        """Silent along a ramp [s], then high voltage off; overtakes all that waits."""
        return await self._ask(Disarm(ramp=self._ramp(ramp)), expect=Status, kind=Kind.SILENCE)

    async def stop(self, ramp: float = STOP_RAMP) -> Status:
        """Quick stop along a ramp [s], latched until clear; overtakes all that waits.

        It is on the wire within 8 ms, as disarm is: what else waits for an answer there gives way
        and raises CommandRefused, unless it silences too.
        """
        return await self._ask(Stop(ramp=self._ramp(ramp)), expect=Status, kind=Kind.SILENCE)

    async def load_envelope(self, safe: SafeEnvelope) -> None:
        """Keep an envelope under its slot, for sets that come after it; at any time, armed or not.

        Raises CommandRefused where the amplifier plays no envelopes.
        """
        if type(safe) is not SafeEnvelope:
            raise TypeError(
                f"an amplifier takes a SafeEnvelope, not a {type(safe).__name__}: "
                "let Guard.check_envelope make one"
            )
        loaded = await self._ask(LoadEnvelope(safe), expect=Loaded)
        if (loaded.slot, loaded.knots) != (safe.slot, len(safe.knots)):
            raise FrameError(
                f"the amplifier loaded {loaded.knots} knots into slot {loaded.slot} instead of "
                f"{len(safe.knots)} into slot {safe.slot}"
            )

    async def stage(self, safe: SafeCommand) -> Achieved:
        """Keep a set ready under its token; returns what commit would play."""
        request = Stage(_safe(safe))
        return _of_token(await self._ask(request, expect=Achieved), safe.token)

    async def commit(self, token: int) -> Achieved:
        """Play the staged set of this token; playing it twice is playing it once."""
        return _of_token(await self._ask(Commit(token=token), expect=Achieved), token)

    async def apply(self, safe: SafeCommand) -> Achieved:
        """Play a set now; returns what the amplifier makes of it.

        A silent set overtakes as a stop does. Raises CommandRefused where a newer set or a stop
        took its place.
        """
        request = Apply(_safe(safe))
        kind = Kind.SILENCE if safe.is_silent else Kind.APPLY
        return _of_token(await self._ask(request, expect=Achieved, kind=kind), safe.token)

    async def status(self) -> Status:
        """How it is; does not feed the watchdog."""
        return await self._ask(GetStatus(), expect=Status)

    async def faults(self) -> tuple[FaultRecord, ...]:
        """Latched and past faults, newest first."""
        return (await self._ask(GetFaults(), expect=FaultList)).faults

    async def clear(self) -> Status:
        """Acknowledge a stop, or faults whose cause is gone; the amplifier stays disarmed."""
        return await self._ask(Clear(), expect=Status)

    async def heartbeat(self) -> Status:
        """Feed the watchdog; to be called by the control loop itself, after it has run."""
        status = await self._ask(Ping(), expect=Status)
        self._last_heartbeat = clock.now()
        return status

    async def commit_on_bus(self, token: int) -> None:
        """Have every amplifier of the bus play what it has staged under this token, at one moment.

        Nobody answers: `status` of each tells whether it followed. Raises CommandError where the
        bus knows no broadcast.
        """
        await self._broadcast(Commit(token=token), Kind.APPLY)

    async def stop_on_bus(self, ramp: float = STOP_RAMP) -> None:
        """Quick stop of every amplifier of the bus; goes out at once, and nobody answers."""
        await self._backend.broadcast(Stop(ramp=self._ramp(ramp)))

    async def _broadcast(self, request: Commit, kind: Kind) -> None:
        self._raise_if_lost()
        async with self._turns.take(kind):
            await self._backend.broadcast(request)

    def _told(self, event: Event) -> None:
        for listener in self._listeners:
            listener(event)

    def _found_lost(self, what: str) -> None:
        """The wire is gone, and no request was on its way to notice."""
        if self._loss is None:
            self._lose(what)

    def _ramp(self, ramp: float) -> float:
        """A ramp that the amplifier can play: falling silent is never refused for its ramp."""
        longest = PROTOCOL.quantities.ramp.high
        if self._capabilities is not None:
            longest = min(longest, self._capabilities.ramp_max)
        return min(ramp, longest) if ramp > 0 else 0.0

    async def _ask(
        self,
        request: Request,
        *,
        expect: type[_ReplyT],
        kind: Kind = Kind.ORDINARY,
        timeout: float | None = None,
    ) -> _ReplyT:
        self._raise_if_lost()
        async with self._turns.take(kind):
            self._raise_if_lost()
            reply = await self._exchange(request, kind, timeout or self._reply_timeout)
        name = type(request).__name__
        if isinstance(reply, Nak):
            self._refusals += 1
            raise refusal(name, reply)
        if not isinstance(reply, expect):
            raise FrameError(f"the amplifier answered {name} with {type(reply).__name__}")
        return reply

    async def _exchange(self, request: Request, kind: Kind, timeout: float) -> Reply:
        busy = 0
        while True:
            begin = clock.now()
            try:
                reply = await self._backend.exchange(request, timeout=timeout)
            except LinkTimeout as problem:
                self._timeouts += 1
                # Counted across requests: a stream of superseded ones must not hide a dead link.
                self._unanswered += 1
                if self._unanswered > RETRIES:
                    what = f"{problem} ({self._unanswered} requests in a row were left unanswered)"
                    raise LinkTimeout(self._lose(what)) from problem
            except LinkError as problem:
                raise LinkError(self._lose(str(problem))) from problem
            else:
                self._unanswered = 0
                self._last_round_trip = clock.now() - begin
                if not is_busy(reply):
                    self._is_stuck = False
                    return reply
                if self._is_stuck or busy == RETRIES:
                    self._is_stuck = True
                    return reply
                busy += 1
                await asyncio.sleep(BUSY_PAUSE)
            self._turns.raise_if_overtaken(kind)
            self._retries += 1

    def _lose(self, what: str) -> str:
        self._loss = (
            f"{what}. Assume that the amplifier is energised until its watchdog has passed; once "
            "it is opened again it is disarmed"
        )
        return self._loss

    def _raise_if_lost(self) -> None:
        if self._loss is not None:
            raise LinkError(self._loss)


def _safe(safe: SafeCommand) -> SafeCommand:
    if type(safe) is not SafeCommand:
        raise TypeError(
            f"an amplifier takes a SafeCommand, not a {type(safe).__name__}: "
            "let Guard.check make one"
        )
    return safe


def _of_token(achieved: Achieved, token: int) -> Achieved:
    if achieved.token != token:
        raise FrameError(f"the amplifier answered for token {achieved.token} instead of {token}")
    return achieved
