"""How well a link does: what was counted on it, and how long its answers take."""

from dataclasses import dataclass


@dataclass
class WireCounters:
    """What a backend has seen on its wire since it was opened, in frames (or telegrams).

    bad: damaged ones, by checksum, length or form; foreign: good ones that nobody waited for, late
    or of somebody else; events: what came unasked.
    """

    frames_out: int = 0
    frames_in: int = 0
    bad: int = 0
    foreign: int = 0
    events: int = 0


@dataclass(frozen=True, slots=True)
class LinkStatistics:
    """The state of a link, as one moment sees it.

    Frames as in `WireCounters`. retries: requests that were repeated; timeouts: requests that got
    no answer in time; refusals: Naks. last_round_trip [s], heartbeat_age [s] since the last
    heartbeat was answered: None before the first.
    """

    frames_out: int
    frames_in: int
    bad: int
    foreign: int
    events: int
    retries: int
    timeouts: int
    refusals: int
    last_round_trip: float | None
    heartbeat_age: float | None
