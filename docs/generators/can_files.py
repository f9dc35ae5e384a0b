"""Write the EDS and DBC files of an amplifier: `python docs/generators/can_files.py FOLDER`."""

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from can_dbc import dbc_text
from can_eds import eds_text

FILES: Mapping[str, Callable[[], str]] = {
    "era-amplifier.eds": eds_text,
    "era-amplifier.dbc": dbc_text,
}


def write_files(folder: Path) -> None:
    """Write every file of `FILES` into an existing folder."""
    for name, text in FILES.items():
        (folder / name).write_text(text(), encoding="utf-8")


if __name__ == "__main__":
    write_files(Path(sys.argv[1]))
