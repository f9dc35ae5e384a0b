"""Contrast between simultaneously touched regions of a layout, and pictures of checked layouts."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon as Outline
from matplotlib.patheffects import withStroke

from controller.effects.effect import Region
from controller.effects.layout import SurfaceLayout
from controller.play.intent import FingerTarget, Target
from controller.play.joint_answers import fingers_of, selection_of
from controller.play.selected_contents import Question, Selection
from controller.sources.touch import Contact, ContactKey
from era_haptics.lab.checks.layout_check import (
    CheckedEffect,
    SimulatedTouch,
    TouchSimulator,
    strongest_target,
    touch_positions,
)
from model.answer.answer import MIN_CONTRAST_DB, OWN_CONTRAST_DB, Answer
from model.answer.plan import answer
from model.arrays import FloatArray, Point, best_of
from model.figures.style import PAGE_WIDTH, SMALL_TEXT, TITLE_TEXT, draw_eras, label_plate
from model.processes import Progress, unseen
from model.quantities import counted
from model.table.table import LocalizationTable

MAX_PAIRS, MAX_TRIPLES = 150, 150
"""In layouts with many regions, only the closest pairs and triples are checked."""

_POSITIONS = 4  # per region: the center, then points farthest from it and from each other
_NAMED = 4  # pairs that are close
_NEAREST = 0.02  # m; two fingertips next to each other


@dataclass(frozen=True)
class JointTouch:
    """Simultaneous fingers in two or three regions, at the positions with the lowest contrast.

    at [m]: finger positions; contrasts [dB]: promised contrast of each content with the others
    there, if all play; worst_db: lowest contrast of all fingers on the same plates; verdicts: after
    the rule that mixes, shares or holds back.
    """

    regions: tuple[str, ...]
    at: tuple[Point, ...]
    contrasts: tuple[float, ...]
    worst_db: float
    verdicts: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the JSON object of `era layout check --json`."""
        return {
            "regions": [*self.regions],
            "at_m": [[*at] for at in self.at],
            "promised_contrast_db": [*self.contrasts],
            "promised_worst_db": self.worst_db,
            "promised_verdicts": [*self.verdicts],
        }


def check_together(
    layout: SurfaceLayout,
    table: LocalizationTable,
    *,
    progress: Progress = unseen,
) -> list[JointTouch]:
    """Answer fingers in all pairs and triples of regions at their worst positions.

    For a pair, these are the worst of four positions per region, with all effects taken as steady;
    for a triple, the worst of the positions of its pairs. progress: called with the number of pairs
    and triples answered and the total.
    """
    simulator = TouchSimulator(table)
    targets, places = dict[str, Target](), dict[str, list[Point]]()
    for region in layout.regions:
        target, some = _target_in(layout, region), _some_of(layout, region, table)
        if target is not None and some:
            targets[region.name], places[region.name] = target, some
    regions = [each for each in layout.regions if each.name in targets]
    pairs = _nearest(combinations(regions, 2), MAX_PAIRS)
    triples = _nearest(combinations(regions, 3), MAX_TRIPLES)
    total, found = len(pairs) + len(triples), []
    worst_in: dict[str, dict[str, Point]] = {each.name: {} for each in regions}
    for number, group in enumerate((*pairs, *triples)):
        progress(number, total)
        spots = [places[each.name] for each in group]
        if len(group) > 2:
            names = {each.name for each in group}
            spots = [
                [*dict.fromkeys(at for other, at in worst_in[name].items() if other in names)]
                or places[name][:1]
                for name in (each.name for each in group)
            ]
        felt = [
            replace(targets[each.name], key=ContactKey("check", at))
            for at, each in enumerate(group)
        ]
        together = _worst(simulator, group, felt, spots)
        if together is None:
            continue
        found.append(together)
        if len(group) == 2:
            for one, other, at in zip(group, reversed(group), together.at, strict=True):
                worst_in[one.name][other.name] = at
    progress(total, total)
    return found


