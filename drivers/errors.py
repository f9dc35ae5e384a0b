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
`host/group_states.py` lists how a group of amplifiers reacts to each.
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
    """The guard or the amplifier rejected a request; nothing was applied.

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


_NOT_ARMED = ("WRONG_STATE", "WRONG_SESSION")
_REMEDIES = {
    "WRONG_SESSION": "; another host has armed it, or armed it last: disarm, then arm again",
    "WRONG_STATE": "; find the cause with `era amp status`, then clear and arm again",
}


def refused_by_amplifier(
    where: str, code: str, channel: int | None, *, may_play: bool
) -> CommandRefused:
    """Return the error of a request that an amplifier refused by a Nak with this code and channel.

    where: the line and the amplifier, as the message begins. may_play: see `CommandRefused`.
    """
    at_channel = "" if channel is None else f", channel {channel}"
    return CommandRefused(
        f"{where}: the amplifier refused the request: {code}{at_channel}" + _REMEDIES.get(code, ""),
        channel=channel,
        may_play=may_play,
        is_disarmed=code in _NOT_ARMED,
    )


def no_reply(
    where: str, name: str, timeout: float, remark: str, *, before: float, boot_time: float
) -> str:
    """Return why the request with this name had no reply within a timeout [s].

    where: the line, as the message begins. remark: what arrived instead. before: how long the
    previous reply took [s]. boot_time: how long a board may take to boot [s] if its port was
    opened just now, else 0.
    """
    if not remark and before > timeout:
        remark = f"the previous reply took {1e3 * before:.0f} ms: find the cause of the delay"
    hint = "check that the amplifier is switched on"
    if name == "GetCaps":  # sent after a reply to Hello
        hint = "it answered Hello, but not GetCaps"
    came = f", but {remark}" if remark else f"; {hint}"
    cause = f"{where}: no reply within {1e3 * timeout:g} ms{came}"
    if boot_time:
        cause += (
            f". A board that restarts when its port is opened must reply within {boot_time:g} s; "
            "if it takes longer, disable the restart"
        )
    return cause


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
