"""Classes of amplifiers by what they have, and what the host does without each of it.

A has everything, B lacks what class A needs but has a watchdog, C has no watchdog.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from drivers.protocol.messages import Capabilities, Feature


class AmplifierClass(StrEnum):
    """Class of an amplifier."""

    A = "A"
    B = "B"
    C = "C"


AMPLE_VOICES = 8
"""So many that no set every 10 ms waits, along ramps of 50 ms."""


@dataclass(frozen=True)
class Lack:
    """What an amplifier may lack, its class then, and what controller, daemon and promise do.

    lacked: a feature, or whether an amplifier lacks what has no bit.
    """

    name: str
    lacked: Feature | Callable[[Capabilities], bool]
    highest_class: AmplifierClass
    controller: str
    daemon: str
    promise: str

    def is_in(self, capabilities: Capabilities) -> bool:
        """Whether an amplifier lacks it."""
        if isinstance(self.lacked, Feature):
            return self.lacked not in capabilities.features
        return self.lacked(capabilities)


LACKS = (
    Lack(
        "watchdog",
        Feature.WATCHDOG,
        AmplifierClass.C,
        "sends heartbeats all the same; nothing ends the vibration when they cease",
        "refuses it without `supervised: true`; shows class C; a stop that is not confirmed lasts "
        "until it is switched off",
        "unchanged",
    ),
    Lack(
        "staging",
        Feature.STAGING,
        AmplifierClass.B,
        "applies; several amplifiers start one after the other, so one ERA plays at a time",
        "shows the class",
        "of one ERA at one frequency, if there are several amplifiers",
    ),
    Lack(
        "envelopes",
        lambda capabilities: not capabilities.envelope_knots,
        AmplifierClass.B,
        "plays ramps",
        "shows the class",
        "of ramps: less contrast while a vibration begins and ends",
    ),
    Lack(
        "ramps",
        lambda capabilities: not capabilities.ramp_max,
        AmplifierClass.B,
        "starts and ends at once",
        "shows the class",
        "of abrupt starts: nearly no contrast while a vibration begins and ends",
    ),
    Lack(
        "cross-fades",
        lambda capabilities: not capabilities.has_cross_fades,
        AmplifierClass.B,
        "fades out before another frequency fades in",
        "shows the class",
        "of ramps, each change later by the fade of the one before",
    ),
    Lack(
        "valid_for",
        Feature.VALID_FOR,
        AmplifierClass.B,
        "ends effects itself; refuses limits of on-time and duty",
        "shows the class; the event `silence` says how late",
        "levels over a duration hold as far as effects end in time",
    ),
    Lack(
        "phase",
        Feature.PHASE,
        AmplifierClass.B,
        "asks the table for `switched` and one ERA at a time",
        "shows the class; refuses another `mode`",
        "of one ERA at one frequency",
    ),
    Lack(
        "broadcast",
        Feature.BROADCAST,
        AmplifierClass.A,
        "commits and stops each amplifier of a line by itself",
        "nothing",
        "unchanged; several amplifiers of a line start one after the other",
    ),
    Lack(
        f"{AMPLE_VOICES} voices",
        lambda capabilities: capabilities.voices < AMPLE_VOICES,
        AmplifierClass.A,
        "holds the newest pattern back until a channel has a voice for it",
        "nothing",
        "unchanged; with two voices a pattern begins up to a ramp later",
    ),
)
"""What amplifiers may lack, the gravest first."""


def amplifier_class(capabilities: Capabilities) -> AmplifierClass:
    """Return the class of an amplifier."""
    return max((lack.highest_class for lack in missing(capabilities)), default=AmplifierClass.A)


def missing(capabilities: Capabilities) -> tuple[Lack, ...]:
    """Return what an amplifier lacks."""
    return tuple(lack for lack in LACKS if lack.is_in(capabilities))
