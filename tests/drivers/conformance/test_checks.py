"""The checks of conformance: their order, the pages that they cite, the faults that they find."""

import re

import pytest

from drivers.conformance import CHECKS
from vocabulary import ROOT


def test_every_check_has_a_planted_fault() -> None:
    """One that it must find on every wire, except those that others cannot pass without."""
    text = "".join(path.read_text("utf-8") for path in (ROOT / "tests" / "faults").glob("*.yaml"))
    found = set(re.findall(r"one_check\.py::test_check\[[^]]*?-(\w+)\]", text))
    assert {check.name for check in CHECKS} - found == {
        "starts_disarmed",
        "reading_changes_nothing",
        "cancelled_requests",
        "vanished_host",  # in test_vanished_host.py
    }


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
