"""An amplifier as the controller sees it: arm, play, stop, whatever wire it hangs on."""

import asyncio
from typing import TypeVar, final

from drivers.backend import Backend
from drivers.command import token_after
from drivers.errors import CommandError, CommandRefused, FrameError, LinkError, LinkTimeout
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
    NakCode,
    Ping,
    Reply,
    Request,
    Stage,
    Status,
    Stop,
)
from drivers.turns import Kind, Turns

WATCHDOG = 0.25  # s; five heartbeats of 50 ms
REPLY_TIMEOUT = 0.05  # s; three unanswered requests are three heartbeats
OPEN_TIMEOUT = 0.5  # s; boards that restart when their port is opened need a moment
RETRIES = 2
BUSY_PAUSE = 0.005  # s; before a busy amplifier is asked again: short enough for a touch to be felt
DISARM_RAMP = 0.05  # s; long enough not to click
STOP_RAMP = 0.005  # s; the shortest that is no step

_REASONS = {
    NakCode.UNKNOWN_TYPE: "it does not know this kind of request",
    NakCode.BAD_LENGTH: "it read a request of another length; its firmware may be too old or new",
    NakCode.BAD_VALUE: "a value is out of the range that it can play",
    NakCode.BAD_CHANNEL: "it has no such channel, or the channel was named twice",
    NakCode.WRONG_STATE: "it is not armed, or it is stopped or in a fault until that is cleared; "
    "ask for its status",
    NakCode.BAD_TOKEN: "no set is staged under this token",
    NakCode.BUSY: "it was busy three times in a row; try again",
    NakCode.NO_ENVELOPE: "no envelope is loaded in a slot that the set refers to",
    NakCode.UNSUPPORTED_VERSION: "it speaks another version of the protocol",
}

_ReplyT = TypeVar("_ReplyT", Identity, Capabilities, Status, Achieved, FaultList, Loaded)


@final
class Amplifier:
    """One amplifier over one backend; at most one request is on the wire at any time.

    A reply that does not come is asked for twice more, and so is a busy amplifier; tokens make that
    safe. After a LinkError
    it is lost until it is closed and opened anew: every other call raises LinkError at once, and
    nothing re-arms.
    reply_timeout [s]: how long it may take over one request.
    """

    def __init__(self, backend: Backend, *, reply_timeout: float = REPLY_TIMEOUT) -> None:
        self._backend = backend
        self._reply_timeout = reply_timeout
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
            self._capabilities = await self._ask(
                GetCaps(), expect=Capabilities, timeout=OPEN_TIMEOUT
            )
            self._identity = identity
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
        return await self._ask(Ping(), expect=Status)

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
            where = "" if reply.channel is None else f" (channel {reply.channel})"
            raise CommandRefused(
                f"the amplifier refused {name}{where}: {_REASONS[reply.code]}",
                channel=reply.channel,
            )
        if not isinstance(reply, expect):
            raise FrameError(f"the amplifier answered {name} with {type(reply).__name__}")
        return reply

    async def _exchange(self, request: Request, kind: Kind, timeout: float) -> Reply:
        busy = 0
        while True:
            try:
                reply = await self._backend.exchange(request, timeout=timeout)
            except LinkTimeout as problem:
                # Counted across requests: a stream of superseded ones must not hide a dead link.
                self._unanswered += 1
                if self._unanswered > RETRIES:
                    what = f"{problem} ({self._unanswered} requests in a row were left unanswered)"
                    raise LinkTimeout(self._lose(what)) from problem
            except LinkError as problem:
                raise LinkError(self._lose(str(problem))) from problem
            else:
                self._unanswered = 0
                if busy == RETRIES or not _is_busy(reply):
                    return reply
                busy += 1
                await asyncio.sleep(BUSY_PAUSE)
            self._turns.raise_if_overtaken(kind)

    def _lose(self, what: str) -> str:
        self._loss = (
            f"{what}. Assume that the amplifier is energised until its watchdog has passed; once "
            "it is opened again it is disarmed"
        )
        return self._loss

    def _raise_if_lost(self) -> None:
        if self._loss is not None:
            raise LinkError(self._loss)


def _is_busy(reply: Reply) -> bool:
    return isinstance(reply, Nak) and reply.code is NakCode.BUSY


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
