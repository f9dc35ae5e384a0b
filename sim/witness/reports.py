"""What an amplifier reports of itself: texts of its identity, and its list of faults."""

import struct
from collections.abc import Sequence

from sim.witness.quantities import OutOfRange

Interval = tuple[float, float]
Faults = tuple[tuple[int, float], ...]
"""Faults, newest first, each with its age [s]."""

_MAX_TEXT = 32
_CLOCK = 0.01  # share of an age by which the clock of an amplifier may be wrong
_ROUNDING = 0.002  # s


def check_text(raw: bytes) -> None:
    """Check a text of an identity; raises OutOfRange."""
    if len(raw) > _MAX_TEXT:
        raise OutOfRange(f"text must have at most {_MAX_TEXT} bytes, got {len(raw)}")
    try:
        text = raw.decode()
    except UnicodeDecodeError:
        raise OutOfRange(f"text must be UTF-8, got {raw.hex(' ')}") from None
    if not text.isprintable():
        raise OutOfRange(f"text must not have control characters, got {text!r}")


def check_identity(payload: bytes) -> None:
    """Check an identity of versions and four texts with their lengths; raises OutOfRange."""
    at = 2
    for _ in range(4):
        if at >= len(payload) or at + 1 + payload[at] > len(payload):
            raise OutOfRange("identity must have four texts")
        check_text(payload[at + 1 : at + 1 + payload[at]])
        at += 1 + payload[at]


def unpack_faults(payload: bytes) -> Faults:
    """Decode a list of faults behind their number; raises OutOfRange."""
    if not payload or len(payload) < 1 + 6 * payload[0]:
        raise OutOfRange("fault list must have as many records as it says")
    return unpack_fault_records(payload[1 : 1 + 6 * payload[0]])


def unpack_fault_records(records: bytes) -> Faults:
    """Decode a list of faults of six bytes each; raises OutOfRange."""
    if len(records) % 6:
        raise OutOfRange(f"fault list must have six bytes for each fault, got {len(records)}")
    return tuple((fault, age / 1000) for fault, _, age in struct.iter_unpack("<BBL", records))


def faults_of_words(words: Sequence[int]) -> Faults:
    """Decode a list of faults from registers, as many as were read."""
    count = min(words[0], (len(words) - 1) // 4)
    groups = (words[1 + 4 * number : 5 + 4 * number] for number in range(count))
    return tuple((fault, (high << 16 | low) / 1000) for fault, _, high, low in groups)


def fault_list_problem(
    faults: Faults, when: Interval, *, present: int, since: Interval | None
) -> str | None:
    """Describe what is wrong with a list of faults that was read at some time between two [s].

    present: the fault that the amplifier is in, 0 for none; since: when it came, if that is known.
    """
    ages = [age for _, age in faults]
    if ages != sorted(ages):
        return f"lists faults of ages {ages} s, newest first"
    if not present:
        return None
    matching = [age for fault, age in faults if fault == present]
    if not matching:
        return f"is in fault {present}, which its list of faults does not have"
    if since is None:
        return None
    low, high = when[0] - since[1], when[1] - since[0]
    for age in matching:
        error = _ROUNDING + _CLOCK * age
        if low - error <= age <= high + error:
            return None
    return f"fault {present} must be {max(low, 0.0):.3f} to {high:.3f} s old, got {matching} s"
