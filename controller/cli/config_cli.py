"""`era config`: create and check configuration files.

The keys of a file determine its kind.
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.commands.options import JsonOption, next_line, print_report
from model.errors import InputError
from model.files.output_paths import check_ending

if TYPE_CHECKING:
    from controller.config_kind import ConfigKind
    from model.config.document import Document

config_app = typer.Typer(help="Create and check configuration files.", no_args_is_help=True)


@config_app.command()
def init(
    file: Annotated[Path, typer.Argument(metavar="FILE.yaml", help="File to create.")],
    kind: Annotated[str, typer.Option(help="rig, daemon or layout.")] = "rig",
) -> None:
    """Write a commented file to edit.

    Also writes its schema for editors to the same folder.
    """
    from model.files.array_file import whole_or_nothing

    config_kind = kind_called(kind)
    check_ending(file, ".yaml", ".yml", what=f"a {kind} file")
    if file.exists():
        raise InputError(f"{file} exists already; choose another name")
    schema = file.with_suffix(".schema.json")
    texts = {
        file: f"# yaml-language-server: $schema={schema.name}\n{config_kind.example()}",
        schema: json.dumps(config_kind.schema(), indent=2) + "\n",
    }
    try:
        for path, text in texts.items():
            with whole_or_nothing(path) as stream:
                stream.write(text.encode())
    except OSError as error:
        raise InputError(f"{error.filename} cannot be written: {error.strerror}") from error
    typer.echo(f"wrote {file} (edit it) and {schema}")
    typer.echo(next_line("era", "config", "check", file))


@config_app.command()
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="File to check.")],
    as_json: JsonOption = False,
) -> None:
    """Check a rig, daemon or layout file.

    Lists all errors. Exits with status 1 if there are any.
    """
    from model.compiled.kernels import why_slow
    from model.config.document import ConfigError, read_document

    try:
        document = read_document(file)
        checked = kind_of(document).check(document)
    except ConfigError as error:
        problems = [
            {"line": problem.line, "key": problem.key, "message": problem.message}
            for problem in error.problems
        ]
        report = {"ok": False, "errors": problems, "warnings": []}
        print_report([str(error)], report, as_json=as_json)
        raise typer.Exit(1) from error
    warnings = [*checked.warnings]
    slow_kernels = why_slow()
    if slow_kernels:
        warnings.append(slow_kernels)
    lines = [f"{file}: {checked.line}"]
    lines += [f"warning: {warning}" for warning in warnings]
    lines += checked.rows
    report = {"ok": True, "errors": [], "warnings": warnings, **checked.data}
    print_report(lines, report, as_json=as_json)


def config_kinds() -> "dict[str, ConfigKind]":
    """All kinds of configuration files by name; a rig is the last, the default."""
    from controller.daemon.config import DAEMON
    from controller.effects.layout import LAYOUT
    from controller.rig_file_check import RIG

    return {"daemon": DAEMON, "layout": LAYOUT, "rig": RIG}


def kind_called(name: str) -> "ConfigKind":
    """The kind with a name; raises InputError for an unknown name."""
    from registry.plugins import did_you_mean

    kinds = config_kinds()
    if name not in kinds:
        raise InputError(
            f"unknown kind of configuration {name[:40]!r}; {did_you_mean(name, kinds)}"
            f"known: {', '.join(kinds)}"
        )
    return kinds[name]


def kind_of(document: "Document") -> "ConfigKind":
    """The kind of a document: a rig unless another kind recognizes it."""
    kinds = config_kinds()
    for kind in kinds.values():
        if kind.recognises(document):
            return kind
    return kinds["rig"]


app = typer.Typer()
app.add_typer(config_app, name="config")

EXIT_STATUS: dict[type[BaseException], int] = {InputError: 2}
"""Exit status for each class of error that these commands raise on purpose."""
