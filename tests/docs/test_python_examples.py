"""What pages show of Python: the examples of the API's page, typed in one session; notebooks."""

import doctest
import re
import shutil
from pathlib import Path

import pytest

import era_haptics
import notebooks

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "python-api.md").read_text("utf-8")


def test_every_function_has_an_example() -> None:
    """Each entry of a function is followed by a session; methods may do without."""
    entries = re.findall(r"^- `(\w+)\(.*\n((?:  .*\n)*)", PAGE, re.MULTILINE)
    shown = {name: ">>> " in text for name, text in entries if hasattr(era_haptics, name)}
    assert len(shown) > 15
    assert [name for name, has_example in shown.items() if not has_example] == []


@pytest.mark.long
def test_examples_print_what_the_page_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the order of the page, from a folder beside the examples."""
    shutil.copytree(
        ROOT / "examples",
        tmp_path / "examples",
        ignore=shutil.ignore_patterns("*.c", "node_modules"),
    )
    monkeypatch.chdir(tmp_path)
    sessions = "\n".join(re.findall(r"^ *```pycon\n(.*?)^ *```$", PAGE, re.MULTILINE | re.DOTALL))
    test = doctest.DocTestParser().get_doctest(sessions, {"era": era_haptics}, "page", None, 0)
    printed: list[str] = []
    doctest.DocTestRunner().run(test, out=printed.append)
    assert len(test.examples) > 25
    assert "".join(printed) == ""


NOTEBOOK = '''# %% [markdown]
"""
# A title
"""

# %%
from matplotlib.figure import Figure
print("seen")

# %%
Figure()
'''


def test_a_notebook_is_shown_with_what_it_prints_and_draws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Text as text, a cell with its output, and a figure that ends a cell as a picture."""
    monkeypatch.setattr(notebooks, "ROOT", tmp_path)
    pictures = tmp_path / "docs"
    pictures.mkdir()
    (tmp_path / "small.py").write_text(NOTEBOOK, "utf-8")
    shown = notebooks.as_markdown(tmp_path / "small.py", pictures)
    title, code, printed, figure, picture = shown.split("\n\n")
    assert title == "# A title"
    assert 'print("seen")' in code
    assert printed == "````text\nseen\n````"
    assert "Figure()" in figure
    assert picture == "![The figure of this cell](/small-2.png)"
    assert (pictures / "small-2.png").read_bytes().startswith(b"\x89PNG")
