"""`python -m drivers.protocol.generate FOLDER`: the EDS and the DBC file, from protocol.yaml."""

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from drivers.protocol.dbc import dbc_text
from drivers.protocol.eds import eds_text

FILES: Mapping[str, Callable[[], str]] = {
    "era-amplifier.eds": eds_text,
    "era-amplifier.dbc": dbc_text,
}


def main() -> int:
    """Write the files; returns the exit status."""
    if len(sys.argv) != 2:
        sys.stderr.write(f"{__doc__}\n")
        return 2
    for name, make in FILES.items():
        Path(sys.argv[1], name).write_text(make(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
