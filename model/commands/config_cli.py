"""`era config`: begin a configuration file, and check one."""

import json
from pathlib import Path
from typing import Annotated

import typer

from model.commands.next_line import next_line
from model.errors import InputError

config_app = typer.Typer(help="Begin a configuration file, and check one.", no_args_is_help=True)


@config_app.command()
def init(
    file: Annotated[Path, typer.Argument(metavar="FILE.yaml", help="The file to make.")],
    kind: Annotated[str, typer.Option(help="What it shall be: rig, daemon, layout.")] = "rig",
) -> None:
    """Write a commented rig, daemon or layout to edit. Beside it lies its schema for editors."""
    from model.config.kinds import kind_called
    from model.files.array_file import whole_or_nothing
    from model.files.replacing import check_ending

    made = kind_called(kind)
    check_ending(file, ".yaml", ".yml", what=f"a {kind} file")
    schema = file.with_suffix(".schema.json")
    _write_new(file, f"# yaml-language-server: $schema={schema.name}\n{made.example()}")
    with whole_or_nothing(schema) as stream:
        stream.write(json.dumps(made.schema(), indent=2).encode() + b"\n")
    typer.echo(f"Wrote {file}, which is yours to edit, and {schema}")
    typer.echo(next_line("era", "config", "check", file))


@config_app.command()
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The file to check.")],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Say all that is wrong with a rig, daemon or layout file. Exit status 1 if anything is."""
    from model.config.document import ConfigError, read_document
    from model.config.kinds import kind_of

    try:
        good = kind_of(read_document(file)).check(file)
    except ConfigError as error:
        problems = [
            {"line": problem.line, "key": problem.key, "message": problem.message}
            for problem in error.problems
        ]
        typer.echo(
            json.dumps({"ok": False, "errors": problems, "warnings": []}) if as_json else str(error)
        )
        raise typer.Exit(1) from error
    if as_json:
        answer = {"ok": True, "errors": [], "warnings": list(good.warnings)}
        typer.echo(json.dumps(answer))
        return
    typer.echo(f"{file}: {good.line}")
    for warning in good.warnings:
        typer.echo(f"warning: {warning}")


def _write_new(path: Path, text: str) -> None:
    """Write a file that must not exist yet, whole or not at all."""
    try:
        stream = path.open("x", encoding="utf-8")
    except FileExistsError as error:
        raise InputError(f"{path} exists and is left as it is; choose another name") from error
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from error
    try:
        with stream:
            stream.write(text)
    except OSError as error:
        path.unlink()
        raise InputError(f"{path} cannot be written: {error.strerror}") from error
