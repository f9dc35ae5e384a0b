"""Pages and what leads to them; `make docs` builds them."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_every_page_can_be_found() -> None:
    """Each page stands in the side bar, or its folder's index, which stands there, links to it."""
    docs = ROOT / "docs"
    index = (docs / "index.md").read_text("utf-8")
    listed = set(re.findall(r"^(?:.* <)?([a-z-]+(?:/[\w-]+)?)>?$", index, re.MULTILINE))
    for name in ("decisions/README", "measured/figures"):
        assert name in listed
        folder, links = name.partition("/")[0], (docs / f"{name}.md").read_text("utf-8")
        listed |= {f"{folder}/{page}" for page in re.findall(r"\(([\w-]+)\.md\)", links)}
    pages = {path.relative_to(docs) for path in docs.rglob("*.md")}
    names = {page.with_suffix("").as_posix() for page in pages if page.parts[0] != "_build"}
    assert names - listed == {"index"}


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"])
def test_links_beside_the_docs_lead_somewhere(name: str) -> None:
    """What a link to a file of the project names is there."""
    links = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", (ROOT / name).read_text("utf-8"))
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_pages_that_are_named_in_code_are_there() -> None:
    """Messages, docstrings and the changelog name pages by their path."""
    code = ["registry", "controller", "drivers", "era_haptics", "model", "sim"]
    files = [
        path for name in (*code, "benchmarks", "examples") for path in (ROOT / name).rglob("*.py")
    ]
    files += [ROOT / "CHANGELOG.md", ROOT / "Makefile", ROOT / "SECURITY.md"]
    named = {
        (page, path.name)
        for path in files
        for page in re.findall(r"\bdocs/[a-z][\w/-]+\.md\b", path.read_text("utf-8"))
    }
    assert len(named) > 10
    assert {(page, path) for page, path in named if not (ROOT / page).is_file()} == set()
