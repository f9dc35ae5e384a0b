"""The figures of the founding paper by their numbers."""

from collections.abc import Iterator

from model.errors import InputError
from model.paper.box_plots import one_era_figure, two_era_figure
from model.paper.figure import PaperFigure
from model.paper.mode_shapes import era_supported_figure, simply_supported_figure
from model.paper.pattern_maps import (
    activation_maps_figure,
    stiffness_maps_figure,
    switched_patterns_figure,
)
from model.paper.printed import FIGURE_12_FREQUENCIES
from model.paper.stiffness import stiffness_study_figure
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig

_MODES = {"6": (simply_supported_figure,), "7": (era_supported_figure,)}

_RESPONSES = {
    "10": (one_era_figure,),
    "11": (two_era_figure, activation_maps_figure),  # the paper gives this number twice
    "12": (switched_patterns_figure,),
    "13": (stiffness_maps_figure, stiffness_study_figure),
}

FIGURE_NUMBERS = (*_MODES, *_RESPONSES)

HIGHEST_FREQUENCY = max(max(pair) for pair in FIGURE_12_FREQUENCIES)
"""Highest frequency [Hz] in any of the figures."""


def paper_figures(rig: Rig, number: str) -> Iterator[PaperFigure]:
    """Make the figures of one number, or of `all`, on a rig's plate and mesh.

    Raises InputError for a number without results in the paper, for a mesh too coarse for 320 Hz,
    and for a rig with fewer than two ERAs where a pair is driven.
    """
    if number not in (*FIGURE_NUMBERS, "all"):
        raise InputError(
            f"figure must be one of {', '.join(FIGURE_NUMBERS)} or all, got {number!r}"
        )
    for key, of_modes in _MODES.items():
        if number in (key, "all"):
            yield from (figure(rig) for figure in of_modes)
    wanted = [made for key, made in _RESPONSES.items() if number in (key, "all")]
    if not wanted:
        return
    free_plate = solve_free_plate(rig.plate, rig.mesh, frequency_max=HIGHEST_FREQUENCY)
    for of_response in wanted:
        yield from (figure(rig, free_plate) for figure in of_response)