def matrix_of(together: Sequence[JointTouch]) -> tuple[list[str], FloatArray]:
    """Return the regions' names, and the promised contrast of the worst finger (n, n) [dB].

    Below the diagonal: pairs. Above: triples with the worst third region. NaN if not checked.
    """
    names = [*dict.fromkeys(name for each in together for name in each.regions)]
    found = np.full((len(names), len(names)), np.nan)
    for each in together:
        rows = sorted(names.index(name) for name in each.regions)
        for one, other in combinations(rows, 2):
            at = (other, one) if len(rows) == 2 else (one, other)
            found[at] = np.fmin(found[at], each.worst_db)
    return names, found


def close_pairs(together: Sequence[JointTouch]) -> str:
    """Format the pairs of regions felt as one, lowest contrast first; empty without any."""
    pairs = [each for each in together if len(each.regions) == 2]
    close = sorted(
        (each for each in pairs if each.worst_db < MIN_CONTRAST_DB), key=lambda each: each.worst_db
    )
    if not close:
        return ""
    named = [f"{' with '.join(each.regions)} {each.worst_db:.1f} dB" for each in close[:_NAMED]]
    more = f" and {len(close) - _NAMED} more" if len(close) > _NAMED else ""
    return (
        f", but {len(close)} of {counted(len(pairs), 'pair')} of regions below "
        f"{MIN_CONTRAST_DB:g} dB together: {', '.join(named)}{more}; move these regions apart, or "
        "widen or remove their bands"
    )


def _target_in(layout: SurfaceLayout, region: Region) -> Target | None:
    """Return what a finger in a region feels; continuous effects come first."""
    names = [name for name in (region.on_press, region.on_move) if name is not None]
    found = [strongest_target(layout, name, region, at=region.shape.centre) for name in names]
    felt = [each for each in found if each is not None]
    return min(felt, key=lambda each: each.is_short, default=None)


def _some_of(layout: SurfaceLayout, region: Region, table: LocalizationTable) -> list[Point]:
    """Return a few positions in a region: the center, then each the farthest from those before."""
    left, found = touch_positions(layout, region, table.plate)[0], list[Point]()
    while left and len(found) < _POSITIONS:
        if found:
            away = [min(math.dist(at, other) for other in found) for at in left]
        else:
            away = [-math.dist(at, region.shape.centre) for at in left]
        found.append(left.pop(best_of(away)))
    return found


def _nearest(groups: Iterable[tuple[Region, ...]], count: int) -> list[tuple[Region, ...]]:
    """Return the groups of regions whose centers are closest, in the order of the layout."""
    every = [*groups]

    def size(number: int) -> float:
        centres = [each.shape.centre for each in every[number]]
        return sum(math.dist(*pair) for pair in combinations(centres, 2))

    return [every[number] for number in sorted(sorted(range(len(every)), key=size)[:count])]


def _worst(
    simulator: TouchSimulator,
    group: Sequence[Region],
    targets: Sequence[Target],
    spots: Sequence[Sequence[Point]],
) -> JointTouch | None:
    """Answer at all combinations of positions; None if the fingers never fit."""
    free = [replace(target, is_own=False) for target in targets]
    steady = [replace(target, modulation_hz=None) for target in free]
    tried: list[tuple[float, tuple[Point, ...]]] = []
    for at in product(*spots):
        if all(math.dist(*pair) >= _NEAREST for pair in combinations(at, 2)):
            worst = _answered(simulator, _placed(steady, at), []).promised_worst_db
            tried.append((math.inf if worst is None else worst, at))
    if not tried:
        return None
    _, at = tried[best_of([-worst for worst, _ in tried])]
    protected = frozenset(
        target.key for target, each in zip(targets, group, strict=True) if each.is_protected
    )
    worst_db, felt = _felt(simulator, _placed(free, at), None)
    _, served = _felt(simulator, _placed(targets, at), protected)
    return JointTouch(
        tuple(each.name for each in group),
        at,
        tuple(contrast for contrast, _ in felt),
        worst_db,
        tuple(verdict for _, verdict in served),
    )


def _placed(targets: Sequence[Target], at: Sequence[Point]) -> list[FingerTarget]:
    """Return targets with their contacts."""
    return [
        FingerTarget(Contact(target.key, x, y, since=0.0), target)
        for target, (x, y) in zip(targets, at, strict=True)
    ]


