"""Counters and timing of a link."""

from dataclasses import dataclass


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


@dataclass
class LinkStatistics(WireCounters):
    """Statistics of a link at one moment.

    Inherited counters restart when the link is opened, the following count since its construction.
    retries: repeated requests; timeouts: requests without a reply in time; refusals: Naks.
    last_round_trip [s].
    """

    retries: int = 0
    timeouts: int = 0
    refusals: int = 0
    last_round_trip: float | None = None
