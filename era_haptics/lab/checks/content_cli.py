"""`era content check` and `era play`: content on a simulated plate, or at a finger of a daemon."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from controller.cli.daemon_cli import Socket, connected
from model.commands.options import JsonOption, QuietOption, print_report
from model.config.units import parse_point
from model.errors import InputError
from model.quantities import counted, percent

if TYPE_CHECKING:
    from collections.abc import Sequence

    from controller.content.pattern import Pattern
    from era_haptics.lab.checks.content_check import CheckedContent, Part

_RATE = 48000  # Hz; with 16 bits what all players of sound take
_FULL = 1 << 15  # of samples of 16 bits
_PEAK = 0.9  # of full scale


def play(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="A file of content, or the name of an effect or a content."
        ),
    ],
    at: Annotated[str, typer.Option(metavar="X,Y", help="Position of the finger in metres.")],
    level: Annotated[
        float | None,
        typer.Option(metavar="DB_SL", help="Level of intensity 1, dB SL; default: 20, or its own."),
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Begin anew at the end.")] = False,
    channel: Annotated[
        int | None, typer.Option(metavar="N", help="Channel of a file that has several.", min=1)
    ] = None,
    simulate: Annotated[
        Path | None,
        typer.Option(metavar="TABLE", help="Table file of a plate that is simulated instead."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="WAV", help="With --simulate: what is felt."),
    ] = None,
    socket: Socket = None,
    as_json: JsonOption = False,
) -> None:
    """Play content once at a finger that is on the plate, within 20 mm of a position.

    With --simulate write the acceleration at a finger that is alone there as sound, to listen to
    and to look at: 16 bits at 48 kHz, scaled so that its loudest moment is 90 % of full scale.
    """
    place = parse_point(at, what="--at")
    if (simulate is None) != (output is None):
        raise InputError("--simulate TABLE and -o WAV must be given together, or neither")
    if simulate is not None and output is not None:
        if loop:
            raise InputError("--loop must be left out with --simulate")
        pattern = pattern_of(file, channel)
        _simulate(file, pattern, simulate, output, place, level=level, as_json=as_json)
        return
    with connected(socket) as era:
        if file.suffix:
            from controller.content.pattern import points_of

            points, taps = points_of(pattern_of(file, channel))
            era.play(points, place, taps=taps, level_db_sl=level, loop=loop)
        else:
            era.play(str(file), place, level_db_sl=level, loop=loop)
    print_report(
        [f"{file} plays at ({place[0]:g}, {place[1]:g}) m", "Next: era status"],
        {"file": str(file), "at_m": [*place]},
        as_json=as_json,
    )


def pattern_of(file: Path, channel: int | None = None) -> "Pattern":
    """Read a file of content, or the one that a name without an ending stands for."""
    from controller.content.formats import named_content, read_content

    return read_content(file if file.suffix else named_content(str(file)), channel)


def _simulate(
    file: Path,
    pattern: "Pattern",
    table_file: Path,
    output: Path,
    place: tuple[float, float],
    *,
    level: float | None,
    as_json: bool,
) -> None:
    """Write what a finger feels as a WAV file."""
    import numpy as np
    from scipy.io import wavfile
    from scipy.signal import resample

    from era_haptics.lab.checks.content_check import play_content
    from model.files.output_paths import begins_with, check_ending, check_place, check_replaceable
    from model.finger import STRONG_DB_SL, fingertip_weights
    from model.table.table_file import load_table

    check_ending(output, ".wav", what="a sound")
    check_place(output, example="felt.wav")
    check_replaceable(output, is_own=begins_with(output, b"RIFF"), what="WAV file")
    table = load_table(table_file)
    given = STRONG_DB_SL if level is None else level
    _, _, rate, accelerations = play_content(pattern, table, given, at=place)
    felt = accelerations @ fingertip_weights(*place, table.plate)
    sound = resample(felt, round(len(felt) * _RATE / rate))
    full_scale = float(np.abs(sound).max()) / _PEAK or 1.0
    wavfile.write(output, _RATE, np.rint(_FULL / full_scale * sound).astype(np.int16))
    print_report(
        [
            f"scaled: the loudest moment is {percent(_PEAK)} of full scale, which is "
            f"{full_scale:.3g} m/s²",
            f"wrote {output}: 16 bits, {_RATE / 1000:g} kHz",
        ],
        {
            "file": str(file),
            "at_m": [*place],
            "full_scale_m_s2": full_scale,
            "sample_rate_hz": _RATE,
            "duration_s": len(sound) / _RATE,
            "files": [str(output)],
        },
        as_json=as_json,
    )


content_app = typer.Typer(no_args_is_help=True, help="Check content: AHAP, .haptic, HJIF, WAV.")

FAILED = 1


@content_app.command()
def check(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="A file of content, or the name of one that is known."),
    ],
    table_file: Annotated[
        Path, typer.Option("--table", metavar="TABLE", help="Table file, e.g. T.npz.")
    ],
    at: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y", help="Position of the finger in metres; default: the median of five."
        ),
    ] = None,
    quiet: QuietOption = None,
    level: Annotated[
        float, typer.Option(metavar="DB_SL", help="Level of intensity 1, dB SL.")
    ] = 20.0,
    channel: Annotated[
        int | None, typer.Option(metavar="N", help="Channel of a file that has several.", min=1)
    ] = None,
    least: Annotated[
        float, typer.Option(metavar="SHARE", help="Least share that must be kept.", min=0, max=1)
    ] = 0.8,
    picture: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="PICTURE", help="Picture to write, e.g. P.png."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Simulate in time what of a file a finger will feel, alone or beside quiet ones.

    The kept share is that of the time in which the level at the skin is within 3 dB of what the
    file asks, where that is within 20 dB of its highest: 1 says that all rises, taps and pauses are
    felt as they were made. Levels are means over 20 ms; taps that are left out are lost, lost
    sharpness is only mentioned. Amplifiers are taken as phased, whichever mode the table was built
    for. Exit status 1 if less than --least is kept. Without --at five
    places are tried, the middle among them, and the one that keeps the third most is shown.
    """
    from era_haptics.lab.checks.content_check import check_content, least_promise
    from model.answer.answer import MIN_CONTRAST_DB
    from model.commands.options import Stopwatch
    from model.files.output_paths import check_picture
    from model.table.table_file import load_table

    if picture is not None:
        check_picture(picture)
    table = load_table(table_file)
    others = [parse_point(each, what="--quiet") for each in quiet or []]
    places = [(u * table.plate.length, v * table.plate.width) for u, v in _TRIED]
    places = [each for each in places if all(math.dist(each, other) > _BESIDE for other in others)]
    if at is not None or not places:
        places = [parse_point(at or "", what="--at")]
    pattern = pattern_of(file, channel)
    if not (any(each for _, each in pattern.intensity) or pattern.transients):
        raise InputError(f"{file}: is silent; there is nothing to check")
    with Stopwatch() as watch:
        tried = [
            (place, check_content(pattern, table, level, at=place, quiet=others))
            for place in places
        ]
    tried.sort(key=lambda each: each[1].kept_share)
    place, checked = tried[len(tried) // 2]
    files = []
    if picture is not None:
        from era_haptics.lab.checks.content_check import content_figure
        from model.figures import save_figure

        save_figure(content_figure(pattern, checked), picture)
        files = [str(picture)]
    is_kept, verdict = checked.kept_share >= least, "good"
    promised = least_promise(checked.parts)
    if not is_kept:
        verdict = f"lost too much, at least {percent(least)} must be; {_REMEDY}"
    elif promised is not None and promised < MIN_CONTRAST_DB:
        verdict = (
            f"good, but other fingers feel much of it: {promised:.1f} dB promised above them, "
            f"{MIN_CONTRAST_DB:g} dB or more are felt apart"
        )
    rows = [
        *_lines(checked),
        *_along(tried, least),
        f"{file}: {percent(checked.kept_share)} kept, {verdict}; "
        f"{pattern.duration:.2f} s of content in {watch.elapsed:.1f} s",
        *(f"wrote {name}" for name in files),
    ]
    answer = checked.as_json() | {
        "at_m": [*place],
        "quiet_m": [[*each] for each in others],
        "least_share": least,
        "files": files,
        "check_time_s": watch.elapsed,
    }
    print_report(rows, answer, as_json=as_json)
    if not is_kept:
        raise typer.Exit(FAILED)


_ROWS = 12
_TRIED = (0.5, 0.5), (0.2, 0.3), (0.35, 0.75), (0.65, 0.2), (0.8, 0.6)
"""Shares of the plate's sides: the middle, often on a nodal line, and four that no symmetry of a
plate relates."""
_BESIDE = 0.04  # m; from a quiet finger to a place that is tried
_REMEDY = "try --at another place, another sharpness, slower rises or a lower --level"


def _along(
    tried: "Sequence[tuple[tuple[float, float], CheckedContent]]", least: float
) -> Iterator[str]:
    """Format how much is kept along several places, and which of them is shown."""
    if len(tried) > 1:
        worst, (shown, _), best = tried[0], tried[len(tried) // 2], tried[-1]
        enough = sum(each.kept_share >= least for _, each in tried)
        yield (
            f"of {len(tried)} places {enough} keep at least {percent(least)}: "
            + ", ".join(
                f"{percent(each.kept_share)} at {x:.3f},{y:.3f}" for (x, y), each in (worst, best)
            )
            + f"; above is {shown[0]:.3f},{shown[1]:.3f}"
        )


def _lines(checked: "CheckedContent") -> Iterator[str]:
    """Format levels over time, what plays at which frequency and promise, and what is lost."""
    import numpy as np

    yield "     time [s]   wanted   felt [dB SL]"
    late = round(checked.delay / checked.step)
    count = round(checked.duration / checked.step)
    for some in np.array_split(np.arange(count), min(_ROWS, count)):
        expected, felt = checked.expected[some].max(), checked.given[some + late].max()
        since, until = checked.step * some[0], checked.step * (some[-1] + 1)
        yield f"{since:6.2f} {until:6.2f} {_level(expected)} {_level(felt)}"
    yield f"felt {1000 * checked.delay:.0f} ms later"
    lasting = [each for each in checked.parts if each.stimulus.course is not None]
    taps = [each for each in checked.parts if each.stimulus.course is None]
    for what, parts in (("what lasts", lasting), (counted(len(taps), "tap"), taps)):
        if parts:
            yield f"{what}: {_played(parts)}"
    for each in checked.lost:
        yield f"lost: {each}"


def _level(db_sl: float) -> str:
    """Format a level that is felt at all."""
    return f"{db_sl:8.1f}" if db_sl > -10 else f"{'-':>8}"


def _played(parts: "Sequence[Part]") -> str:
    """Format frequencies, levels, and the least promise."""
    from era_haptics.lab.checks.content_check import least_promise

    tones = [each.frequency for each in parts if each.frequency is not None]
    levels = [each.answer.fingers[0].level_db_sl for each in parts]
    promised = least_promise(parts)
    beside = "" if promised is None else f", promised {promised:.1f} dB above quiet fingers"
    return f"{_span(tones)} Hz, up to {max(levels):.1f} dB SL{beside}"


def _span(values: "Sequence[float]") -> str:
    """Format one value or the lowest and highest."""
    low, high = f"{min(values):g}", f"{max(values):g}"
    return low if low == high else f"{low} to {high}"