def _felt(
    simulator: TouchSimulator,
    fingers: Sequence[FingerTarget],
    protected: frozenset[ContactKey] | None,
) -> tuple[float, list[tuple[float, str]]]:
    """Return the contrast of the worst finger, and the contrast and verdict of each finger.

    Short effects play on top of continuous ones, one at a time, with all other fingers quiet. If
    protected is None, all contents play, whatever their contrast.
    """
    lasting = tuple(finger for finger in fingers if not finger.target.is_short)
    short = tuple(finger for finger in fingers if finger.target.is_short)
    found: dict[ContactKey, tuple[float, str]] = {}
    worst, beside = math.inf, list[Selection]()
    if lasting:
        quiet = [finger.contact for finger in short]
        together = _answered(simulator, lasting, quiet, protected)
        contacts = [finger.contact for finger in lasting]
        question = Question((*contacts, *quiet), lasting, short)
        worst = math.inf if together.promised_worst_db is None else together.promised_worst_db
        beside = [selection_of(simulator.table, question, together, lasting)]
        for contact, each in zip(contacts, together.fingers, strict=False):
            found[contact.key] = each.promised_contrast_db or 0.0, each.verdict
    down = tuple(finger.contact for finger in fingers)
    for finger in short:
        key = finger.contact.key
        question = Question(down, (), (finger,), protected or frozenset(), kept=tuple(beside))
        (chosen,) = simulator.chooser.choose(question, simulator.capabilities)
        (felt,) = chosen.beside(beside, simulator.table).finger_sensations
        found[key] = felt.sensation.promised_contrast_db or 0.0, felt.sensation.verdict
        worst = min(worst, found[key][0])
    return worst, [found[finger.contact.key] for finger in fingers]


def _answered(
    simulator: TouchSimulator,
    fingers: Sequence[FingerTarget],
    quiet: Sequence[Contact],
    protected: frozenset[ContactKey] | None = None,
) -> Answer:
    """Answer fingers with continuous effects, including modulation; protected: see `_felt`."""
    table, capabilities = simulator.table, simulator.capabilities
    every = fingers_of(table, fingers, quiet, capabilities, protected or frozenset())
    least = -math.inf if protected is None else MIN_CONTRAST_DB
    return answer(
        table,
        every,
        drive_mode=capabilities.drive_mode,
        min_contrast_db=least,
        limits=capabilities.limits,
    )


_LEVEL_TOLERANCE_DB = 2.0
_LEVEL_EDGES = [-12.0, -6.0, -4.0, -2.0, 2.0, 4.0, 6.0, 12.0]  # dB
_MAX_CONTRAST = 30.0  # dB
_FREQUENCY_TICKS = (40, 60, 100, 150, 250, 400, 600)  # Hz
_NO_PROMISE = "#bbbbbb"
_MAX_JOINED = 12  # simultaneous fingers drawn connected, for each count
_BRIGHT = 0.6  # position on a color scale above which black text is readable
_SIZES = (44.0, 16.0, 5.0)  # of marks; smaller marks are a region's further effects


@dataclass(frozen=True)
class _TouchPanel:
    """A panel with one mark for each touch."""

    title: str
    label: str
    """Of the color bar."""
    value: Callable[[CheckedEffect, SimulatedTouch], float | None]
    """Value shown by a mark's color; None without a value."""
    norm: Normalize
    colors: str
    marker: Callable[[float], str] = lambda _: "o"
    """Shape of a value's mark."""

    def color(self, value: float) -> tuple[float, float, float, float]:
        """Return the color of a value on the panel's scale."""
        return colormaps[self.colors](self.norm(value))


def _level_marker(difference_db: float) -> str:
    """Return a triangle that points up above the promised level and down below it."""
    if abs(difference_db) <= _LEVEL_TOLERANCE_DB:
        return "o"
    return "^" if difference_db > 0 else "v"


def _touch_panels(frequencies: FloatArray) -> list[_TouchPanel]:
    """Return the panels for a table with these frequencies [Hz]."""
    low, high = float(frequencies[0]), float(frequencies[-1])
    return [
        _TouchPanel(
            "level: felt minus promised",
            "felt minus promised level / dB\n(triangles: outside ±2 dB)",
            _off_level,
            BoundaryNorm(_LEVEL_EDGES, 256, extend="both"),
            "RdBu_r",
            _level_marker,
        ),
        _TouchPanel(
            "frequency",
            "frequency / Hz",
            lambda _, touch: touch.frequencies[0] if touch.frequencies else None,
            LogNorm(low, max(high, 1.01 * low)),
            "viridis",
        ),
        _TouchPanel(
            "contrast with a resting second finger",
            "promised contrast / dB",
            lambda _, touch: touch.promised_contrast_db,
            Normalize(0.0, _MAX_CONTRAST),
            "viridis",
        ),
    ]


