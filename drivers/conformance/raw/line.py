"""Raw access to a line: frames that no backend sends, and what comes back."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from drivers.protocol.messages import Apply, Broadcast, Ping, SetAddress, Stage

NO_REPLY = "no reply"
REPLY = "a reply"


@dataclass(frozen=True)
class RawRequest:
    """A request as bytes or frames, sent in pieces with a pause [s] in between.

    name: what is wrong with it; allowed: the outcomes that the page allows: NO_REPLY, REPLY, or
    names of refusals; lasts [s]: how long the amplifier may wait for more of it.
    """

    name: str
    pieces: Sequence[object]
    allowed: frozenset[str]
    pause: float = 0.0
    lasts: float = 0.0


class RawLine(ABC):
    """The line of an open amplifier, used between the exchanges of its backend.

    page: that defines its wire; url, address: of the amplifier.
    """

    page: ClassVar[str]
    url: str

    @property
    @abstractmethod
    def address(self) -> int:
        """Its address on the line."""

    @abstractmethod
    async def send(self, request: RawRequest) -> str:
        """Send a request and wait for its outcome, one like those in `allowed`."""

    @abstractmethod
    async def send_only(self, request: RawRequest) -> None:
        """Send a request and wait until the line is free again, for no reply."""

    @abstractmethod
    def invalid(self, ping: Ping, apply: Apply) -> Sequence[RawRequest]:
        """Make requests that must have no effect, from valid ones of the session that is held."""

    @abstractmethod
    def tolerated(self, ping: Ping) -> Sequence[RawRequest]:
        """Make unusual requests that must be replied to, some behind noise or half a frame."""

    @abstractmethod
    def broadcasts(self, ping: Ping, apply: Apply) -> Sequence[RawRequest]:
        """Make broadcasts that must be discarded."""

    def in_any_order(self, stage: Stage) -> Sequence[RawRequest]:
        """Make a valid request of several frames in other orders; none if it is one frame."""
        return ()

    def address_requests(self, own: SetAddress, other: SetAddress) -> Sequence[RawRequest]:
        """Make SetAddress that do nothing, of its serial number to its own address and of another.

        None where an address is set by broadcasts alone.
        """
        return ()

    @abstractmethod
    def stop_out_of_range(self) -> RawRequest:
        """Make a Stop with the largest ramp that its field holds."""

    @abstractmethod
    def carried_out(self, request: Broadcast) -> RawRequest:
        """Make a broadcast that must be carried out without a reply."""
