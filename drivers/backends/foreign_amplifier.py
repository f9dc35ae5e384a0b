"""Base of backends of amplifiers that know nothing of this protocol: laboratory instruments.

Such an amplifier has no states, sets, tokens or watchdog. State and token are bookkeeping of the
host, which ends with it; what plays is read from the amplifier, for every status anew. It is of
class C: nothing here ends a vibration when the host has died.
"""

import asyncio
import math
from abc import abstractmethod
from collections.abc import Sequence

from drivers.backends.host_lock import HostLock
from drivers.backends.wire_backend import WireBackend
from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandError, LinkTimeout
from drivers.guard import require_safe
from drivers.protocol.messages import (
    Achieved,
    AmplifierState,
    Apply,
    Arm,
    Capabilities,
    Clear,
    Disarm,
    Fault,
    FaultList,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    Identity,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    Status,
    Stop,
)

REPLY_TIME = 0.5
"""Time [s] that an instrument may take for an exchange, relays included."""

STOP_TIME = 0.09
"""Time [s] that it may take for a Stop or Disarm, reading back included; then it is repeated.

Three fit into the time within which a stop is confirmed.
"""

_LATCHES = 255


class ForeignAmplifier(WireBackend):
    """A backend by six methods of what is different: see their docstrings.

    address: of the instrument, the same for every program on this machine: one of them arms it,
    until it closes.
    """

    def __init__(self, address: str) -> None:
        super().__init__()
        self._host_lock = HostLock(address)
        self._state = AmplifierState.SWITCH_ON_DISABLED
        self._playing: tuple[CommandSet | None, Achieved] = None, Achieved(0, ())
        self._latch = 0

    async def close(self) -> None:
        """End the arming: other programs may arm it now. Subclasses also close their wire."""
        if self._state is AmplifierState.OPERATION_ENABLED:
            self._state = AmplifierState.SWITCH_ON_DISABLED
        self._host_lock.release()

    @abstractmethod
    async def identify(self) -> Identity:
        """Read who it is; changes nothing."""

    @abstractmethod
    def capabilities(self) -> Capabilities:
        """What it can play; without Feature.WATCHDOG, STAGING and VALID_FOR."""

    @abstractmethod
    async def prepare(self) -> None:
        """Silence it, and set it up for sines. Raises CommandRefused."""

    @abstractmethod
    async def play(self, commands: Sequence[DriveCommand]) -> Sequence[DriveCommand]:
        """Play these and nothing else; returns what it plays, by its own account.

        Raises CommandRefused, silent then.
        """

    @abstractmethod
    async def silence(self) -> None:
        """Switch all outputs off. Whether they are is read by `levels`."""

    @abstractmethod
    async def levels(self) -> Sequence[float]:
        """Read the level of each channel: 0 only for an output that is off."""

    @property
    def carries_sessions(self) -> bool:
        """No: it serves whoever is connected."""
        return False

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Carry out a request by the methods of the subclass.

        A Stop or Disarm silences whatever plays, then raises LinkError if another program on this
        machine may play again.

        ValueError or LookupError, which words that are no numbers raise, mean a damaged reply: the
        request is repeated.
        """
        require_safe(request)
        limit = max(timeout, STOP_TIME if isinstance(request, Stop | Disarm) else REPLY_TIME)
        try:
            async with asyncio.timeout(limit):
                return await self._carry_out(request)
        except (LinkTimeout, CommandError):
            raise
        except TimeoutError:
            raise LinkTimeout(
                f"no reply within {limit:g} s; check that the amplifier is switched on, and its "
                "address"
            ) from None
        except (ValueError, LookupError) as error:  # of what was read
            self._counters.invalid_frames += 1
            raise LinkTimeout(f"damaged reply ({error}); check the line") from error

    async def _carry_out(self, request: Request) -> Reply:
        """Return the reply to a request."""
        is_enabled = self._state is AmplifierState.OPERATION_ENABLED
        is_latched = self._state is AmplifierState.QUICK_STOP_ACTIVE
        match request:
            case Hello():
                return await self.identify()
            case GetCaps():
                return self.capabilities()
            case GetFaults():
                return FaultList(())
            case Apply(command_set=requested):
                return await self._apply(requested) if is_enabled else Nak(NakCode.WRONG_STATE)
            case Arm():
                if is_latched:
                    return Nak(NakCode.WRONG_STATE)
                if not is_enabled:
                    self._host_lock.acquire()
                    await self.prepare()
                    self._playing = None, Achieved(0, ())
                    self._state = AmplifierState.OPERATION_ENABLED
            case Disarm():
                if is_enabled:
                    self._state = AmplifierState.SWITCH_ON_DISABLED
                await self.silence()
                self._host_lock.require_free()
            case Stop():
                self._latch = self._latch % _LATCHES + 1
                self._state = AmplifierState.QUICK_STOP_ACTIVE
                await self.silence()
                self._host_lock.require_free()
            case Clear(latch=latch):
                if is_latched and latch != self._latch:
                    return Nak(NakCode.WRONG_LATCH)
                if is_latched:
                    self._state = AmplifierState.SWITCH_ON_DISABLED
            case GetStatus() | Ping():
                pass
            case _:
                return Nak(NakCode.UNKNOWN_TYPE)
        return await self._status()

    async def _apply(self, requested: CommandSet) -> Achieved:
        """Play a set, unless it is the one that plays."""
        playing, achieved = self._playing
        if playing is not None and playing == requested:
            return achieved
        self._playing = None, Achieved(0, ())
        achieved = Achieved(requested.token, tuple(await self.play(requested.commands)))
        self._playing = requested, achieved
        return achieved

    async def _status(self) -> Status:
        """Return the status: levels read from the amplifier; armed if another program may play."""
        levels = tuple(await self.levels())
        is_armed_elsewhere = self._host_lock.is_held_elsewhere
        state = AmplifierState.OPERATION_ENABLED if is_armed_elsewhere else self._state
        return Status(
            state=state,
            fault=Fault.NONE,
            token=self._playing[1].token,
            high_voltage=state is AmplifierState.OPERATION_ENABLED or any(levels),
            temperature=math.nan,
            watchdog_left=0.0,
            levels=levels,
            latch=self._latch,
        )
