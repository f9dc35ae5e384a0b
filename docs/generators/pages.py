"""Write every page, part of a page, client stub and C header that is generated from the code.

`make pages` writes stale files. With `--check`, which `make lint` uses, this lists the stale files,
and names of code on pages that are private or do not exist. Other targets write files that depend
on a package index (constraints.txt, reference/licences.md) and measurements (docs/measured).
"""

import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "programs"))

import changed_tests
import client_stub
import effects_page
import rig_page
import urls_page
from amplifier_dbc import dbc_text
from amplifier_eds import eds_text
from amplifier_json import json_text
from api_page import api_reference
from client_stub import summaries
from command_page import command_reference
from conformance_page import checks
from findings_page import finding_kinds
from firmware_header import header
from firmware_records import records_header
from metrics_page import metrics
from model.drive_modes import drive_mode_table
from page_names import wrong_names
from processes import error_cases
from protocol_bytes import BYTES
from protocol_tables import TABLES
from python_page import with_entries
from script_types import messages, with_version
from wiring_picture import wiring

ROOT = Path(__file__).parents[2]
END = "<!-- end -->"

Writer: TypeAlias = Callable[[str], str]
"""Function from the current text of a file to its required text."""


def whole(write: Callable[[], str]) -> Writer:
    """Return the writer of a file that is generated as a whole."""
    return lambda _: write()


def part(name: str, write: Callable[[], str]) -> Writer:
    """Return the writer of the part between the mark with this name and the next end mark."""
    return lambda page: insert(page, write(), name=name)


def insert(page: str, text: str, *, name: str) -> str:
    """Return a page with a new text for a part; raises ValueError if its marks are missing."""
    begin = f"<!-- begin: written by {name} -->"
    marks = (rf"{begin}\n", rf"{END}\n")
    if f"# begin: written by {name}\n" in page:  # in Python code
        marks = (rf"# begin: written by {name}\n", r" *# end\n")
    found = re.fullmatch(f"(.*{marks[0]}).*?({marks[1]}.*)", page, re.DOTALL)
    if found is None:
        raise ValueError(f"the page has no lines {begin} and {END}")
    # Imports follow the mark without a blank line.
    gap = "" if text.startswith("from ") else "\n"
    return f"{found[1]}{gap}{text.rstrip()}\n\n{found[2]}"


def _parts(writer: str, parts: Mapping[str, Callable[[], str]]) -> list[Writer]:
    return [part(f"docs/generators/{writer} {name}", write) for name, write in parts.items()]


def _of_protocol(page: str) -> list[Writer]:
    tables = _parts("protocol_tables.py", TABLES.get(page, {}))
    return [*tables, *_parts("protocol_bytes.py", BYTES.get(page, {}))]


def _urls(name: str) -> list[Writer]:
    return _parts("urls_page.py", {name: urls_page.PARTS[name]})


WRITTEN: Mapping[str, Sequence[Writer]] = {
    "drivers/wires/wire.py": _urls("classes"),
    "drivers/by_hand/cli.py": _urls("help"),
    "controller/api/summaries.py": [whole(summaries)],
    **{
        f"controller/api/{module}.py": _parts("client_stub.py", parts)
        for module, parts in client_stub.PARTS.items()  # before python-api.md, which shows them
    },
    "examples/javascript/api.d.ts": [whole(messages)],
    "examples/javascript/package.json": [with_version],
    "docs/reference/conformance.md": [part("docs/generators/conformance_page.py", checks)],
    "firmware/core/protocol.h": [whole(header)],
    "firmware/core/records.h": [whole(records_header)],
    "docs/reference/amplifier.dbc": [whole(dbc_text)],
    "docs/reference/amplifier.eds": [whole(eds_text)],
    "docs/reference/amplifier.json": [whole(json_text)],
    **{
        f"docs/reference/{page}.md": _of_protocol(page)
        for page in ("protocol", "serial", "modbus", "can")
    },
    "docs/pictures/weekend_wiring.svg": [whole(wiring)],
    "docs/how-to/measure-your-plate.md": [part("docs/generators/findings_page.py", finding_kinds)],
    "docs/reference/api.md": [part("docs/generators/api_page.py", api_reference)],
    "docs/reference/commands.md": [part("docs/generators/command_page.py", command_reference)],
    "docs/reference/metrics.md": [
        part("docs/generators/metrics_page.py", metrics),
        *_parts("protocol_tables.py", TABLES["metrics"]),
    ],
    "docs/concepts/localization.md": [part("model/drive_modes.py", drive_mode_table)],
    "docs/reference/python-api.md": [with_entries],
    "docs/reference/errors.md": [error_cases.with_messages],
    "docs/reference/rig.md": _parts("rig_page.py", rig_page.PARTS),
    "docs/reference/effects.md": _parts("effects_page.py", effects_page.PARTS),
    "docs/reference/urls.md": _urls("urls"),
    "docs/how-to/simulated-hardware.md": _urls("far_ends"),
    "CONTRIBUTING.md": [part("tests/programs/changed_tests.py", changed_tests.table)],
}
"""Writers of each generated file, by path."""


def main(arguments: Sequence[str], *, root: Path = ROOT) -> int:
    """Write all stale files; with `--check`, list them and return 1."""
    is_check, status = "--check" in arguments, 0
    for name, writers in WRITTEN.items():
        path = root / name
        before = text = path.read_text("utf-8") if path.exists() else ""
        try:
            for write in writers:
                text = write(text)
        except Exception as error:
            error.add_note(f"while {name} was written")
            raise
        if text != before and is_check:
            sys.stderr.write(f"{name} is stale: run `make pages`\n")
            status = 1
        elif text != before:
            path.write_text(text, encoding="utf-8")
            sys.stdout.write(f"wrote {name}\n")
            if path.suffix == ".py" and root == ROOT:
                # Later files are generated from this module; a new process loads it.
                sys.stdout.flush()
                os.execv(sys.executable, [sys.executable, __file__, *arguments])  # noqa: S606
    if is_check:
        for reason in wrong_names(root):
            sys.stderr.write(f"{reason}\n")
            status = 1
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
