"""A port on another one, whose bytes it changes or delays."""

from drivers.hardware import Port


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