def check_figure(
    layout: SurfaceLayout,
    table: LocalizationTable,
    checked: Sequence[CheckedEffect],
    together: Sequence[JointTouch] = (),
) -> Figure:
    """Draw three panels with one mark per touch, and crosses where nothing is felt.

    The panels show the felt minus the promised level (the worse of alone and with a resting
    finger), the frequency, and the promised contrast with the resting finger. Then simultaneous
    fingers in two and three regions at their worst positions, and the promised contrast of the
    worst finger.
    """
    panels = _touch_panels(table.frequencies)
    rows = 3 if together else 2
    panel_height = (PAGE_WIDTH / 2 - 1.1) * table.plate.width / table.plate.length + 0.8
    figure = Figure(figsize=(PAGE_WIDTH, rows * panel_height + 0.3), layout="constrained")
    subplots = figure.subplots(rows, 2).ravel()
    for axes, panel in zip(subplots, panels, strict=False):
        _draw_touch_panel(figure, axes, panel, layout, table, checked)
    if together:
        _draw_together(figure, [*subplots[len(panels) :]], layout, table, together)
    else:
        subplots[-1].set_axis_off()
    figure.supxlabel(
        "Crosses: nothing is felt. Gray marks: no promise. Small marks: a region's other effects. "
        "Squares at the edges: ERAs.",
        fontsize=SMALL_TEXT,
        wrap=True,
    )
    return figure


def _draw_touch_panel(
    figure: Figure,
    axes: Axes,
    panel: _TouchPanel,
    layout: SurfaceLayout,
    table: LocalizationTable,
    checked: Sequence[CheckedEffect],
) -> None:
    """Draw the layout, the values of all touches, and their scale."""
    axes.set_title(panel.title, fontsize=TITLE_TEXT)
    _draw_layout(axes, layout, table)
    _draw_touches(axes, checked, panel)
    scale = ScalarMappable(panel.norm, panel.colors)
    bar = figure.colorbar(scale, ax=axes, shrink=0.85)
    bar.set_label(panel.label, fontsize=SMALL_TEXT)
    if isinstance(panel.norm, LogNorm):
        low, high = panel.norm.vmin or 0.0, panel.norm.vmax or 0.0
        ticks = [hertz for hertz in _FREQUENCY_TICKS if low <= hertz <= high]
        bar.set_ticks(ticks, labels=[str(hertz) for hertz in ticks], minor=False)
        bar.minorticks_off()
    bar.ax.tick_params(labelsize=SMALL_TEXT)


def _draw_together(
    figure: Figure,
    panels: Sequence[Axes],
    layout: SurfaceLayout,
    table: LocalizationTable,
    together: Sequence[JointTouch],
) -> None:
    """Draw simultaneous fingers at their worst positions, connected by lines, and the matrix."""
    colors, norm = colormaps["viridis"], Normalize(0.0, 2 * OWN_CONTRAST_DB)
    for axes, count in zip(panels, (2, 3), strict=False):
        _draw_layout(axes, layout, table)
        of_count = [touch for touch in together if len(touch.regions) == count]
        shown = sorted(of_count, key=lambda touch: touch.worst_db)[:_MAX_JOINED]
        title = f"worst positions of fingers in {count} regions"
        if len(shown) < len(of_count):
            title += f"\n(the worst {len(shown)} of {len(of_count)})"
        axes.set_title(title, fontsize=TITLE_TEXT)
        for touch in reversed(shown):
            x, y = _columns([*touch.at, touch.at[0]])
            axes.plot(x, y, "o-", color=colors(norm(touch.worst_db)), lw=1.2, ms=4)
    axes = panels[-1]
    names, promised = matrix_of(together)
    axes.imshow(promised, cmap=colors, norm=norm)
    for (row, column), value in np.ndenumerate(promised):
        if not math.isnan(value):
            ink = "black" if norm(value) > _BRIGHT else "white"
            axes.text(column, row, f"{value:.0f}", ha="center", va="center", color=ink, fontsize=8)
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=SMALL_TEXT)
    axes.set_yticks(range(len(names)), names, fontsize=SMALL_TEXT)
    axes.set_title("pairs below the diagonal, triples above", fontsize=TITLE_TEXT)
    bar = figure.colorbar(ScalarMappable(norm, colors), ax=axes, shrink=0.85)
    label = "promised contrast of the worst finger / dB\n(also colors the lines)"
    bar.set_label(label, fontsize=SMALL_TEXT)
    bar.ax.tick_params(labelsize=SMALL_TEXT)


