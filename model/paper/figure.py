"""A reproduced figure of the paper: the picture, its numbers and findings."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

from matplotlib.figure import Figure

from model.files.csv_file import Columns

Finding: TypeAlias = float | int | bool | str | list[float] | list[str] | dict[str, float]


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the paper.

    name: of the picture's file, without suffix; tables: the numbers drawn, by the end of their
    file's name; findings: claims of the paper about this figure as numbers, named with their unit.
    """

    name: str
    figure: Figure
    tables: Mapping[str, Columns]
    findings: Mapping[str, Finding] = field(default_factory=dict)
