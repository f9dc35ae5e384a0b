"""`era report`: what a bug report needs, in one file."""

import os
from pathlib import Path
from typing import Annotated

import typer

from model.errors import InputError


def report(
    configs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[CONFIG]...", help="Rig, layout and daemon files to include."),
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="File to write.")] = Path(
        "era-report.zip"
    ),
    socket: Annotated[
        Path | None, typer.Option("--socket", help="Socket of the daemon; default: the usual path.")
    ] = None,
) -> None:
    """Collect versions, files and daemon state for a bug report.

    Values of unknown keys, hosts, serial numbers and comments are hidden; look before you send it.
    """

    from era_haptics.lab.report import collect, write_zip

    for path in configs or ():
        if not path.exists():
            raise InputError(f"{path}: no such file; check its name and folder")
    home = Path(os.path.expanduser("~"))  # noqa: PTH111  Path.home raises where there is none
    collected = collect(configs or [], socket=socket, home=home)
    write_zip(output, collected)
    for name, text in collected.files.items():
        print(f"  {name}: {len(text)} characters")
    for what in collected.missing:
        print(f"  skipped: {what}")
    print(f"wrote {output}\nNext: look before you send: names and causes are not hidden")