def _off_level(each: CheckedEffect, touch: SimulatedTouch) -> float | None:
    if touch.felt_db_sl is None or each.promised_db_sl is None:
        return None
    return touch.felt_db_sl - each.promised_db_sl


def _draw_layout(axes: Axes, layout: SurfaceLayout, table: LocalizationTable) -> None:
    """Draw the plate, its ERAs, and the regions with their names."""
    length, width = 100 * table.plate.length, 100 * table.plate.width
    axes.add_patch(Outline([(0, 0), (length, 0), (length, width), (0, width)], fill=False))
    axes.set_xlim(-0.5, length + 0.5)
    axes.set_ylim(-0.5, width + 0.5)
    for region in layout.regions:
        corners = 100 * np.array(region.shape.corners())
        axes.add_patch(Outline(corners, facecolor="#f2f2f2", edgecolor="#555555", lw=1))
        _label_region(axes, region.name, corners)
    label_plate(axes)
    draw_eras(axes, table.eras, active=(), size=6)


_NAME_HEIGHT = 1.4  # cm


def _label_region(axes: Axes, name: str, corners: FloatArray) -> None:
    """Write the name above a region, or below it if there is no room on the plate.

    The name of a region that is much taller than wide is rotated and next to it.
    """
    length, width = np.ptp(corners, axis=0)
    is_tall = width > 2 * length
    is_high = corners[:, 1].max() + _NAME_HEIGHT > axes.get_ylim()[1]
    if is_tall:
        edge, offset, alignment, across = corners[:, 0].max(), (2, 0), ("left", "center"), 0
    elif is_high:
        edge, offset, alignment, across = corners[:, 1].min(), (0, -2), ("center", "top"), 1
    else:
        edge, offset, alignment, across = corners[:, 1].max(), (0, 2), ("center", "baseline"), 1
    on_edge = np.isclose(corners[:, across], edge, atol=1e-6)
    axes.annotate(
        name,
        corners[on_edge].mean(axis=0),
        xytext=offset,
        textcoords="offset points",
        ha=alignment[0],
        va=alignment[1],
        rotation=90 if is_tall else 0,
        fontsize=SMALL_TEXT,
        path_effects=[withStroke(linewidth=2, foreground="white")],
        zorder=3,
    )


def _draw_touches(axes: Axes, checked: Sequence[CheckedEffect], panel: _TouchPanel) -> None:
    """Draw for every touch the value farthest from zero, or the lowest contrast."""
    drawn: dict[str, int] = {}  # effects per region
    for effect in checked:
        number = drawn.get(effect.region, 0)
        drawn[effect.region] = number + 1
        values: dict[Point, float | None] = {}
        for touch in effect.touches:
            value, largest = panel.value(effect, touch), values.get(touch.at)
            if largest is None or (value is not None and abs(value) > abs(largest)):
                values[touch.at] = value
        silent = {touch.at for touch in effect.touches if touch.felt_db_sl is None}
        axes.plot(*_columns(silent), "x", color="black", ms=5)
        size = _SIZES[min(number, len(_SIZES) - 1)]
        for at, value in values.items():
            if at in silent:
                continue
            x, y = 100 * at[0], 100 * at[1]
            color = _NO_PROMISE if value is None else panel.color(value)
            marker = "o" if value is None else panel.marker(value)
            axes.scatter(
                x, y, size, marker=marker, facecolors=[color], edgecolors="#555555", lw=0.5
            )


def _columns(places: Iterable[Point]) -> FloatArray:
    """Return positions [m] as rows x and y [cm], (2, n)."""
    return 100 * np.array([*places], dtype=float).reshape(-1, 2).T
