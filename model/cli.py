"""The model's share of the `era` command, with `era config` of configuration files."""

import json
from pathlib import Path
from typing import Annotated

import typer

from model.commands.calibrate_cli import calibrate
from model.commands.options import JsonOption, next_line, print_report
from model.commands.plate_cli import plate_app
from model.commands.table_cli import build, contrast_map, export, plot, query, table_app
from model.commands.table_show_cli import show, verify
from model.errors import InputError
from model.files.output_paths import check_ending

config_app = typer.Typer(help="Create and check configuration files.", no_args_is_help=True)


@config_app.command()
def init(
    file: Annotated[Path, typer.Argument(metavar="FILE.yaml", help="File to create.")],
    kind: Annotated[str, typer.Option(help="rig, daemon or layout.")] = "rig",
) -> None:
    """Write a commented file to edit.

    Write its schema for editors beside it.
    """
    from model.config.file_kinds import kind_called
    from model.files.array_file import whole_or_nothing

    made = kind_called(kind)
    check_ending(file, ".yaml", ".yml", what=f"a {kind} file")
    if file.exists():
        raise InputError(f"{file} exists already; choose another name")
    schema = file.with_suffix(".schema.json")
    texts = {
        file: f"# yaml-language-server: $schema={schema.name}\n{made.example()}",
        schema: json.dumps(made.schema(), indent=2) + "\n",
    }
    try:
        for path, text in texts.items():
            with whole_or_nothing(path) as stream:
                stream.write(text.encode())
    except OSError as error:
        raise InputError(f"{error.filename} cannot be written: {error.strerror}") from error
    typer.echo(f"wrote {file}, to be edited, and {schema}")
    typer.echo(next_line("era", "config", "check", file))


@config_app.command()
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="File to check.")],
    as_json: JsonOption = False,
) -> None:
    """Check a rig, daemon or layout file.

    List all errors; exit with 1 if there are any.
    """
    from model.compiled.kernels import why_slow
    from model.config.document import ConfigError, read_document
    from model.config.file_kinds import kind_of

    try:
        document = read_document(file)
        good = kind_of(document).check(document)
        warnings = [*good.warnings, *filter(None, [why_slow()])]
    except ConfigError as error:
        problems = [
            {"line": problem.line, "key": problem.key, "message": problem.message}
            for problem in error.problems
        ]
        answer = {"ok": False, "errors": problems, "warnings": []}
        print_report([str(error)], answer, as_json=as_json)
        raise typer.Exit(1) from error
    rows = [f"{file}: {good.line}", *(f"warning: {warning}" for warning in warnings)]
    answer = {"ok": True, "errors": [], "warnings": warnings, **good.more}
    print_report(rows, answer, as_json=as_json)


table_app.command()(build)
table_app.command()(show)
table_app.command()(verify)
table_app.command()(query)
table_app.command("map")(contrast_map)
table_app.command()(plot)
table_app.command()(export)

app = typer.Typer()
app.command()(calibrate)
app.add_typer(config_app, name="config")
app.add_typer(plate_app, name="plate")
app.add_typer(table_app, name="table")

EXIT_STATUS: dict[type[BaseException], int] = {InputError: 2}
"""Exit status for each class of error that these commands raise on purpose."""
