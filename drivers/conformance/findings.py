"""What a check finds: a violation of the contract, nothing to check, or that it came too late."""

from collections.abc import Collection


class Violation(Exception):
    """The amplifier does other than the contract: what must be what, and what was seen."""

    def __init__(self, what: str, *, expected: object, seen: object) -> None:
        self.expected, self.seen = str(expected), f"{what}: {seen}"
        super().__init__(f"{what} must be {expected}, got {seen}")


class Optional(Exception):
    """The amplifier, or its wire, does not have what is checked, as the contract allows."""


class Late(Exception):
    """This machine was too late for what the check needs: it must be made again."""


def expect(condition: bool, what: str, *, expected: object, seen: object) -> None:
    """Raise Violation unless the condition holds."""
    if not condition:
        raise Violation(what, expected=expected, seen=seen)


def expect_equal(seen: object, expected: object, what: str) -> None:
    """Raise Violation unless both are equal."""
    if seen != expected:
        raise Violation(what, expected=expected, seen=seen)


def expect_within(seen: float, low: float, high: float, what: str) -> None:
    """Raise Violation unless a number is within limits."""
    if not low <= seen <= high:
        raise Violation(what, expected=f"{low:.6g} to {high:.6g}", seen=f"{seen:.6g}")


def expect_one_of(seen: object, known: Collection[object], what: str) -> None:
    """Raise Violation unless something is known."""
    if seen not in known:
        raise Violation(what, expected=" or ".join(map(str, known)), seen=seen)
