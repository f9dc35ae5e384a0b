"""Amplifiers whose phases count from one moment."""

from collections.abc import Mapping
from itertools import pairwise

from drivers.errors import CommandError
from drivers.host.amplifier import Amplifier


def start_together(one: Amplifier, other: Amplifier) -> bool:
    """Whether phases of two amplifiers count from one moment: that of a broadcast commit."""
    return one.line is other.line


def check_common_start(amplifiers: Mapping[str, Amplifier]) -> None:
    """Raise CommandError unless all open amplifiers, by name, start together."""
    for (name, one), (other_name, other) in pairwise(amplifiers.items()):
        if not start_together(one, other):
            raise CommandError(
                f"amplifiers {name} and {other_name} must start together to be measured while "
                "they play, got separate wires; put them on one bus"
            )
