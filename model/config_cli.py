"""`era config`: begin a rig file, and check one."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.errors import InputError

if TYPE_CHECKING:
    from model.rig import Rig

config_app = typer.Typer(help="Begin a rig file, and check one.", no_args_is_help=True)


@config_app.command()
def init(
    rig: Annotated[Path, typer.Argument(metavar="RIG.yaml", help="The file to make.")],
) -> None:
    """Write a commented rig to edit, and its JSON schema for editors beside it."""
    from model.rig_file import example_rig_path, rig_schema

    if rig.suffix not in (".yaml", ".yml"):
        raise InputError(f"{rig}: a rig file ends in .yaml; try {rig.with_suffix('.yaml')}")
    schema = rig.with_suffix(".schema.json")
    example = example_rig_path().read_text(encoding="utf-8")
    _write_new(rig, f"# yaml-language-server: $schema={schema.name}\n{example}")
    schema.write_text(json.dumps(rig_schema(), indent=2) + "\n", encoding="utf-8")
    typer.echo(f"Wrote {rig} and {schema}")
    typer.echo(f"Next: edit it, then  era config check {rig}")


@config_app.command()
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The rig file to check.")],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Say everything that is wrong with a rig file; exit status 1 if anything is."""
    from model.document import ConfigError
    from model.rig_file import load_rig

    try:
        rig = load_rig(file)
    except ConfigError as error:
        problems = [
            {"line": problem.line, "key": problem.key, "message": problem.message}
            for problem in error.problems
        ]
        typer.echo(json.dumps({"ok": False, "errors": problems}) if as_json else str(error))
        raise typer.Exit(1) from error
    typer.echo(json.dumps({"ok": True, "errors": []}) if as_json else f"{file}: {_summary(rig)}")


def _summary(rig: "Rig") -> str:
    """A good rig in one line, so that a value that is only unlikely catches the eye."""
    plate, laminate = rig.plate, rig.laminate
    thickness = plate.thickness if laminate is None else laminate.thickness
    sizes = " x ".join(f"{1e3 * size:g}" for size in (plate.length, plate.width, thickness))
    made_of = plate.material.name
    if laminate is not None:
        made_of = f"laminate ({', '.join(layer.material.name for layer in laminate.layers)})"
    parts = [
        f"{sizes} mm of {made_of}",
        f"mesh {rig.mesh}",
        f"ERAs {', '.join(era.name for era in rig.eras)}",
    ]
    if rig.masses:
        parts.append(f"carries {1e3 * sum(mass.mass for mass in rig.masses):g} g")
    return f"good: {', '.join(parts)}"


def _write_new(path: Path, text: str) -> None:
    """Write a file that must not exist yet."""
    try:
        with path.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except FileExistsError as error:
        raise InputError(f"{path} exists and is left as it is; choose another name") from error
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from error
