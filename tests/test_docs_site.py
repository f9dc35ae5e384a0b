"""Pages and what leads to them; `make docs` builds them."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_every_page_can_be_found() -> None:
    """Each page stands in the side bar, or its folder's index, which stands there, links to it."""
    docs = ROOT / "docs"
    index = (docs / "index.md").read_text("utf-8")
    listed = set(re.findall(r"^(?:.* <)?([a-z-]+(?:/[\w-]+)?)>?$", index, re.MULTILINE))
    for name in ("decisions/README", "measured/figures", "gallery"):
        assert name in listed
        folder, links = Path(name).parent, (docs / f"{name}.md").read_text("utf-8")
        listed |= {str(folder / page) for page in re.findall(r"\(([\w/-]+)\.md\)", links)}
    pages = {path.relative_to(docs) for path in docs.rglob("*.md")}
    names = {page.with_suffix("").as_posix() for page in pages if page.parts[0] != "_build"}
    assert names - listed == {"index"}


def test_the_search_finds_pages_and_no_decision(tmp_path: Path) -> None:
    """A word of a page is in the index of the built pages, one of a decision is not."""
    pytest.importorskip("sphinx", reason="`make docs` installs what builds the pages")
    for name, text in {
        "index": "# Pages\n\n```{toctree}\nwire\ndecisions/README\n```\n",
        "wire": "# A wire\n\nserendipity\n",
        "decisions/README": "# Decisions\n\n[one](0001-one.md)\n",
        "decisions/0001-one": "# Juxtaposed\n\nbamboozle\n",
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / f"{name}.md").write_text(text, "utf-8")
    built = tmp_path / "_build"
    command = [sys.executable, "-m", "sphinx", "-q", "-b", "html", "-c", ROOT / "docs"]
    subprocess.run([*command, tmp_path, built], check=True, capture_output=True)
    index = (built / "searchindex.js").read_text("utf-8").lower()
    assert "serendip" in index
    assert "juxtapos" not in index
    assert "bamboozl" not in index


def test_the_version_is_the_same_wherever_it_is_stated() -> None:
    """The newest release of the changelog, the citation and the packages have one version."""
    stated = {
        "pyproject.toml": r'^version = "(.+)"',
        "CITATION.cff": r"^version: (.+)",
        "CHANGELOG.md": r"^## \[(.+)\] - \d{4}-\d\d-\d\d$",
        "examples/javascript/package.json": r'^  "version": "(.+)"',
        "docs/how-to/installation.md": r"era_haptics-([\d.]+)-py3",
        "docs/how-to/deployment.md": r"era_haptics-([\d.]+)-py3",
    }
    texts = {name: (ROOT / name).read_text("utf-8") for name in stated}
    versions = {name: re.findall(stated[name], texts[name], re.MULTILINE)[0] for name in stated}
    assert len(set(versions.values())) == 1, versions


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


def test_decisions_that_are_named_are_there() -> None:
    """A record that was folded into a later one is named nowhere, in code, tests or pages."""
    folders = ["controller", "docs", "drivers", "firmware", "model", "sim", "tests"]
    suffixes = {".py", ".c", ".h", ".md", ".yaml"}
    files = [path for name in folders for path in (ROOT / name).rglob("*.*")]
    named = {
        (number, path.name)
        for path in files
        if path.suffix in suffixes and "_build" not in path.parts
        for number in re.findall(
            r"(?:\bdecisions?/|\bdecisions? |\[)(0\d{3})\b", path.read_text("utf-8")
        )
    }
    assert len(named) > 50
    there = {path.name[:4] for path in (ROOT / "docs" / "decisions").glob("0*.md")}
    assert {(number, name) for number, name in named if number not in there} == set()
