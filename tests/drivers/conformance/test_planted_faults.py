"""Conformance finds faults that are planted into the simulated amplifier and its far ends."""

import re

import pytest

from conformance_bench import result_of
from drivers.conformance import CHECKS, Result
from model.rig.rig import Rig
from planted_faults import ALL, FAULTS, UNSEEN
from vocabulary import ROOT

# Each fault on one of its wires in turn; `make conformance-faults` takes all.
CASES = [
    pytest.param(name, fault.wires[number % len(fault.wires)], id=name)
    for number, (name, fault) in enumerate(FAULTS.items())
]


@pytest.mark.parametrize(("name", "wire"), CASES)
def test_planted_fault_is_found(name: str, wire: str, coarse_rig: Rig) -> None:
    """The named check fails, and says what it saw and what it expected."""
    result = result_of(FAULTS[name], wire, coarse_rig)
    assert result.result is Result.FAILED, result
    assert result.seen
    assert result.expected


def test_every_check_has_a_fault() -> None:
    """Except those that others cannot pass without; forty faults and more, on every wire."""
    found = {fault.check for fault in FAULTS.values()}
    untested = {check.name for check in CHECKS} - found
    assert untested == {
        "starts_disarmed",
        "reading_changes_nothing",
        "cancelled_requests",
        "vanished_host",  # in test_vanished_host.py
    }
    for wire in ALL:
        assert sum(wire in fault.wires for fault in FAULTS.values()) >= 40
    assert all(fault.unseen for fault in UNSEEN.values())


def test_reading_checks_come_first() -> None:
    """They precede those that drive outputs."""
    drives = [check.drives for check in CHECKS]
    assert drives == sorted(drives)
    assert drives.count(False) >= 4


@pytest.mark.parametrize("check", CHECKS, ids=[check.name for check in CHECKS])
def test_check_cites_headings_of_pages(check: object) -> None:
    """Each place is a page of the reference and a heading on it."""
    for place in check.places:  # type: ignore[attr-defined]
        page, _, anchor = place.partition("#")
        text = (ROOT / "docs" / "reference" / page).read_text(encoding="utf-8")
        titles = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
        anchors = {re.sub(r"[^a-z0-9 -]", "", one.lower()).replace(" ", "-") for one in titles}
        assert anchor in anchors
