"""A reproduced figure of the paper: the picture, its numbers and findings."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

from matplotlib.figure import Figure

from model.files.csv_file import Columns

Finding: TypeAlias = float | int | bool | str | list[float] | list[str] | dict[str, float]


@dataclass(frozen=True)
class PaperFigure:
    """name: the picture's file name without its ending.

    tables: the numbers that are drawn, by the end of their file's name; findings: what the paper
    says about this figure, as numbers, by a name that ends in the unit.
    """

    name: str
    figure: Figure
    tables: Mapping[str, Columns]
    findings: Mapping[str, Finding] = field(default_factory=dict)
