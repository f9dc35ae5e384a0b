"""Errors of the driver layer, and the counters of a wire.

    DriverError
    ├── LinkError (ConnectionError)       the wire or the amplifier on it cannot be reached
    │   ├── WrongAmplifier                another one replies, or several, or for another host
    │   └── LinkTimeout (TimeoutError)    no reply in time
    │       └── LinkDegraded              no reply to several requests; the link may recover
    ├── FrameError                        bytes that are not a valid message; the amplifier's fault
    ├── CommandRefused                    refused by the amplifier or the guard
    │   └── Preempted                     not sent or not repeated: another request came first
    │       └── Overtaken                 a set that gave way before any amplifier was to play it
    └── CommandError (ValueError)         an invalid request; the caller's fault

Backends translate exceptions of their libraries into these and keep the cause.
"""

import re
from dataclasses import dataclass


class DriverError(Exception):
    """Base class of the driver layer's errors."""


class LinkError(DriverError, ConnectionError):
    """The wire, the adapter or the amplifier on it cannot be reached."""

    lost: tuple[str, ...] = ()
    """Names of the lost amplifiers, if several are driven and these are known."""


class WrongAmplifier(LinkError):
    """Another amplifier, or one driven by another host, replies; the text has the remedy."""


class LinkTimeout(LinkError, TimeoutError):
    """The amplifier did not reply in time."""


class LinkDegraded(LinkTimeout):
    """No reply to several requests in a row; the amplifier may still play its last set.

    It is lost once its watchdog must have expired, and usable again as soon as it replies.
    """


class FrameError(DriverError):
    """Bytes that are not a valid message."""


class CommandRefused(DriverError):
    """The guard or the amplifier rejected a request; no part of it was applied.

    channel: the channel at fault, if any; until: time [s] from which the same request is allowed,
    if only its time is wrong. may_play: whether it may have been carried out nevertheless, since an
    earlier attempt had no reply. is_disarmed: whether the amplifier is not armed by this host any
    more.
    """

    def __init__(
        self,
        reason: str,
        *,
        channel: int | None = None,
        until: float | None = None,
        may_play: bool = False,
        is_disarmed: bool = False,
    ) -> None:
        super().__init__(reason)
        self.channel = channel
        self.until = until
        self.may_play = may_play
        self.is_disarmed = is_disarmed


class Preempted(CommandRefused):
    """A request that was preempted or superseded by another one."""


class Overtaken(Preempted):
    """A set that was preempted before any amplifier played it: current playback continues."""


class CommandError(DriverError, ValueError):
    """An invalid request: bad URL, unknown channel, value out of range."""


def system_message(error: BaseException) -> str:
    """Return the operating system's message of an error, without its number."""
    return re.sub(r"^.*\[Errno -?\d+\] ", "", str(error), flags=re.DOTALL)


@dataclass
class WireCounters:
    """Frames counted by a backend since its wire was opened.

    invalid_frames: frames with a wrong checksum, length, form or version, and events that cannot be
    decoded; unexpected_frames: valid frames that no request was waiting for, such as late replies;
    events: unsolicited messages. remark: what came last since a request in place of its reply, and
    what to check.
    """

    frames_out: int = 0
    frames_in: int = 0
    invalid_frames: int = 0
    unexpected_frames: int = 0
    events: int = 0
    remark: str = ""
