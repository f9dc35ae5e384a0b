"""The table in docs/reference/amplifier-classes.md: what an amplifier may lack, and what follows.

`python docs/generators/classes_page.py docs/reference/amplifier-classes.md` writes it anew between
the page's two marks, from `drivers.protocol.classes`.
"""

import sys
from pathlib import Path

from drivers.protocol.classes import LACKS
from page_part import insert

WRITER = "docs/generators/classes_page.py"


def classes_table() -> str:
    """The table, as Markdown."""
    head = ("without", "class at best", "the controller", "the daemon", "the promise is")
    rows = [
        (lack.name, lack.highest_class, lack.controller, lack.daemon, lack.promise)
        for lack in LACKS
    ]
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ("---",) * len(head), *rows))


if __name__ == "__main__":
    path = Path(sys.argv[1])
    path.write_text(insert(path.read_text("utf-8"), classes_table(), writer=WRITER), "utf-8")
