"""Values that many checks compare, and what to change if they are wrong."""

import re
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SharedValue:
    """A value that many checks compare, and what to change if it is wrong.

    pattern: how a reason about it begins. anchors: of the headings in protocol.md whose checks
    have it as their subject, so that their own remedy applies; the first one has its rule.
    """

    name: str
    pattern: str
    anchors: tuple[str, ...]
    remedy: str

    @property
    def place(self) -> str:
        """Page and heading of its rule."""
        return f"protocol.md#{self.anchors[0]}"

    def is_in(self, reason: str) -> bool:
        """Whether a reason is about this value."""
        return re.match(self.pattern, reason) is not None


_PLAYING = ("layers", "ramps-and-envelopes", "voices", "sum-of-a-channel", "the-clock")
SHARED_VALUES = (
    SharedValue(
        "level of a channel",
        r"level of channel .* after set",
        ("readings", *_PLAYING, "start-of-a-set"),
        "In Status, show the amplitude that each channel has at `clock`, channel 0 first: the sum "
        "of the magnitudes of all its voices, during a ramp too.",
    ),
    SharedValue(
        "token of a layer",
        "token of layer",
        ("readings", *_PLAYING, "start-of-a-set", "sets"),
        "In Status, show the token of the set that each layer plays, 0 for a layer that is over.",
    ),
    SharedValue(
        "token",
        "token after",
        ("readings", "start-of-a-set", "sets", "parts-of-a-set"),
        "In Status, show the token committed last since Arm, or 0.",
    ),
    SharedValue(
        "exact",
        "exact of set",
        ("parts-of-a-set", "readings", "identity-and-capabilities"),
        "In Taken, set exact if the whole set plays without rounding, else state your steps.",
    ),
    SharedValue(
        "missing, staged, played",
        "missing, staged, played",
        ("parts-of-a-set", "start-of-a-set", "sets"),
        "In Taken, report the first missing part, or else that the set is staged or played.",
    ),
    SharedValue(
        "watchdog_left",
        "watchdog_left",
        ("sessions-and-the-watchdog",),
        "Count down from the time of Arm, restart with each request that feeds, and show the "
        "time left in ms; 0 unless armed.",
    ),
    SharedValue(
        "latch",
        "latch after",
        ("states",),
        "Give every Stop and every fault the next number of a 16-bit latch, and show it in Status.",
    ),
    SharedValue(
        "high_voltage",
        "high_voltage in",
        ("readings", "states"),
        "Set the flag high_voltage in the states 3 and 4, and in 5 until silent.",
    ),
    SharedValue(
        "state",
        "state .* s after",
        ("states", "sessions-and-the-watchdog"),
        "Compare your changes of state and their times with the tables of states and times.",
    ),
)
