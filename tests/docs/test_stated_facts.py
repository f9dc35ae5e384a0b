"""What pages state and something else decides: constants, URLs, figures of other pages, files."""

import re
from pathlib import Path

import pytest

import model
from controller.sources.contacts import CONTACT_TIMEOUT
from drivers.by_hand.cli import amp
from drivers.by_hand.rig_check import check_links
from drivers.errors import CommandError
from drivers.protocol.table import REACTION
from drivers.protocol.timing import BOOT_TIME
from drivers.wires.known import address_of
from model.answer.answer import MIN_CONTRAST_DB, OWN_CONTRAST_DB
from model.answer.promised import MIN_RAISED_CONTRAST_DB
from model.study.verify import MIN_KEPT_SHARE
from model.study.weak_cells import WANTED_CONTRAST_DB
from registry.limits import GuardLimits

ROOT = Path(model.__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]


def text_of(page: str) -> str:
    """A page's text; its name is relative to the root."""
    return (ROOT / page).read_text("utf-8")


@pytest.mark.parametrize(
    ("page", "stated", "constant"),
    [
        ("docs/reference/table-file.md", r"must be (\d+) % or more", 100 * MIN_KEPT_SHARE),
        ("docs/architecture.md", r"no frame confirms \((\d+) ms", 1000 * CONTACT_TIMEOUT),
        ("docs/reference/touch.md", r"after (\d+) ms without a frame", 1000 * CONTACT_TIMEOUT),
        ("docs/reference/protocol.md", r"of its request [^|]*\| – \| (\d+) ms", 1000 * REACTION),
        *(
            (f"docs/{page}.md", stated, MIN_CONTRAST_DB)
            for page, stated in (
                ("reference/effects", r"less than (\d+) dB, contents give way"),
                ("reference/effects", r"^\| (\d+) to \d+ dB, or more of what pauses"),
                ("reference/effects", r"\| below (\d+) dB at any finger"),
                ("reference/effects", r"still below (\d+) dB"),
                ("reference/effects", r"would fall below (\d+) dB"),
                ("reference/effects", r"names the pairs below (\d+) dB"),
                ("reference/commands", r"not even one content reaches (\d+) dB"),
                ("reference/python-api", r"would have less than (\d+) dB"),
                ("tutorials/reading-a-table", r"with less than (\d+) dB vibrations are"),
                ("how-to/design-a-layout", r"same time, below (\d+) dB"),
                ("measured/promise", r"which below (\d+) dB they are"),
            )
        ),
        *(
            (f"docs/{page}.md", stated, OWN_CONTRAST_DB)
            for page, stated in (
                ("reference/effects", r"^\| from (\d+) dB; of a click"),
                ("reference/effects", r"^\| \d+ to (\d+) dB, or more of what pauses"),
                ("reference/effects", r"`own: true`: (\d+) dB are required"),
                (
                    "reference/effects",
                    r"duration; below (\d+) dB, or beside others that are felt, they",
                ),
                ("reference/api", r"promised contrast below (\d+) dB"),
                ("concepts/each-finger-its-own", r"^(\d+) dB make a steady content"),
                ("tutorials/reading-a-table", r"less than (\d+) dB\s+are `mixed`"),
                ("how-to/design-a-layout", r"from (\d+) dB two regions"),
            )
        ),
        ("docs/reference/effects.md", r"half of it \((\d+) dB\)", MIN_RAISED_CONTRAST_DB),
        ("docs/reference/table-file.md", r"has (\d+) dB of felt contrast", WANTED_CONTRAST_DB),
        ("docs/concepts/localization.md", r"have (\d+) dB to the median", WANTED_CONTRAST_DB),
    ],
)
def test_page_states_the_constant(page: str, stated: str, constant: float) -> None:
    """The number beside these words is that of the code."""
    (found,) = re.findall(stated, text_of(page), re.MULTILINE)
    assert float(found) == pytest.approx(constant)


@pytest.mark.parametrize("page", ["README.md", "docs/concepts/localization.md"])
def test_page_states_how_many_fingers_kept_the_promise(page: str) -> None:
    """The share and number of fingers of the main run; clicks are counted by runs of their own."""
    figures, _, _ = text_of("docs/measured/promise.md").partition("<!-- end figures -->")
    rows = re.findall(r"(\d+) % of (\d+) \|", figures)
    counts = [int(count) for _, count in rows]
    kept = sum(int(share) * int(count) for share, count in rows) / sum(counts)
    ((share, count),) = re.findall(r"(\d+) % of\s+(\d+) fingers", text_of(page))
    assert int(count) == sum(counts)
    assert float(share) == pytest.approx(kept, abs=1)


def test_files_that_pages_name_are_there() -> None:
    """In any folder, and tests by their bare names; decisions name what was there at the time."""
    tests = {path.name for path in (ROOT / "tests").rglob("test_*.py")}
    folders = "|".join(path.name for path in ROOT.iterdir() if path.is_dir())
    named = re.compile(rf"`((?:{folders})/[\w./-]+\.(?:py|md|yaml|c|h|js|toml|json|html))`")
    gone = {
        name
        for page in PAGES
        if "decisions" not in page.parts
        for name in named.findall(page.read_text("utf-8"))
        if not (ROOT / name).exists() and not name.startswith(("dist/", "tests/faults/AREA"))
    }
    pages = [page.read_text("utf-8") for page in PAGES if "decisions" not in page.parts]
    assert gone == set()
    assert {name for page in pages for name in re.findall(r"`(test_\w+\.py)`", page)} <= tests


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
        set(re.findall(r"([\w+-]+)://[,;\s]", f"{unknown.value} ")) - {"carrier+pigeon"} == SCHEMES
    )
    assert set(re.findall(r"^\| `([\w+-]+)://", PAGE, re.MULTILINE)) == SCHEMES
    assert set(re.findall(r"^  ([\w+-]+)://", str(amp.info.epilog), re.MULTILINE)) == SCHEMES
    assert f"for {BOOT_TIME:g} s" in PAGE
