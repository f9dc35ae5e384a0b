"""What counts as printed as shown, and how a page is read."""

import re
from pathlib import Path

import pytest

from page_reader import PORTS, Reader
from printed import difference
from typed_page import Edited, Interrupted, PageError, Seen, Typed, Written, read_steps

PAGE = """# A page

Read this.

```sh
first
```
```text
says 1
```

<!-- not typed: needs another machine -->
```sh
elsewhere
```

<!-- file: a.yaml -->
```yaml
a: 1
b: 2
```
<!-- edit: a.yaml -->
```diff
 a: 1
-b: 2
+b: 3
```

```yaml
to: read
```

<!-- terminal: one -->
```sh
goes on
```

<!-- seen in: one -->
```text
by and by
```

<!-- interrupt: one -->
<!-- status: 2 -->
```sh
fails
```
"""


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


def test_a_page_is_what_its_reader_does(tmp_path: Path) -> None:
    """Commands with what they print, files, edits, terminals; what is for reading is left out."""
    page = tmp_path / "page.md"
    page.write_text(PAGE, encoding="utf-8")
    assert read_steps(page) == [
        Typed(5, "first\n", None, 0, "says 1\n"),
        Written(18, "a.yaml", "a: 1\nb: 2\n"),
        Edited(23, "a.yaml", "a: 1\nb: 2\n", "a: 1\nb: 3\n"),
        Typed(34, "goes on\n", "one", 0, None),
        Seen(39, "one", "by and by\n"),
        Interrupted(43, "one"),
        Typed(45, "fails\n", None, 2, None),
    ]


@pytest.mark.parametrize("comment", ["statsu: 1", "edit: a.yaml"])
def test_a_comment_without_a_meaning_is_refused(tmp_path: Path, comment: str) -> None:
    """One that is misspelt, or stands over the wrong kind of fence, would else go unnoticed."""
    page = tmp_path / "page.md"
    page.write_text(f"<!-- {comment} -->\n```yaml\na: 1\n```\n", encoding="utf-8")
    with pytest.raises(PageError, match=r"page\.md:[12]"):
        read_steps(page)


def test_a_reader_takes_ports_that_are_free(tmp_path: Path) -> None:
    """In what is written, typed and shown, as whole numbers alone; all that a page says agrees."""
    page = tmp_path / "page.md"
    page.write_text(
        "<!-- file: a.yaml -->\n```yaml\nurl: tcp://127.0.0.1:5020/1\nelse: 15020 0.5020\n```\n"
        "```sh\ncat a.yaml; grep -c 127.0.0.1:5020/1 a.yaml\n```\n"
        "```text\nurl: tcp://127.0.0.1:5020/1\nelse: 15020 0.5020\n1\n```\n",
        encoding="utf-8",
    )
    folder = tmp_path / "folder"
    folder.mkdir()
    with Reader(folder, home=tmp_path) as reader:
        for step in read_steps(page):
            reader.follow(step)
    text = (folder / "a.yaml").read_text("utf-8")
    assert ":5020" not in text
    assert text.endswith("else: 15020 0.5020\n")


def test_readers_know_every_port_that_pages_name() -> None:
    """One that was not replaced could be taken by another program."""
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
