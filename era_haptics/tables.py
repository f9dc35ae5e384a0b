"""The localization table, and queries of it."""

from collections.abc import Sequence
from functools import lru_cache

from era_haptics.arguments import Positions, as_frequencies, as_loads, as_points, expect_rig
from model.answer.answer import answer as _answer
from model.answer.pattern import Pattern
from model.answer.query import query_table
from model.answer.question import Question
from model.answer.request import APART_HZ, Answer, Finger, Request
from model.answer.timing import Timing
from model.arguments import expect, expect_number, shown
from model.arrays import FloatArray
from model.errors import InputError
from model.finger.grid import Grid
from model.finger.perception import STRONG_DB_SL
from model.rig.rig import Rig
from model.study.contrast_map import ContrastMap, map_contrast
from model.table.table import PAPER_GRID, LocalizationTable
from model.table.table_cache import cached_table


def table(
    rig: Rig,
    *,
    drive_mode: str = "switched",
    frequencies: Sequence[float] | FloatArray | None = None,
    grid: Grid = PAPER_GRID,
) -> LocalizationTable:
    """Load the rig's localization table from the user's cache, or build it in a second or two.

    drive_mode: its default, `switched` or `phased`; frequencies (f,) [Hz]:
    ascending, within the rig's limits, by default 40 to 500 in steps of 10 within these; grid:
    target cells. The table of `era table build`; `load_table` and `save_table` are for files.
    Raises InputError.
    """
    expect_rig(rig)
    expect(grid, Grid, what="grid", made_by="era.Grid(12, 9)")
    _expect_mode(drive_mode)
    chosen = None if frequencies is None else as_frequencies(frequencies)
    found, _ = cached_table(rig, frequencies=chosen, grid=grid, drive_mode=drive_mode)
    return found


def query(
    table: LocalizationTable,
    target: Positions,
    *,
    quiet: Positions = (),
    level_db_sl: float = STRONG_DB_SL,
    drive_mode: str | None = None,
    envelopes: bool = False,
    loads: Sequence[float] = (),
    measures: bool = True,
) -> Pattern:
    """Find the best pattern for fingers at these positions [m], with its predicted measures.

    target: fingers to feel it; quiet: fingers not to feel it; each one position or several.
    level_db_sl: level at the target above its detection threshold, 20 dB is strong; drive_mode:
    the table's own if None; envelopes: for amplifiers that play shaped onsets and endings;
    loads: of each finger relative to the rig's fingertip, targets first, 1 without;
    measures: compute transient and promised contrast and concentration, too, some ten milliseconds.
    Raises InputError for positions off the plate or at the same point, and a level that cannot be
    reached. The same as `era table query`.
    """
    expect(table, LocalizationTable, what="table", made_by="era.table(rig)")
    expect_number(level_db_sl, what="level_db_sl", unit="decibels above the threshold")
    if drive_mode is not None:
        _expect_mode(drive_mode)
    question = Question(
        as_points(target, what="target"),
        as_points(quiet, what="quiet"),
        level_db_sl=float(level_db_sl),
        drive_mode=drive_mode,
        envelopes=envelopes,
        loads=as_loads(loads),
    )
    pattern, _ = query_table(table, question, _timing(table), measures=measures)
    return pattern


def answer(
    table: LocalizationTable,
    requests: Sequence[Request],
    fingers: Sequence[Finger] = (),
    *,
    apart_hz: float = APART_HZ,
    bands_may_swap: bool = False,
    drive_mode: str | None = None,
) -> Answer:
    """Answer the requests of several fingers at once, each with a vibration of its own.

    fingers: the others, which are to feel nothing; apart_hz: distance of the frequencies;
    bands_may_swap: whether a finger may have another one's band; drive_mode: the table's own if
    None, which must be `phased` for more than one vibration. Where the worst finger would have
    less than 6 dB, contents are shared or held back as the requests allow (`Answer.applied`).
    Raises InputError for fingers off the plate or at one place, and for a band without
    frequencies. The same as `era table query --own`.
    """
    expect(table, LocalizationTable, what="table", made_by="era.table(rig)")
    expect(requests, Sequence, what="requests", made_by="[era.Request((0.08, 0.06))]")
    for request in requests:
        expect(request, Request, what="a request", made_by="era.Request((0.08, 0.06))")
    expect(fingers, Sequence, what="fingers", made_by="[era.Finger((0.22, 0.16))]")
    for finger in fingers:
        expect(finger, Finger, what="a finger", made_by="era.Finger((0.22, 0.16))")
    expect_number(apart_hz, what="apart_hz", unit="hertz")
    if drive_mode is not None:
        _expect_mode(drive_mode)
    return _answer(
        table,
        requests,
        fingers,
        apart_hz=apart_hz,
        bands_may_swap=bands_may_swap,
        drive_mode=drive_mode,
    )


def contrast_map(
    table: LocalizationTable,
    quiet: Positions,
    *,
    drive_modes: Sequence[str] = (),
    level_db_sl: float = STRONG_DB_SL,
    grid: Grid | None = None,
) -> ContrastMap:
    """Map the contrast of a finger at every place to these quiet fingers [m], as `era table map`.

    drive_modes: the table's own for none, several to compare them; level_db_sl: at each place;
    grid: places, the table's cells if None. Raises InputError for fingers off the plate, and for
    an unknown drive mode.
    """
    expect(table, LocalizationTable, what="table", made_by="era.table(rig)")
    expect(drive_modes, Sequence, what="drive_modes", made_by="['switched', 'phased']")
    expect_number(level_db_sl, what="level_db_sl", unit="decibels above the threshold")
    if grid is not None:
        expect(grid, Grid, what="grid", made_by="era.Grid(12, 9)")
    for mode in drive_modes:
        _expect_mode(mode)
    return map_contrast(
        table,
        as_points(quiet, what="quiet"),
        drive_modes=drive_modes,
        level_db_sl=float(level_db_sl),
        grid=grid,
    )


def _expect_mode(given: object) -> None:
    """Raise InputError for anything but text."""
    if not isinstance(given, str):
        raise InputError(f"drive_mode must be a name such as 'phased', got {shown(given)}")


@lru_cache(maxsize=2)  # a notebook asks one table after the other, many times each
def _timing(table: LocalizationTable) -> Timing:
    return Timing(table)
