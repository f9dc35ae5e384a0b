"""The lines of a host, as far as the control loop needs them."""

from typing import Protocol

from drivers.host.amplifier import Amplifier
from registry.limits import GuardLimits


class Lines(Protocol):
    """The open lines of a host, as `drivers.opening.Lines`."""

    async def amplifier(
        self,
        url: str,
        limits: GuardLimits,
        *,
        name: str,
        serial_number: str | None = None,
        is_output: bool | None = False,
    ) -> Amplifier:
        """Return the amplifier of a URL, its line open, nothing sent."""

    async def close(self) -> None:
        """Close all lines."""
