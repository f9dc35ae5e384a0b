"""Build localization tables, query them for fingers, and map contrast."""

from collections.abc import Sequence
from functools import lru_cache

from era_haptics.drive import (
    Fingers,
    Positions,
    as_fingers,
    as_frequencies,
    as_points,
    expect_rig,
    warn_of_surface,
)
from model.answer import answer_report, plan
from model.answer.answer import APART_HZ, Answer
from model.answer.answer_report import Measures, Timing
from model.answer.stimulus import MUST, Finger, Stimulus
from model.arrays import FloatArray
from model.errors import InputError, expect_instance, expect_number, shown
from model.finger import STRONG_DB_SL, Grid
from model.processes import Progress, check_progress, unseen
from model.rig.rig import Rig
from model.study.contrast_maps import ContrastMap, map_contrast
from model.table.table import PAPER_GRID, LocalizationTable
from model.table.table_file import cached_table


def table(
    rig: Rig,
    *,
    drive_mode: str = "phased",
    frequencies: Sequence[float] | FloatArray | None = None,
    grid: Grid = PAPER_GRID,
    progress: Progress = unseen,
) -> LocalizationTable:
    """Return the rig's localization table from the user's cache, or build it in a second or two.

    - drive_mode: default of later queries: `phased`, or for amplifiers that cannot set phases
      another mode (`era table build --help` lists them).
    - frequencies (f,) [Hz]: ascending, within the rig's limits; default: 40 to 500 in steps of 10,
      as far as the limits allow.
    - grid: target cells.
    - progress: called with the number of parts built and the total.

    Same table as `era table build`; for files, use `load_table` and `save_table`. Raises
    InputError.

    Example:
        >>> table = era.table(rig)
    """
    expect_rig(rig)
    warn_of_surface(rig)
    expect_instance(grid, Grid, what="grid", made_by="era.Grid(12, 9)")
    _expect_mode(drive_mode)
    chosen = None if frequencies is None else as_frequencies(frequencies)
    check_progress(progress)
    return cached_table(
        rig, frequencies=chosen, grid=grid, drive_mode=drive_mode, progress=progress
    )[0]


def query(
    table: LocalizationTable,
    target: Positions,
    *,
    quiet: Fingers = (),
    level_db_sl: float = STRONG_DB_SL,
    duration: float | None = None,
    drive_mode: str | None = None,
    shaped: bool = False,
) -> Answer:
    """Query the table for fingers at the given positions [m] that share a vibration.

    Short form of `answer`; other parameters are explained there. Same as `era table query
    --target`.

    - target: one position or several.
    - level_db_sl: above the detection threshold; 20 dB is strong.
    - duration [s]: duration of a short effect, over which the level is averaged.

    Example:
        >>> only = era.query(table, one, quiet=other)
        >>> f"{only.layers[0].frequency:.0f} Hz, {only.fingers[0].promised_contrast_db:.0f} dB"
        '240 Hz, 15 dB'
    """
    stimulus = Stimulus(level_db_sl, duration=duration, name="target")
    fingers = [Finger(at, stimulus, sharing=MUST) for at in as_points(target, what="target")]
    return answer(table, fingers, quiet=quiet, drive_mode=drive_mode, shaped=shaped)


