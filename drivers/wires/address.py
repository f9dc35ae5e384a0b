"""What the URL of an amplifier says, whatever its wire, and ports that change or delay bytes."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping

from drivers.errors import LinkError
from drivers.ports import Port
from drivers.wires.wire import Wire


class WireAddress(ABC):
    """An amplifier on one kind of wire, made of its URL; CommandError for one that is invalid.

    line: name of the port, connection or bus, which amplifiers of one name share; settings: what
    they must agree in, by name; number: of the amplifier there.
    """

    line: str
    settings: Mapping[str, object]
    number: int
    boot_time: float = 0.0
    """How long what is behind the port may take to start once that is opened [s]."""

    @abstractmethod
    def __init__(self, url: str) -> None:
        """Parse a URL."""

    @abstractmethod
    def make_wire(self) -> Wire:
        """Make the host's side of the wire, without I/O."""

    def check_agrees(self, settings: Mapping[str, object]) -> None:
        """Raise LinkError unless its settings are those of the others on its line."""
        for setting, value in settings.items():
            if (got := self.settings.get(setting)) != value:
                raise LinkError(
                    f"{self.line}: {setting} must be {value} as for the other amplifiers on it, "
                    f"got {got}"
                )

    @abstractmethod
    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the port of the line, for this program alone if the system can; raises LinkError.

        on_data: called with what is received, as the wire takes it; on_loss: called once, with the
        cause.
        """


class PortAbove:
    """What a port on another one, below, leaves as it is; see `Port`."""

    below: Port
    """Set once it is open."""

    @property
    def is_blocked(self) -> bool:
        """Whether it has not taken all bytes yet."""
        return self.below.is_blocked

    def poll(self) -> None:
        """Hand over what has come and was not read yet."""
        self.below.poll()

    def close(self) -> None:
        """Close it; no callback is called afterwards."""
        self.below.close()

    async def wait_closed(self) -> None:
        """Wait until it is closed."""
        await self.below.wait_closed()
