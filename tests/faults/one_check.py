"""One conformance check of the simulated amplifier on one wire, in virtual time.

Run by the judge of planted faults only: the suite has all checks in turn in
`test_sound_amplifiers.py`.
"""

import pytest

from conformance_bench import ALL, results_on
from drivers.conformance import CHECKS, LEVEL, Check, Result
from model.rig.rig import Rig


def _violation(check: Check, wire: str, rig: Rig, *, level: float = LEVEL) -> str:
    """What a check saw and what it expected, if it failed."""
    (result,) = results_on(wire, rig, [check], level=level)
    return f"seen {result.seen}; expected {result.expected}" * (result.result is Result.FAILED)


@pytest.mark.parametrize("check", CHECKS, ids=[check.name for check in CHECKS])
@pytest.mark.parametrize("wire", ALL)
def test_check(check: Check, wire: str, coarse_rig: Rig) -> None:
    """The check finds no violation."""
    violation = _violation(check, wire, coarse_rig)
    assert not violation, violation


@pytest.mark.parametrize("wire", ALL)
def test_levels_at_half_of_full_stroke(wire: str, coarse_rig: Rig) -> None:
    """The check of levels finds no violation where it drives higher than usual."""
    (check,) = [one for one in CHECKS if one.name == "levels_of_every_frequency"]
    violation = _violation(check, wire, coarse_rig, level=0.5)
    assert not violation, violation
