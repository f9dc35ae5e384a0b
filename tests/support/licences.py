"""The licences of what comes with era-haptics, as a page, from its bills of materials.

    python tests/support/licences.py dist/sbom.json dist/sbom-extras.json \
        > docs/reference/licences.md

`make licences` makes both bills and the page.
"""

import argparse
import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

PROJECT = "era-haptics"

NOTES: Mapping[str, str] = {
    "numpy": "wheels hold OpenBLAS (BSD-3-Clause) and libgfortran (GPL-3.0 with the GCC exception)",
    "matplotlib": "a licence of its own, after Python's",
    "partd": "BSD-3-Clause by its text",
    "pillow": "wheels hold libjpeg, libtiff, freetype and others, all permissive",
    "python-can": "copyleft, see below",
    "python-osc": "Unlicense by its text: public domain",
    "scipy": "wheels hold OpenBLAS (BSD-3-Clause), libgfortran (GPL-3.0 with the GCC exception) "
    "and libquadmath (LGPL-2.1)",
}
"""What the metadata do not say, read in the files that the distributions bring."""

TOP = """# Licences

Written by `make licences`, from what the wheel brings into a clean environment. era-haptics itself
is under the MIT licence. Nothing here is copied into it: pip fetches each from its own authors.
"""

BOTTOM = """
## What this means

All but one are permissive (MIT, BSD, ISC, Apache-2.0, PSF, Unlicense): they ask that their notices
go with every copy, and go together with the MIT licence.

**python-can** is under the LGPL, version 3. era-haptics imports it unchanged, so your own programs
and era-haptics keep their licences, whatever these are. Who passes on an image or an installer that
holds it (a panel's firmware, a container) says that it is used, passes on its licence text and its
source or where that is, and lets whoever gets the thing put another version in its place, on
devices for consumers too. Without CAN it is not loaded, but it is installed.

**libgfortran** and **libquadmath** inside the wheels of numpy and scipy are files of their own: the
first may be passed on with programs of any licence, by the GCC exception; the second, under the
LGPL, asks what python-can asks. Builds by Linux distributions and conda take the system's instead.

This is a reading, not legal advice. Before you ship, run `make licences` on what you ship.
"""


def licence(component: Mapping[str, Any]) -> str:
    """What a component says of its licence; the most exact where it says it twice."""
    told = component.get("licenses", [])
    exact = [each.get("expression") or each["license"].get("id") for each in told]
    known = [one for one in exact if one]
    named = [each["license"]["name"] for each in told if "license" in each and not known]
    return " / ".join(known or [name.rpartition(" :: ")[2] for name in named]) or "not told"


def rows(components: Iterable[Mapping[str, Any]]) -> str:
    """A table of name, version, licence and note."""
    lines = ["| distribution | version | licence | |", "|---|---|---|---|"]
    for one in sorted(components, key=lambda one: one["name"].lower()):
        note = NOTES.get(one["name"].lower(), "")
        lines.append(f"| {one['name']} | {one['version']} | {licence(one)} | {note} |")
    return "\n".join(lines) + "\n"


def page(plain: Mapping[str, Any], extras: Mapping[str, Any]) -> str:
    """The page, of the bill of the plain installation and that with extras."""
    first = [one for one in plain["components"] if one["name"] != PROJECT]
    names = {PROJECT, *(one["name"] for one in first)}
    others = [one for one in extras["components"] if one["name"] not in names]
    return (
        f"{TOP}\n## Of `pip install era-haptics`\n\n{rows(first)}"
        f"\n## Besides, of the extras `gateway` and `cluster`\n\n{rows(others)}{BOTTOM}"
    )


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("plain", type=Path)
    parser.add_argument("extras", type=Path)
    given = parser.parse_args()
    bills = [json.loads(path.read_text(encoding="utf-8")) for path in (given.plain, given.extras)]
    sys.stdout.write(page(*bills))
    return 0


if __name__ == "__main__":
    sys.exit(main())
