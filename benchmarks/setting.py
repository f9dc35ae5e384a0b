"""Shared code of benchmarks: contact sets, and parts of pages that they write."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from model.arrays import FloatArray

_ROOT = Path(__file__).parents[1]
RIG = _ROOT / "examples" / "paper_plate.yaml"
APART = 0.05  # m; between the fingers of a contact set


def random_contacts(
    rng: np.random.Generator,
    count: int,
    size: tuple[float, float],
    *,
    margin: float = 0.0,
    apart: float = APART,
    beside: Sequence[tuple[float, float]] = (),
) -> FloatArray:
    """Return contacts (count, 2) [m] on a plate, with minimum distances to each other and edges.

    beside: other positions [m] at the same minimum distance.
    """
    while True:
        places = rng.uniform(margin, np.array(size) - margin, (count, 2))
        every = np.array([*places, *beside])
        gaps = np.linalg.norm(every[:, None] - every, axis=-1)
        if gaps[np.triu_indices(len(every), 1)].min(initial=np.inf) > apart:
            return places


def write_parts(page: Path, parts: dict[str, str]) -> None:
    """Replace the text between `<!-- begin NAME -->` and `<!-- end NAME -->` for each name.

    Raises ValueError for a page without the marks of a part.
    """
    text = page.read_text(encoding="utf-8")
    for name, part in parts.items():
        marks = f"<!-- begin {name} -->\n", f"<!-- end {name} -->"
        found = re.fullmatch(f"(.*{marks[0]}).*({marks[1]}.*)", text, re.DOTALL)
        if found is None:
            raise ValueError(f"{page}: no marks of the part {name}")
        text = f"{found[1]}{part.strip()}\n{found[2]}"
    page.write_text(text, encoding="utf-8")
    print(f"wrote {page}")
