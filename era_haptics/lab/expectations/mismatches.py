"""Receivers of differences between an amplifier and the expectation."""

from collections.abc import Callable, Iterable
from typing import Protocol, TypeAlias


class ReportMismatch(Protocol):
    """Receives a violation: rule, time [s], quantity, expected and actual value."""

    def __call__(
        self, rule: str, time: float, quantity: str, *, expected: object, actual: object
    ) -> None:
        """Report it."""


ReportUnclear: TypeAlias = Callable[[str], None]
"""Receives the reason why the output is unclear: two events were too close together."""


def alternatives(values: Iterable[object]) -> str:
    """Format the allowed values."""
    return " or ".join(map(str, values))
