"""What programs write of pages and files, and the check of it."""

import re
from pathlib import Path

import pytest

import pages

BEGIN, END = "<!-- begin: written by a.py -->", "<!-- end -->"


def test_the_text_stands_between_the_marks_of_its_name() -> None:
    """What was there is replaced, what stands around stays, and again it changes nothing."""
    page = pages.insert(f"a\n{BEGIN}\nold\n{END}\nb\n", "new\n", name="a.py")
    assert page == f"a\n{BEGIN}\n\nnew\n\n{END}\nb\n"
    assert pages.insert(page, "new\n", name="a.py") == page


@pytest.mark.parametrize("page", ["a\nb\n", f"a\n<!-- begin: written by b.py -->\n{END}\n"])
def test_a_page_without_these_marks_is_left_alone(page: str) -> None:
    """Neither without any nor with those of another name."""
    with pytest.raises(ValueError, match="no lines"):
        pages.insert(page, "new", name="a.py")


def test_check_names_what_is_stale_until_it_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file that is missing, and one whose part has another text; the check writes neither."""
    written = {"b.h": [pages.whole(lambda: "1\n")], "a.md": [pages.part("a.py", lambda: "new")]}
    monkeypatch.setattr(pages, "WRITTEN", written)
    (tmp_path / "a.md").write_text(f"{BEGIN}\nold\n{END}\n", "utf-8")
    assert pages.main(["--check"], root=tmp_path) == 1
    assert re.findall(r"^(\S+) is stale: run `make pages`$", capsys.readouterr().err, re.M) == [
        *written
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["a.md"]
    assert pages.main([], root=tmp_path) == 0
    assert (tmp_path / "a.md").read_text("utf-8") == f"{BEGIN}\n\nnew\n\n{END}\n"
    assert (tmp_path / "b.h").read_text("utf-8") == "1\n"
    assert pages.main(["--check"], root=tmp_path) == 0


def test_whatever_says_that_it_is_written_is_among_the_pages() -> None:
    """A mark, or the name of a generator in the first lines of a file."""
    claimed = re.compile(
        r"<!-- begin: written by|\A.*\n?.*\n?.*(?:made|[Ww]ritten) by docs/generators"
    )
    found = {
        path.relative_to(pages.ROOT).as_posix()
        for folder in (
            *(".", "docs/reference", "docs/how-to", "controller/api", "firmware/core"),
            "examples/javascript",
        )
        for path in (pages.ROOT / folder).glob("*.*")
        if path.suffix in (".md", ".py", ".pyi", ".h", ".ts")
        and claimed.search(path.read_text("utf-8"))
    }
    assert len(found) > 6
    assert found <= set(pages.WRITTEN)
