"""Pictures as matplotlib figures, without pyplot."""

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from numpy.lib.stride_tricks import sliding_window_view

from era_haptics.drive import Played, layers_of
from era_haptics.solved_plate import SolvedPlate
from model.answer.answer import Answer
from model.arrays import FloatArray
from model.errors import InputError, expect, is_whole, shown
from model.figures import contents_figure, contrast_map_figure, layer_figure, map_figure
from model.study.contrast_maps import ContrastMap
from model.table.table import LocalizationTable
from sim.plant.excited_plate import LEVEL_WINDOW, Playback
from sim.plant.fingers import Record


def draw_map(plate: SolvedPlate, drive: Played, *, title: str = "") -> Figure:
    """Draw the peak acceleration over the plate in g (1 g = 9.8 m/s²), ERAs, nulls as red crosses.

    The picture of `era plate map`. Raises InputError for a drive that the rig cannot play.

    Example:
        >>> era.draw_map(plate, {"SW": 110}).savefig("map.png")
    """
    expect(plate, SolvedPlate, what="plate", made_by="era.SolvedPlate(rig)")
    layers = layers_of(drive, plate.rig)
    active = {name for layer in layers for each in layer.excitations for name in each}
    return map_figure(plate.rig, plate.map(drive), active=active, title=title)


def draw_answer(table: LocalizationTable, answer: Answer, *, layer: int = 0) -> Figure:
    """Draw the level of a layer of an answer over the plate [dB SL], and the fingers.

    Raises InputError for a layer that it does not have.

    Example:
        >>> era.draw_answer(table, only).savefig("answer.png")
    """
    expect(table, LocalizationTable, what="table", made_by="era.table(rig)")
    expect(answer, Answer, what="answer", made_by="era.query(table, target)")
    if not is_whole(layer) or not 0 <= layer < len(answer.layers):
        raise InputError(
            f"layer must be the number of one of the answer's {len(answer.layers)}, from 0, got "
            f"{shown(layer)}"
        )
    return layer_figure(table, answer, layer)


def draw_contents(table: LocalizationTable, answer: Answer) -> Figure:
    """Draw all layers of an answer over the plate, each in its colour, grey where they mix.

    Beside every finger its frequency, verdict, promised level and contrast; each layer alone. The
    picture of `era demo`. Raises InputError for an answer without layers.

    Example:
        >>> era.draw_contents(table, both).savefig("contents.png")
    """
    expect(table, LocalizationTable, what="table", made_by="era.table(rig)")
    expect(answer, Answer, what="answer", made_by="era.answer(table, fingers)")
    if not answer.layers:
        raise InputError("an answer must have a layer to be drawn, got one of quiet fingers")
    return contents_figure(
        table,
        answer.layers,
        [
            replace(
                each, level_db_sl=each.promised_level_db_sl, contrast_db=each.promised_contrast_db
            )
            for each in answer.fingers
        ],
    )


def draw_contrast_map(table: LocalizationTable, found: ContrastMap) -> Figure:
    """Draw promised contrast of every place to quiet fingers, drive modes side by side.

    The picture of `era table map`.

    Example:
        >>> era.draw_contrast_map(table, found).savefig("contrast.png")
    """
    expect(table, LocalizationTable, what="table", made_by="era.table(rig)")
    expect(found, ContrastMap, what="found", made_by="era.contrast_map(table, quiet)")
    return contrast_map_figure(table, found)


def draw_playback(playback: Playback) -> Figure:
    """Draw the acceleration at each finger over time [m/s²], on a logarithmic scale.

    The peak within a period of the lowest frequency, of signals within 30 ms: the mean over the
    fingertip of a target, the loudest point of a quiet finger, as in contrast.

    Example:
        >>> era.draw_playback(plate.play(only)).savefig("playback.png")
    """
    expect(playback, Playback, what="playback", made_by="plate.play(pattern, target)")
    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
    axes = figure.subplots()
    period = 1 / min(playback.frequencies, default=1 / LEVEL_WINDOW)
    for number, record in enumerate(playback.targets, start=1):
        times, peaks = _peaks(record, period)
        axes.plot(1000 * times, peaks @ record.weights, label=f"target {number}", lw=2)
    for number, record in enumerate(playback.quiet, start=1):
        times, peaks = _peaks(record, period)
        axes.plot(1000 * times, peaks.max(axis=1), label=f"quiet {number}", lw=1.2)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("time / ms")
    axes.set_ylabel("peak acceleration / m/s²")
    axes.grid(True, which="both", alpha=0.2)
    axes.legend(loc="lower right")
    if playback.contrast_db is not None:
        transient, title = playback.transient_contrast_db, f"contrast {playback.contrast_db:.1f} dB"
        if transient is not None:
            title += f" steady, {transient:.1f} dB over the first 100 ms"
        axes.set_title(title, fontsize=11)
    return figure


def _peaks(record: Record, period: float) -> tuple[FloatArray, FloatArray]:
    """Times (n,) [s] and the largest acceleration (n, p) [m/s²] within the period before each."""
    step = record.times[1] - record.times[0]
    width = min(max(1, round(period / step)), len(record.times))
    windows = sliding_window_view(np.abs(record.accelerations), width, axis=0)
    return record.times[width - 1 :], windows.max(axis=-1)
