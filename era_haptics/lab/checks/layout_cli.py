"""`era layout check`: simulate how a surface layout feels."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.commands.options import FAILED, JsonOption, Stopwatch, print_report, progress_bar
from model.quantities import counted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from era_haptics.lab.checks.checked_effect import CheckedEffect
    from era_haptics.lab.checks.joint_touches import JointTouch

_MIN_SHOWN = 0.05  # dB

layout_app = typer.Typer(no_args_is_help=True, help="Check surface layouts.")


@layout_app.command()
def check(
    layout_file: Annotated[
        Path, typer.Argument(metavar="LAYOUT", help="Layout file, e.g. LAYOUT.yaml.")
    ],
    table_file: Annotated[Path, typer.Argument(metavar="TABLE", help="Table file, e.g. T.npz.")],
    as_json: JsonOption = False,
    picture: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="PICTURE", help="Picture to write, e.g. P.png."),
    ] = None,
) -> None:
    """Simulate every region and report which regions stay distinct.

    Touches are simulated in the time domain over each region, alone and with a resting second
    finger. Pairs and triples of regions are then touched simultaneously, at the positions with the
    lowest promised contrast. Amplifiers are assumed to be phased, even if the table was built
    for switched drives. Exits with status 1 if it finds a problem in a region.
    """
    from controller.effects.layout import load_layout
    from era_haptics.lab.checks.joint_touches import check_together, close_pairs
    from era_haptics.lab.checks.layout_check import check_layout
    from model.files.output_paths import check_picture_name
    from model.finger import scale_in_words
    from model.table.table_file import load_table

    if picture is not None:
        check_picture_name(picture)
    table = load_table(table_file)
    layout = load_layout(layout_file, table.plate).for_table(table.frequencies)
    with Stopwatch() as stopwatch:
        with progress_bar("effects") as progress:
            checked = check_layout(layout, table, progress=progress)
        with progress_bar("pairs and triples") as progress:
            together = check_together(layout, table, progress=progress)
    files = []
    if picture is not None:
        from era_haptics.lab.checks.layout_picture import check_figure
        from model.figures.style import save_figure

        save_figure(check_figure(layout, table, checked, together), picture)
        files = [str(picture)]
    problem_count = sum(len(effect.problems) for effect in checked)
    touch_count = sum(len(effect.touches) for effect in checked)
    outcome = counted(problem_count, "problem") if problem_count else "good"
    rows = [scale_in_words(table.threshold)]
    for effect in checked:
        rows += _rows_of_effect(effect)
    if together:
        rows += _rows_of_matrix(together)
    rows.append(
        f"{layout_file}: {outcome}{close_pairs(together)}; "
        f"{counted(touch_count, 'touch', plural='touches')} in {stopwatch.elapsed:.1f} s"
    )
    rows += [f"wrote {name}" for name in files]
    answer = {
        "regions": [effect.as_json() for effect in checked],
        "promised_together": [touch.as_json() for touch in together],
        "files": files,
        "check_time_s": stopwatch.elapsed,
    }
    print_report(rows, answer, as_json=as_json)
    if problem_count:
        raise typer.Exit(FAILED)


def _rows_of_effect(effect: "CheckedEffect") -> list[str]:
    """Format one effect of a region."""
    from controller.effects.effect import DEFAULT_MAX_DB_SL

    level = effect.promised_db_sl
    promised = "as neighbors allow" if level is None else f"{level:.3g} dB SL"
    rows = [f"{effect.region}, {effect.on}: {effect.effect}, {promised}"]
    if effect.felt:
        low, high = effect.frequencies[0], effect.frequencies[-1]
        tones = f"{low:g} Hz" if low == high else f"{low:g} to {high:g} Hz"
        rows.append(f"  felt {_span(effect.felt)} dB SL at {tones}")
    if effect.contrasts:
        rows.append(
            f"  {_span(effect.promised_contrasts)} dB above the level at a resting second finger, "
            "on 90 % of plates"
        )
        rows.append(f"  {_span(effect.contrasts)} dB nominal")
    if effect.held_back_db > _MIN_SHOWN:
        weaker = f"  up to {effect.held_back_db:.1f} dB weaker"
        rows.append(f"{weaker} so that the resting finger feels at most half of it")
    if level is not None and level > DEFAULT_MAX_DB_SL:
        rows.append(f"  exposure up to {effect.exposure_m_s2:.2g} m/s², weighted per ISO 5349-1")
    return rows + [f"  PROBLEM {problem}" for problem in effect.problems]


def _rows_of_matrix(together: "Sequence[JointTouch]") -> list[str]:
    """Format the promised contrasts of all pairs and triples of regions."""
    from era_haptics.lab.checks.joint_touches import matrix_of
    from model.answer.answer import MIN_CONTRAST_DB, OWN_CONTRAST_DB

    names, promised = matrix_of(together)
    width = max(map(len, names)) + 4
    lines = [
        "promised contrast of the worst finger in dB: pairs of regions below the diagonal, "
        "triples above it (with the worst third region)",
        f"({OWN_CONTRAST_DB:g} or more: own, {MIN_CONTRAST_DB:g} or more: mixed, less: shared or "
        "held back)",
        f"{'':{width}}" + "".join(f"{number:6d}" for number in range(1, len(names) + 1)),
    ]
    for number, (name, row) in enumerate(zip(names, promised.tolist(), strict=True), start=1):
        cells = (f"{value:6.1f}" if value == value else f"{'-':>6}" for value in row)
        lines.append(f"{f'{number:2d} {name}':{width}}" + "".join(cells))
    return lines


def _span(values: list[float]) -> str:
    """Format the range and the median of values."""
    from era_haptics.lab.checks.checked_effect import distribution

    row = distribution(values)
    return f"{row['min']:.1f} to {row['max']:.1f} (median {row['median']:.1f})"
