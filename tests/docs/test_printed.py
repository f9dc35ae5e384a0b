"""Comparison of shown with printed output, and invalid pages."""

import re
from pathlib import Path

import pytest

from typed_page import PORTS, PageError, difference, read_steps


@pytest.mark.parametrize(
    ("shown", "printed"),
    [
        ("level 20.0 dB", "level  20.1 dB\n"),  # the last digit
        ("median 31.9 dB", "median 32.4 dB"),  # two in a hundred
        ("wrote x ... s", "wrote x in 0.3 s"),
        ("first\n...\nlast", "first\nbetween\nbetween\nlast"),
        ("...\nlast", "last"),
        ("first\n...", "first"),
        ("-13.4 dB SL, unaware", "-13.5 dB SL, below its threshold"),
        ("level 20.0 dB", "contrast 20.0 dB"),
        ("armed by 'era', ... s left", "armed by 'era'; 59.8 s left"),
        ("mesh 11x7 ..., ERAs SW", "mesh 11x7, ERAs SW"),
        ("mesh 11x7 ...: within 0.09 % ...", "mesh 11x7 Q5, strips of 4 mm: within 0.09 % (17x11)"),
        ("armed until Ctrl-C", "armed; Ctrl-C disarms"),
        ("READY: all is well", "READY: nothing is wrong"),
    ],
)
def test_difference_is_none(shown: str, printed: str) -> None:
    """Words, blanks, last digits and what `...` stands for make no difference."""
    assert difference(shown, printed) is None


@pytest.mark.parametrize(
    ("shown", "printed", "line"),
    [
        ("level 20.0 dB", "level 21.0 dB", "line 1"),
        ("READY: all is well", "FAULT: all is well", "line 1"),
        ("wrote my.yaml", "wrote your.yaml", "line 1"),
        ("5 ERAs", "6 ERAs", "line 1"),  # a count is exact
        ("1 a\n2 b", "1 a", "line 2"),
        ("1 a", "1 a\n2 b", "beyond"),
        ("1 first\n...\n3 last", "1 first\n2 between", "line 3"),
        ("ready", "", "lines"),
        ("33.4 dB", "-33.4 dB", "line 1"),
    ],
)
def test_difference_has_its_place(shown: str, printed: str, line: str) -> None:
    """Another name, number, sign, count, or line is reported with its place."""
    assert line in (difference(shown, printed) or "")


@pytest.mark.parametrize("comment", ["statsu: 1", "edit: a.yaml"])
def test_read_steps_refuses_an_unknown_comment(tmp_path: Path, comment: str) -> None:
    """A misspelt comment, or one above the wrong kind of fence, is refused with its line."""
    page = tmp_path / "page.md"
    page.write_text(f"<!-- {comment} -->\n```yaml\na: 1\n```\n", encoding="utf-8")
    with pytest.raises(PageError, match=r"page\.md:[12]"):
        read_steps(page)


def test_ports_include_all_ports_of_pages() -> None:
    """Every port of a page is replaced by a free one."""
    docs = Path(__file__).parents[2] / "docs"
    pages = [*docs.glob("tutorials/*.md"), *docs.glob("how-to/*.md")]
    named = {
        port
        for page in pages
        for step in read_steps(page)
        for port in re.findall(r"(?:127\.0\.0\.1:|--port )(\d+)", str(step))
    }
    assert len(named) > 4
    assert named <= set(PORTS)
