"""What the URL of an amplifier says, whatever its wire: its line, and its number there."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping

from drivers.hardware import Port
from drivers.host.timing import TAKEN_WORDS, set_words
from drivers.host.wire import Wire


class WireAddress(ABC):
    """An amplifier on one kind of wire, made of its URL; CommandError for one that is invalid.

    line: name of the port, connection or bus, which amplifiers of one name share; settings: what
    they must agree in, by name; number: of the amplifier there.
    """

    line: str
    settings: Mapping[str, object]
    number: int

    @abstractmethod
    def __init__(self, url: str) -> None:
        """Parse a URL."""

    @abstractmethod
    def make_wire(self) -> Wire:
        """Make the host's side of the wire, without I/O."""

    def set_time(self, channels: int) -> float:
        """Return how long a set of these channels and its reply take [s]; 0 if unknown."""
        return self.make_wire().exchange_time(set_words(channels), TAKEN_WORDS)

    @abstractmethod
    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the port of the line, for this program alone if the system can; raises LinkError.

        on_data: called with what is received, as the wire takes it; on_loss: called once, with the
        cause.
        """
