"""What a check can find: a violation, too little evidence, or nothing to check."""


class ContractViolation(Exception):
    """The amplifier does not behave as its page says.

    is_certain: whether no delay of this program or the wire can have made it appear so.
    """

    def __init__(
        self,
        what: str,
        *,
        expected: object,
        seen: object,
        is_certain: bool = False,
    ) -> None:
        self.is_certain = is_certain
        super().__init__(f"{what} must be {expected}, got {seen}")
        self.expected = str(expected)
        self.seen = f"{what}: {seen}"


class Inconclusive(Exception):
    """What was seen does not suffice to pass or to fail, as where this host was delayed."""


class LinkGone(Inconclusive):
    """The link was lost and could not be opened again."""


class NotApplicable(Exception):
    """The amplifier, or its wire, does not have what is checked."""


class MeasuredNotApplicable(NotApplicable):
    """There is nothing to check, as measured: it counts only if nothing was delayed."""


def expect(
    condition: bool, what: str, *, expected: object, seen: object, is_certain: bool = False
) -> None:
    """Raise ContractViolation unless the condition holds; is_certain: see there."""
    if not condition:
        raise ContractViolation(what, expected=expected, seen=seen, is_certain=is_certain)
