"""Counters of a wire."""

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
