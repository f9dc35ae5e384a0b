"""What can go wrong between the controller and an amplifier.

    DriverError
    ├── LinkError (ConnectionError)       the wire or the far end is gone, or not what it was
    │   └── LinkTimeout (TimeoutError)    no answer in time
    ├── FrameError                        bytes that are no valid message; the far end's fault
    ├── CommandRefused                    the amplifier or the guard said no
    └── CommandError (ValueError)         a request that makes no sense; the caller's fault

Third-party exceptions are translated into these where a backend meets its library, cause kept.
"""

import re


class DriverError(Exception):
    """Anything that the driver layer raises on purpose."""


class LinkError(DriverError, ConnectionError):
    """The wire, the adapter or the amplifier on it cannot be reached."""


class LinkTimeout(LinkError, TimeoutError):
    """The amplifier did not answer in time."""


class FrameError(DriverError):
    """Bytes that do not make a valid message."""


class CommandRefused(DriverError):
    """The guard or the amplifier refused a request; nothing of it was applied.

    channel: the one to blame, where one is; until: when [s] the same may be asked for again, where
    that is all that is wrong with it.
    """

    def __init__(
        self, reason: str, *, channel: int | None = None, until: float | None = None
    ) -> None:
        super().__init__(reason)
        self.channel = channel
        self.until = until


class CommandError(DriverError, ValueError):
    """A request that makes no sense: bad URL, unknown channel, value out of range."""


def said_by_system(problem: BaseException) -> str:
    """What the system says of a port or a connection, once and without its number."""
    return re.sub(r"^.*\[Errno -?\d+\] ", "", str(problem), flags=re.DOTALL)
