"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

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
