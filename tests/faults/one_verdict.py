"""One conformance check of a simulated amplifier of protocol 3 on one wire, in virtual time.

Run by the judge of planted faults only: the suite has all checks in turn in
`tests/drivers/conformance`.
"""

import pytest

from drivers.conformance import CHECKS, Result, of_kind
from judged_line import KINDS, judged, plain

_CASES = [(kind, check.name) for kind in KINDS for _, check in of_kind(kind)]


def _violation(kind: str, name: str, level: float = 0.3, **options: bool) -> str:
    far = plain() if options.get("is_plain") else None
    (result,) = judged(kind, [name], level=level, far=far)
    return result.reason * (result.result is Result.FAILED)


@pytest.mark.parametrize(("kind", "name"), _CASES, ids=[f"{k}-{name}" for k, name in _CASES])
def test_check(kind: str, name: str) -> None:
    """The check finds no violation."""
    violation = _violation(kind, name)
    assert not violation, violation


@pytest.mark.parametrize("name", [check.name for check in CHECKS if not check.kinds])
def test_loud(name: str) -> None:
    """It finds none where it drives at nearly full level."""
    violation = _violation("serial", name, 0.9)
    assert not violation, violation


@pytest.mark.parametrize("name", [check.name for check in CHECKS if not check.kinds])
def test_plain(name: str) -> None:
    """It finds none on an amplifier with all that the table allows."""
    violation = _violation("serial", name, is_plain=True)
    assert not violation, violation


def test_run_ends_soon() -> None:
    """The whole run passes, within a minute of the amplifier's time."""
    results = judged("serial")
    failed = [f"{each.check.name}: {each.reason}" for each in results if each.result == "failed"]
    assert not failed, failed[0]
    assert sum(each.seconds for each in results) < 60
