"""Notebooks of the gallery, as they are shown on the built pages."""

from pathlib import Path

import pytest

import notebooks

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
