"""One conformance check of an amplifier on one wire, in virtual time.

Run by the judge of planted faults only: the suite has all checks in turn in
`tests/era_haptics/lab/conformance`; `long` are those that `make test` has not. Faults of a
simulated amplifier are found on it; those of `drivers.playing`, which conformance asks what must be
played, on the firmware, which does not.
"""

from functools import partial
from pathlib import Path

import pytest

from cases import shortly
from era_haptics.lab.conformance.conformance_report import Result
from era_haptics.lab.conformance.contract import CHECKS, of_kind
from kit.judged_lines import (
    JUDGED_LINE_KINDS,
    judged,
    plain,
    short_checks,
)
from tests.firmware.firmware_machine import FirmwareEnd, build_firmware

_CASES = [
    pytest.param(
        *(kind, check.name),
        id=f"{kind}-{check.name}",
        marks=[] if check.name in short_checks(kind) else pytest.mark.long,
    )
    for kind in JUDGED_LINE_KINDS
    for _, check in of_kind(kind)
]
_OF_ANY_WIRE = [check.name for check in CHECKS if not check.kinds]
_OF_SERIAL_LINES = [check.name for _, check in of_kind("serial")]


def _violation(kind: str, name: str, level: float = 0.3, **options: bool) -> str:
    far = plain() if options.get("is_plain") else None
    (result,) = judged(kind, [name], level=level, far=far)
    return result.reason * (result.result is Result.FAILED)


@pytest.mark.parametrize(("kind", "name"), _CASES)
def test_check(kind: str, name: str) -> None:
    """The check finds no violation."""
    violation = _violation(kind, name)
    assert not violation, violation


@pytest.mark.parametrize("name", shortly(_OF_ANY_WIRE, ["limited", "voices"]))
def test_loud(name: str) -> None:
    """It finds none where it drives at nearly full level."""
    violation = _violation("serial", name, 0.9)
    assert not violation, violation


@pytest.mark.long
@pytest.mark.parametrize("name", _OF_ANY_WIRE)
def test_plain(name: str) -> None:
    """It finds none on an amplifier with all that the table allows."""
    violation = _violation("serial", name, is_plain=True)
    assert not violation, violation


@pytest.fixture(scope="module")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the firmware on a moved clock."""
    return build_firmware(tmp_path_factory.mktemp("firmware"), "era-moved.so")


@pytest.mark.parametrize("name", _OF_SERIAL_LINES)
def test_firmware(name: str, firmware: Path) -> None:
    """It finds none on the firmware, whose playback is its own."""
    (verdict,) = judged("serial", [name], far=partial(FirmwareEnd, "serial", firmware))
    violation = verdict.reason * (verdict.result is Result.FAILED)
    assert not violation, violation
