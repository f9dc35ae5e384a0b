"""Outcomes of a check, and the expectations that raise them.

A check passes, or ends with one of three outcomes: a violation of the contract, not applicable, or
too late (this machine missed a deadline).
"""

from collections.abc import Callable, Collection, Sized
from typing import TypeVar

from drivers.protocol.records import Refusal

_T = TypeVar("_T")


class CheckOutcome(Exception):
    """Ends the steps of a check; this class itself means that nothing is wrong.

    actual, expected: of a violation. last_set: the last set before it, in words and hexadecimal.
    last_bytes: the last bytes received from the amplifier.
    """

    actual = ""
    expected = ""
    last_set = ""
    last_bytes = ""


class ContractViolation(CheckOutcome):
    """The amplifier violates the contract; holds the quantity, its expected and actual value."""

    def __init__(self, quantity: str, *, expected: object, actual: object) -> None:
        expected_text = _text_of(expected)
        actual_text = _text_of(actual)
        self.expected = expected_text
        self.actual = f"{quantity}: {actual_text}"
        super().__init__(f"{quantity} must be {expected_text}, got {actual_text}")


class NoReply(ContractViolation):
    """The amplifier did not reply in time; holds the request and the bytes received instead."""

    def __init__(self, request: str, observation: str) -> None:
        super().__init__(request, expected="a reply", actual=observation)
        self.args = (self.actual,)


class LateReply(NoReply):
    """The reply came after its time, delayed on the way, by this machine or by the amplifier."""


class AlreadyArmed(ContractViolation):
    """The amplifier is armed already, perhaps by another host: nothing is driven."""


class UntimedClock(ContractViolation):
    """The amplifier's clock does not follow time, so playback cannot be judged."""


class NotApplicable(CheckOutcome):
    """The amplifier or its wire lacks an optional feature that the check needs."""


class UnusableCapability(CheckOutcome):
    """A capability that the check needs is invalid; its own check reports this."""


class TooLate(CheckOutcome):
    """This machine was too late for the check, which must be repeated."""


def require(is_possible: bool, reason: str) -> None:
    """Raise NotApplicable, with the reason, if the check is impossible."""
    if not is_possible:
        raise NotApplicable(reason)


def require_in_time(is_in_time: bool, reason: str) -> None:
    """Raise TooLate, with the reason, if this machine was late."""
    if not is_in_time:
        raise TooLate(reason)


def verify(condition: bool, quantity: str, *, expected: object, actual: object) -> None:
    """Raise ContractViolation unless the condition holds."""
    if not condition:
        raise ContractViolation(quantity, expected=expected, actual=actual)


def expect_equal(actual: object, expected: object, quantity: str) -> None:
    """Raise ContractViolation unless both are equal."""
    verify(actual == expected, quantity, expected=expected, actual=actual)


def expect_within(actual: float, low: float, high: float, quantity: str) -> None:
    """Raise ContractViolation unless a number is within limits (inclusive)."""
    limits = f"{low:.6g} to {high:.6g}"
    verify(low <= actual <= high, quantity, expected=limits, actual=f"{actual:.6g}")


def expect_one_of(actual: object, choices: Collection[object], quantity: str) -> None:
    """Raise ContractViolation unless a value is one of the choices."""
    verify(actual in choices, quantity, expected=" or ".join(map(str, choices)), actual=actual)


def read_as(quantity: str, read: Callable[..., _T], *arguments: object, **options: object) -> _T:
    """Return the value that `read` returns; raises ContractViolation if it cannot be parsed."""
    try:
        return read(*arguments, **options)
    except Refusal as error:
        raise ContractViolation(quantity, expected="as in the table", actual=error) from None


def _text_of(value: object) -> str:
    """Return a value as text; "none" for an empty collection or text."""
    is_empty = isinstance(value, Sized) and not value
    return "none" if is_empty else str(value)
