"""Amplifiers whose phases count from one moment."""

from collections.abc import Mapping
from itertools import pairwise

from drivers.amplifier import Amplifier
from drivers.errors import CommandError
from drivers.protocol.messages import Feature


def start_together(one: Amplifier, other: Amplifier) -> bool:
    """Whether phases of two open amplifiers count from one moment: that of a broadcast commit."""
    if one is other:
        return True
    buses = {one.bus, other.bus}
    return (
        len(buses) == 1
        and None not in buses
        and all(
            {Feature.BROADCAST, Feature.STAGING} <= {*each.capabilities.features}
            for each in (one, other)
        )
    )


def check_common_start(amplifiers: Mapping[str, Amplifier]) -> None:
    """Raise CommandError unless all open amplifiers, by name, start together."""
    for (name, one), (other_name, other) in pairwise(amplifiers.items()):
        if not start_together(one, other):
            raise CommandError(
                f"amplifiers {name} and {other_name} must start together to be measured while "
                "they play, got separate wires or no broadcast commit; put them on one bus"
            )
