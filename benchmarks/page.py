"""Parts of a documentation page that a benchmark writes, between marks; the rest is text."""

import re
from pathlib import Path


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