def answer(
    table: LocalizationTable,
    fingers: Sequence[Finger],
    *,
    quiet: Fingers = (),
    drive_mode: str | None = None,
    shaped: bool = False,
    apart_hz: float = APART_HZ,
    bands_may_swap: bool = False,
) -> Answer:
    """Query the table for several fingers, each with its own vibration.

    - quiet: fingers that should feel nothing, as positions [m] or as fingers.
    - drive_mode: default the table's; must be `phased` for more than one vibration.
    - shaped: use shaped onsets and endings, which the amplifiers must support.
    - apart_hz: minimum distance between frequencies.
    - bands_may_swap: allow bands to be swapped between fingers.

    If the worst finger would have less than 6 dB, vibrations are shared or held back as the fingers
    allow. Levels that exceed the ERAs' full stroke are lowered (`Answer.applied`). Raises
    InputError for fingers off the plate or at the same position, and for a band without
    frequencies. Same as `era table query --own`.

    Example:
        >>> one, other = (0.08, 0.06), (0.22, 0.16)
        >>> both = era.answer(table, [era.Finger(at, era.Stimulus()) for at in (one, other)])
        >>> [(each.verdict, f"{each.promised_contrast_db:.0f} dB") for each in both.fingers]
        [('own', '14 dB'), ('own', '15 dB')]
    """
    expect_instance(table, LocalizationTable, what="table", made_by="era.table(rig)")
    expect_instance(
        fingers, Sequence, what="fingers", made_by="[era.Finger((0.08, 0.06), era.Stimulus())]"
    )
    for finger in fingers:
        made_by = "era.Finger((0.08, 0.06), era.Stimulus())"
        expect_instance(finger, Finger, what="a finger", made_by=made_by)
    expect_number(apart_hz, what="apart_hz", unit="hertz")
    if drive_mode is not None:
        _expect_mode(drive_mode)
    result = plan.answer(
        table,
        fingers,
        quiet=as_fingers(quiet, what="quiet"),
        drive_mode=drive_mode,
        shaped=shaped,
        apart_hz=apart_hz,
        bands_may_swap=bands_may_swap,
    )
    return _timing(table).shaped(result) if shaped else result


def measures(table: LocalizationTable, answer: Answer) -> Measures:
    """Compute transient contrast, residual and concentration of an answer's first layer.

    Takes about ten milliseconds.

    Example:
        >>> f"{era.measures(table, only).transient_contrast_db:.0f} dB in the first 100 ms"
        '23 dB in the first 100 ms'
    """
    expect_instance(table, LocalizationTable, what="table", made_by="era.table(rig)")
    expect_instance(answer, Answer, what="answer", made_by="era.query(table, target)")
    return answer_report.measures(table, answer, timing=_timing(table))


def contrast_map(
    table: LocalizationTable,
    quiet: Positions,
    *,
    drive_modes: Sequence[str] = (),
    level_db_sl: float = STRONG_DB_SL,
    grid: Grid | None = None,
    progress: Progress = unseen,
) -> ContrastMap:
    """Map the contrast between a finger at each position and the quiet fingers [m], like `era table
    map`.

    drive_modes: several to compare them, default the table's; level_db_sl: at each position; grid:
    positions, default the table's cells; progress: called with the number of queries done and the
    total. Raises InputError for fingers off the plate, and for an unknown drive mode.

    Example:
        >>> found = era.contrast_map(table, quiet=other, grid=era.Grid(6, 4))
        >>> found.promised_db["phased"].shape
        (4, 6)
    """
    expect_instance(table, LocalizationTable, what="table", made_by="era.table(rig)")
    if isinstance(drive_modes, str):
        raise InputError(f"drive_modes must be a list such as ['phased'], got {drive_modes!r}")
    expect_instance(drive_modes, Sequence, what="drive_modes", made_by="['switched', 'phased']")
    expect_number(level_db_sl, what="level_db_sl", unit="decibels above the threshold")
    if grid is not None:
        expect_instance(grid, Grid, what="grid", made_by="era.Grid(12, 9)")
    for mode in drive_modes:
        _expect_mode(mode)
    check_progress(progress)
    return map_contrast(
        table,
        as_points(quiet, what="quiet"),
        drive_modes=drive_modes,
        level_db_sl=float(level_db_sl),
        grid=grid,
        progress=progress,
    )


def _expect_mode(drive_mode: object) -> None:
    """Raise InputError for anything but text."""
    if not isinstance(drive_mode, str):
        raise InputError(f"drive_mode must be a name such as 'phased', got {shown(drive_mode)}")


@lru_cache(maxsize=2)
def _timing(table: LocalizationTable) -> Timing:
    """Return the timing of a table, cached for two: notebooks query a table often, then another."""
    return Timing(table)
