"""`era report`: what a bug report should hold."""

from pathlib import Path
from typing import Annotated

import typer

from model.errors import InputError

app = typer.Typer()

EXIT_STATUS: dict[type[BaseException], int] = {InputError: 2}


@app.callback()
def _only_commands() -> None:
    """Keep `report` a command, though it is the only one."""


@app.command()
def report(
    configs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[CONFIG]...", help="Rigs, layouts or daemons' files to put in."),
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="The file to make.")] = Path(
        "era-report.zip"
    ),
    socket: Annotated[
        Path | None, typer.Option("--socket", help="Where a daemon listens, if not as usual.")
    ] = None,
) -> None:
    """Gather in one file what a report of a bug needs.

    Versions, configuration, a running daemon's state and its last messages.

    Passwords, tokens and the name of your home folder are taken out; look at it before you send it.
    """
    from controller.report.collect import collect
    from controller.report.zip_file import write_zip

    gathered = collect(configs or [], socket=socket, home=Path.home())
    write_zip(output, gathered)
    for name, text in gathered.files.items():
        print(f"  {name}: {len(text)} characters")
    for what in gathered.missing:
        print(f"  left out: {what}")
    print(f"Wrote {output}\nNext: look at it, then attach it to your report")
