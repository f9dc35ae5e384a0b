"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

from model.errors import InputError

RigArgument = Annotated[Path, typer.Argument(metavar="RIG", help="Rig file, e.g. RIG.yaml.")]
TableArgument = Annotated[Path, typer.Argument(metavar="TABLE", help="Table file, e.g. T.npz.")]
MeshOption = Annotated[
    str | None,
    typer.Option(metavar="NXxNY", help="Mesh, as in a rig: auto, 12x9, '12x9 Q3'; default: rig."),
]
FolderOption = Annotated[
    Path, typer.Option("--output", "-o", metavar="DIR", help="Folder to write into.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
ContactsOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Contacts, or a surface layout; default: anywhere, 1 to 3 quiet fingers.",
    ),
]
LowestOption = Annotated[
    float, typer.Option(min=1.0, help="Least rigid-body frequency of the plate in Hz.")
]
ClusterOption = Annotated[
    str | None, typer.Option(metavar="tcp://HOST:PORT", help="Dask scheduler.")
]


ExactOption = Annotated[
    bool, typer.Option("--exact", help="Simulate the rig's own plate, with no deviation.")
]
SeedOption = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        help="Draw another plate, ERAs, channels and fingers within the rig's uncertainty.",
        min=0,
    ),
]


def seed_of_plate(*, exact: bool, seed: int | None) -> int | None:
    """Seed of a simulated plate, by default 0; None for the rig's own.

    Raises InputError for both.
    """
    if exact and seed is not None:
        raise InputError("--exact and --seed exclude each other; give one")
    return None if exact else seed or 0
