"""`era play`: content at a finger of a running daemon, or of a simulated plate."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from controller.cli.daemon_cli import Socket, connected
from model.commands.options import JsonOption, print_report
from model.config.fields import parse_point
from model.errors import InputError
from model.quantities import percent

if TYPE_CHECKING:
    from controller.content.pattern import Pattern

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

    from controller.check.content_check import play_content
    from model.files.array_file import begins_with, check_ending, check_place, check_replaceable
    from model.finger import STRONG_DB_SL, fingertip_weights
    from model.table.table_file import load_table

    check_ending(output, ".wav", what="a sound")
    check_place(output, example="felt.wav")
    check_replaceable(output, is_own=begins_with(output, b"RIFF"), what="WAV file")
    table = load_table(table_file)
    given = STRONG_DB_SL if level is None else level
    played = play_content(pattern, table, given, at=place)
    felt = played.accelerations @ fingertip_weights(*place, table.plate)
    sound = resample(felt, round(len(felt) * _RATE / played.rate))
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
