"""`python -m drivers.codec.can_bus.generate FOLDER`: EDS and DBC file, from protocol.yaml."""

import argparse
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from drivers.codec.can_bus.dbc import dbc_text
from drivers.codec.can_bus.eds import eds_text

FILES: Mapping[str, Callable[[], str]] = {
    "era-amplifier.eds": eds_text,
    "era-amplifier.dbc": dbc_text,
}


def main() -> int:
    """Write the files; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m drivers.codec.can_bus.generate",
        description="Write the EDS and the DBC file of an amplifier, from protocol.yaml.",
    )
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="where they are written")
    folder: Path = parser.parse_args().folder
    if not folder.is_dir():
        parser.error(f"there is no folder {folder}; make it first")
    for name, make in FILES.items():
        path = folder / name
        path.write_text(make(), encoding="utf-8")
        sys.stdout.write(f"wrote {path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
