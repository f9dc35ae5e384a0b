"""`era layout check`: simulate how a surface layout feels."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.commands.options import FAILED, JsonOption, print_report
from model.quantities import counted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from era_haptics.lab.checks.layout_check import CheckedEffect
    from model.arrays import FloatArray

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
    import time

    from controller.effects.layout import load_layout
    from era_haptics.lab.checks.layout_check import check_layout
    from era_haptics.lab.checks.layout_picture import check_together, close_pairs, matrix_of
    from model.commands.options import progress_bar
    from model.files.output_paths import check_picture_name
    from model.finger import scale_in_words
    from model.table.table_file import load_table

    if picture is not None:
        check_picture_name(picture)
    table = load_table(table_file)
    layout = load_layout(layout_file, table.plate).for_table(table.frequencies)
    started = time.perf_counter()
    with progress_bar("effects") as progress:
        checked = check_layout(layout, table, progress=progress)
    with progress_bar("pairs and triples") as progress:
        together = check_together(layout, table, progress=progress)
    elapsed = time.perf_counter() - started
    files = []
    if picture is not None:
        from era_haptics.lab.checks.layout_picture import check_figure
        from model.figures.style import save_figure

        save_figure(check_figure(layout, table, checked, together), picture)
        files = [str(picture)]
    problems = sum(len(each.problems) for each in checked)
    touches = sum(len(each.touches) for each in checked)
    outcome = counted(problems, "problem") if problems else "good"
    rows = [
        scale_in_words(table.threshold),
        *(line for each in checked for line in _lines(each)),
        *(_matrix(*matrix_of(together)) if together else ()),
        f"{layout_file}: {outcome}{close_pairs(together)}; "
        f"{counted(touches, 'touch', plural='touches')} in {elapsed:.1f} s",
        *(f"wrote {name}" for name in files),
    ]
    answer = {
        "regions": [each.as_json() for each in checked],
        "promised_together": [each.as_json() for each in together],
        "files": files,
        "check_time_s": elapsed,
    }
    print_report(rows, answer, as_json=as_json)
    if problems:
        raise typer.Exit(FAILED)


_SHOWN_FROM = 0.05  # dB


def _lines(each: "CheckedEffect") -> list[str]:
    """Format one effect of a region."""
    from controller.effects.effect import DEFAULT_MAX_DB_SL

    promised = (
        "as neighbors allow" if each.promised_db_sl is None else f"{each.promised_db_sl:.3g} dB SL"
    )
    lines = [f"{each.region}, {each.on}: {each.effect}, {promised}"]
    if each.felt:
        low, high = each.frequencies[0], each.frequencies[-1]
        tones = f"{low:g} Hz" if low == high else f"{low:g} to {high:g} Hz"
        lines.append(f"  felt {_span(each.felt)} dB SL at {tones}")
    if each.contrasts:
        lines.append(
            f"  {_span(each.promised_contrasts)} dB above the level at a resting second finger, on "
            "90 % of plates"
        )
        lines.append(f"  {_span(each.contrasts)} dB nominal")
    if each.held_back_db > _SHOWN_FROM:
        held = f"  up to {each.held_back_db:.1f} dB weaker"
        lines.append(f"{held} so that the resting finger feels at most half of it")
    if each.promised_db_sl is not None and each.promised_db_sl > DEFAULT_MAX_DB_SL:
        lines.append(f"  exposure up to {each.exposure_m_s2:.2g} m/s², weighted per ISO 5349-1")
    return [*lines, *(f"  PROBLEM {problem}" for problem in each.problems)]


def _matrix(names: "Sequence[str]", promised: "FloatArray") -> list[str]:
    """Format the promised contrasts of all pairs and triples of regions."""
    from model.answer.answer import MIN_CONTRAST_DB, OWN_CONTRAST_DB

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
    from era_haptics.lab.checks.layout_check import distribution

    found = distribution(values)
    return f"{found['min']:.1f} to {found['max']:.1f} (median {found['median']:.1f})"
