"""The page of URLs, by the code that reads them."""

import re
from pathlib import Path

import pytest

from drivers.by_hand.cli import amp
from drivers.by_hand.rig_check import check_links
from drivers.errors import CommandError
from drivers.host.timing import BOOT_TIME
from drivers.wires.known import address_of
from registry.limits import GuardLimits

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "urls.md").read_text("utf-8")
EXAMPLES = re.findall(r"^\| `(\S+)` \| `(\S+)` \| (\d+) \|$", PAGE, re.MULTILINE)
SCHEMES = {url.partition("://")[0] for url, _, _ in EXAMPLES}


@pytest.mark.parametrize(("url", "line", "number"), EXAMPLES)
def test_example_is_the_amplifier_that_the_page_says(url: str, line: str, number: str) -> None:
    """Its line, and its number there."""
    address = address_of(url)
    assert (address.line, address.number) == (line, int(number))


def test_slowest_line_is_that_of_the_page() -> None:
    """As the check has it; the next slower speed is refused."""
    baud, bitrate = map(int, re.findall(r"at least (\d+) baud, or (\d+) kbit/s", PAGE)[0])
    slow = {
        "a": "serial:///dev/a?baud={}",
        "b": "modbus+rtu:///dev/b?baud={}",
        "c": "can+slcan:///c?bitrate={}",
    }
    for factor, refused in ((1, []), (2, [*slow])):
        speeds = {"a": baud // factor, "b": baud // factor, "c": bitrate * 1000 // factor}
        urls = {name: url.format(speeds[name]) for name, url in slow.items()}
        errors, _ = check_links(urls, channels={}, limits=GuardLimits(40.0, 250.0, 1.0))
        assert [*errors] == refused


def test_page_has_every_scheme_and_the_time_of_a_board() -> None:
    """Those that an unknown one is answered with, each in both tables; and in the help."""
    with pytest.raises(CommandError) as unknown:
        address_of("carrier+pigeon://roof")
    assert (
        set(re.findall(r"([\w+-]+)://[,\s]", f"{unknown.value} ")) - {"carrier+pigeon"} == SCHEMES
    )
    assert set(re.findall(r"^\| `([\w+-]+)://", PAGE, re.MULTILINE)) == SCHEMES
    assert set(re.findall(r"^  ([\w+-]+)://", str(amp.info.epilog), re.MULTILINE)) == SCHEMES
    assert f"for {BOOT_TIME:g} s" in PAGE
