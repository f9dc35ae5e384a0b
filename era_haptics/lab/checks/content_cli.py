"""`era content check` and `era play`: content on a simulated plate, or at a finger of a daemon."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from controller.cli.daemon_cli import Socket, connected
from model.commands.options import (
    FAILED,
    JsonOption,
    QuietOption,
    Stopwatch,
    parse_point,
    print_report,
    progress_bar,
)
from model.errors import InputError
from model.quantities import counted, percent, percent_down

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from controller.content.pattern import Pattern
    from era_haptics.lab.checks.content_check import CheckedContent, Part
    from model.arrays import Point
    from model.table.table import LocalizationTable

_FilesArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="FILE...",
        help="Haptic files, folders of haptic files, or names of built-in contents.",
    ),
]
_TableOption = Annotated[
    Path | None,
    typer.Option(
        "--table", metavar="TABLE", help="Table file, e.g. T.npz; default: the paper's plate."
    ),
]
_LevelOption = Annotated[float, typer.Option(metavar="DB_SL", help="Level of intensity 1, dB SL.")]
_ChannelOption = Annotated[
    int | None,
    typer.Option(metavar="N", help="Channel of a multi-channel file; default: 1.", min=1),
]
_PictureOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="PICTURE", help="Picture to write, e.g. P.png."),
]

_RATE = 48000  # Hz; every audio player supports it with 16 bits
_MAX_SAMPLE = (1 << 15) - 1  # of 16 bits
_FULL_SCALE = 20.0  # m/s²; contents at 20 dB SL reach 3 to 5
_LEVEL_DB_SL = 20.0  # of intensity 1, unless another level is given
_MAX_COLUMNS = 8  # of a picture
_ROWS = 12  # of levels over time
_REMEDY = "try another position (--at), another sharpness, slower rises or a lower --level"


def play(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="Haptic file, or name of an effect or built-in content."
        ),
    ],
    at: Annotated[str, typer.Option(metavar="X,Y", help="Position of the finger in meters.")],
    level: Annotated[
        float | None,
        typer.Option(
            metavar="DB_SL", help="Level of intensity 1 in dB SL; default: 20, or the effect's."
        ),
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Repeat until the finger lifts.")] = False,
    channel: _ChannelOption = None,
    simulate: Annotated[
        Path | None,
        typer.Option(metavar="TABLE", help="Simulate on the plate of this table instead."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="WAV", help="WAV file to write, with --simulate."),
    ] = None,
    full_scale: Annotated[
        float,
        typer.Option(
            metavar="M_S2", help="Acceleration at full scale in m/s², with --simulate.", min=1e-3
        ),
    ] = _FULL_SCALE,
    socket: Socket = None,
    as_json: JsonOption = False,
) -> None:
    """Play content at a finger, or write it as sound.

    Plays the content once at the finger within 20 mm of --at; exits with 1 if it is late or held
    back. With --simulate, writes the simulated
    acceleration at a single finger there to a WAV file (16 bits, 48 kHz) instead, for listening or
    plotting. The full scale is fixed, so the loudness of several files can be compared by ear.
    """
    place = parse_point(at, what="--at")
    if (simulate is None) != (output is None):
        raise InputError("--simulate TABLE and -o WAV must be given together, or neither")
    if simulate is not None and output is not None:
        if loop:
            raise InputError("--loop must be left out with --simulate")
        pattern = pattern_of(file, channel)
        _simulate(
            file,
            pattern,
            simulate,
            output,
            place,
            level=level,
            full_scale=full_scale,
            as_json=as_json,
        )
        return
    with connected(socket) as era:
        if file.suffix:
            from era_haptics.lab.checks.content_points import points_of

            points, taps = points_of(pattern_of(file, channel))
            played = era.play(points, place, taps=taps, level_db_sl=level, loop=loop)
        else:
            played = era.play(str(file), place, level_db_sl=level, loop=loop)
    row = f"{file} plays at ({place[0]:g}, {place[1]:g}) m"
    if played.level_db_sl is not None:
        row += f" at {played.level_db_sl:.1f} dB SL"
    if played.reason is not None:
        row = f"{file}: {played.outcome}: {played.reason}"
    print_report(
        [row, "Next: era status"],
        {"file": str(file), "at_m": [*place], **played.model_dump(mode="json")},
        as_json=as_json,
    )
    if played.outcome in ("late", "held back"):
        raise typer.Exit(FAILED)


def pattern_of(file: Path, channel: int | None = None) -> "Pattern":
    """Read a haptic file, or a built-in content given by name without a suffix."""
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
    full_scale: float,
    as_json: bool,
) -> None:
    """Write the felt acceleration as a WAV file; raises InputError above full scale [m/s²]."""
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
    level_db_sl = STRONG_DB_SL if level is None else level
    _, _, rate, accelerations = play_content(pattern, table, level_db_sl, at=place)
    felt = accelerations @ fingertip_weights(*place, table.plate)
    sound = resample(felt, round(len(felt) * _RATE / rate))
    peak = float(np.abs(sound).max())
    if peak > full_scale:
        raise InputError(
            f"--full-scale must be at least the highest acceleration of {file}, {peak:.3g} m/s², "
            f"got {full_scale:g}; give the same value for all sounds that you compare, or lower "
            "--level"
        )
    samples = np.rint(_MAX_SAMPLE / full_scale * sound).astype(np.int16)
    wavfile.write(output, _RATE, samples)
    print_report(
        [
            f"peak: {peak:.3g} m/s², {percent(peak / full_scale)} of full scale, "
            f"{full_scale:g} m/s²",
            f"wrote {output}: 16 bits, {_RATE / 1000:g} kHz",
        ],
        {
            "file": str(file),
            "at_m": [*place],
            "full_scale_m_s2": full_scale,
            "peak_m_s2": peak,
            "sample_rate_hz": _RATE,
            "duration_s": len(sound) / _RATE,
            "files": [str(output)],
        },
        as_json=as_json,
    )


content_app = typer.Typer(no_args_is_help=True, help="Check content: AHAP, .haptic, HJIF, WAV.")


@content_app.command()
def check(
    files: _FilesArgument,
    table_file: _TableOption = None,
    at: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y",
            help="Position of the finger in meters. Default: the median of five positions.",
        ),
    ] = None,
    quiet: QuietOption = None,
    level: _LevelOption = _LEVEL_DB_SL,
    channel: _ChannelOption = None,
    least: Annotated[
        float,
        typer.Option(metavar="SHARE", help="Minimum kept fraction of the level.", min=0, max=1),
    ] = 0.8,
    picture: _PictureOption = None,
    as_json: JsonOption = False,
) -> None:
    """Simulate how haptic files feel at a finger.

    The simulation is in the time domain, for a single finger or with quiet fingers present. The
    command prints the percentage of time in which the level is kept: the level at the skin,
    averaged over 20 ms, is within 3 dB of the file's. Times at which the file is more than 20 dB
    below its peak do not count. Sharpness is kept while the frequency of the continuous part is
    close to the file's. Percentages are rounded down. Amplifiers are assumed to be phased, even if
    the table was built for switched drives.

    Without --table, the founding paper's plate is used. Without --at, five positions (including the
    center) are simulated and the median one is shown. Several files, or a folder with its
    subfolders, are listed with one line each. Exits with status 1 if the kept share of a file's
    level is below --least, or if one of several files cannot be read. Sharpness does not change the
    exit status.
    """
    from model.files.output_paths import check_picture

    contents = _content_files(files)
    is_list = len(contents) != 1 or files[0].is_dir()
    if picture is not None:
        if is_list:
            raise InputError("--output must be left out for several files, got a picture's name")
        check_picture(picture)
    setting = _setting(table_file, at, quiet or [], level=level, channel=channel, least=least)
    if is_list:
        is_kept = _check_list(contents, setting, as_json=as_json)
    else:
        is_kept = _check_one(contents[0], setting, picture, as_json=as_json)
    if not is_kept:
        raise typer.Exit(FAILED)


@content_app.command()
def compare(
    files: _FilesArgument,
    table_file: _TableOption = None,
    at: Annotated[
        str | None,
        typer.Option(metavar="X,Y", help="Position of the finger in meters; default: off center."),
    ] = None,
    level: _LevelOption = _LEVEL_DB_SL,
    picture: _PictureOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare how haptic files feel at the same position.

    Prints one line per file: duration, kept level and sharpness as in `era content check`, highest
    felt level, frequencies, and taps. The picture shows all files on the same scales, at most 8. To
    compare loudness by ear, write each file with `era play --simulate`, whose full scale is fixed.
    """
    from model.files.output_paths import check_picture

    contents = _content_files(files)
    if picture is not None:
        check_picture(picture)
        if len(contents) > _MAX_COLUMNS:
            raise InputError(
                f"--output must be left out for more than {_MAX_COLUMNS} files, got {len(contents)}"
            )
    setting = _setting(table_file, at, [], level=level, channel=None, least=0.0)
    if at is None:
        setting = replace(setting, positions=setting.positions[1:2])
    results: dict[str, tuple[Pattern, CheckedContent]] = {}
    with progress_bar("files") as progress:
        for number, file in enumerate(contents, start=1):
            pattern, (checked,) = setting.check(file)
            results[str(file)] = pattern, checked
            progress(number, len(contents))
    pictures = []
    if picture is not None:
        from era_haptics.lab.checks.content_figure import comparison_figure
        from model.figures.style import save_figure

        save_figure(comparison_figure(results), picture)
        pictures = [str(picture)]
    rows = [setting.plate_row, *_comparison_rows(results), *(f"wrote {name}" for name in pictures)]
    compared = [{"file": name, **checked.as_json()} for name, (_, checked) in results.items()]
    answer = {**setting.as_json(), "contents": compared, "files": pictures}
    print_report(rows, answer, as_json=as_json)


def _comparison_rows(
    results: "Mapping[str, tuple[Pattern, CheckedContent]]",
) -> Iterator[str]:
    """Format a table with a row per file, and the position of the finger."""
    yield "    s  level kept  sharpness kept  loudest felt  frequency     taps     file"
    for name, (pattern, checked) in results.items():
        tones = [part.frequency for part in checked.parts if part.frequency is not None]
        felt_taps = len([part for part in checked.parts if part.stimulus.course is None])
        taps = f"{felt_taps} of {max(len(pattern.transients), felt_taps)}"
        yield (
            f"{checked.duration:5.2f}  {percent_down(checked.kept_share):>10}  "
            f"{percent_down(checked.sharpness_kept):>14}  {checked.felt.max():6.1f} dB SL  "
            f"{f'{_span(tones)} Hz':12}  {taps:7}  {name}"
        )
    x, y = checked.at
    yield f"at {x:.3f},{y:.3f} m"


@dataclass(frozen=True)
class _Setting:
    """Plate, positions and levels of a check."""

    table: "LocalizationTable"
    table_file: Path | None
    """None for the built-in plate."""
    positions: "Sequence[Point]"
    """Positions of the finger [m] to try."""
    quiet: "Sequence[Point]"
    level_db_sl: float
    channel: int | None
    least_share: float

    def check(self, file: Path) -> "tuple[Pattern, list[CheckedContent]]":
        """Check a file at every position; return its pattern and the results, the worst first.

        Raises InputError for a file that cannot be read or is silent.
        """
        from era_haptics.lab.checks.content_check import check_content

        pattern = pattern_of(file, self.channel)
        has_level = any(intensity > 0 for _, intensity in pattern.intensity)
        has_tap = any(transient.intensity > 0 for transient in pattern.transients)
        if not has_level and not has_tap:
            raise InputError(f"{file}: must not be silent")
        results = [
            check_content(pattern, self.table, self.level_db_sl, at=position, quiet=self.quiet)
            for position in self.positions
        ]
        results.sort(key=lambda checked: checked.kept_share)
        return pattern, results

    def has_enough(self, checked: "CheckedContent") -> bool:
        """Return whether enough of the level is kept."""
        return checked.kept_share >= self.least_share

    @property
    def plate_row(self) -> str | None:
        """Return a line about the built-in plate; None if a table was given."""
        if self.table_file is not None:
            return None
        plate = self.table.plate
        size = f"{1000 * plate.length:.0f} x {1000 * plate.width:.0f} mm"
        return (
            f"plate: the founding paper's, {size} with {len(self.table.eras)} ERAs; "
            "give --table for another one"
        )

    def as_json(self) -> dict[str, Any]:
        """Return the JSON keys that all files share."""
        return {
            "table": None if self.table_file is None else str(self.table_file),
            "quiet_m": [[*position] for position in self.quiet],
            "least_share": self.least_share,
        }


def _setting(
    table_file: Path | None,
    at: str | None,
    quiet: "Sequence[str]",
    *,
    level: float,
    channel: int | None,
    least: float,
) -> _Setting:
    """Read the options of a check; raises InputError for invalid ones."""
    from era_haptics.lab.checks.content_check import default_positions
    from model.table.table_file import load_table

    table = _built_in_table() if table_file is None else load_table(table_file)
    quiet_positions = [parse_point(text, what="--quiet") for text in quiet]
    if at is not None:
        positions = [parse_point(at, what="--at")]
    else:
        positions = default_positions(table.plate, quiet_positions)
    if not positions:
        raise InputError("--at must be given: every default position is next to a quiet finger")
    return _Setting(
        table=table,
        table_file=table_file,
        positions=positions,
        quiet=quiet_positions,
        level_db_sl=level,
        channel=channel,
        least_share=least,
    )


def _built_in_table() -> "LocalizationTable":
    """Return the table of the founding paper's plate, cached per user."""
    from model.rig.rig_file import example_rig_path, load_rig
    from model.table.table_file import cached_table

    rig = load_rig(example_rig_path())
    table, _ = cached_table(rig)
    return table


def _content_files(paths: "Sequence[Path]") -> list[Path]:
    """Return files and names unchanged, and the haptic files in folders, sorted by name.

    Raises InputError for a folder without haptic files.
    """
    from controller.content.formats import content_formats

    endings = tuple(f".{name}" for name in content_formats())
    files: list[Path] = []
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        in_folder = []
        for file in sorted(path.rglob("*")):
            if file.name.lower().endswith(endings) and file.is_file():
                in_folder.append(file)
        if not in_folder:
            raise InputError(f"{path}: must contain haptic files ({', '.join(endings)}), got none")
        files += in_folder
    return files


def _check_one(file: Path, setting: _Setting, picture: Path | None, *, as_json: bool) -> bool:
    """Report on one file in detail; return whether enough of its level is kept."""
    from model.finger import scale_in_words

    with Stopwatch() as watch:
        pattern, results = setting.check(file)
    checked = results[len(results) // 2]
    pictures = []
    if picture is not None:
        from era_haptics.lab.checks.content_figure import content_figure
        from model.figures.style import save_figure

        save_figure(content_figure(pattern, checked), picture)
        pictures = [str(picture)]
    rows = [
        setting.plate_row,
        scale_in_words(setting.table.threshold),
        *_lines(checked),
        *_position_row(results, setting),
        f"{file}: {checked.headline}: {_verdict(checked, setting)}; "
        f"{pattern.duration:.2f} s of content in {watch.elapsed:.1f} s",
        *(f"wrote {name}" for name in pictures),
    ]
    answer = {
        **checked.as_json(),
        **setting.as_json(),
        "files": pictures,
        "check_time_s": watch.elapsed,
    }
    print_report(rows, answer, as_json=as_json)
    return setting.has_enough(checked)


def _check_list(files: "Sequence[Path]", setting: _Setting, *, as_json: bool) -> bool:
    """Print one line per file; return whether all keep enough of their level."""
    rows = [setting.plate_row, "level  sharpness  at [m]        file"]
    contents: list[dict[str, Any]] = []
    failures = 0
    with Stopwatch() as watch, progress_bar("files") as progress:
        for number, file in enumerate(files, start=1):
            try:
                _, results = setting.check(file)
            except (InputError, OSError) as error:
                failures += 1
                problem = str(error).splitlines()[0]
                rows.append(f"{'-':>5}  {'-':>9}  {'-':12}  {problem}")
                contents.append({"file": str(file), "error": problem})
            else:
                checked = results[len(results) // 2]
                failures += not setting.has_enough(checked)
                rows.append(_list_row(file, checked, setting))
                contents.append({"file": str(file), **checked.as_json()})
            progress(number, len(files))
    good = f"{len(files) - failures} of {len(files)} files"
    rows.append(f"{good} keep at least {_exact_percent(setting.least_share)} of their level")
    answer = {**setting.as_json(), "contents": contents, "check_time_s": watch.elapsed}
    print_report(rows, answer, as_json=as_json)
    return failures == 0


def _list_row(file: Path, checked: "CheckedContent", setting: _Setting) -> str:
    """Format one of several files."""
    level = percent_down(checked.kept_share)
    sharpness = percent_down(checked.sharpness_kept)
    verdict, _, _ = _verdict(checked, setting).partition(";")
    x, y = checked.at
    return f"{level:>5}  {sharpness:>9}  {f'{x:.3f},{y:.3f}':12}  {file}: {verdict}"


def _verdict(checked: "CheckedContent", setting: _Setting) -> str:
    """Return the verdict: the first loss that counts, then its details after a semicolon."""
    from era_haptics.lab.checks.content_check import least_promise
    from model.answer.answer import MIN_CONTRAST_DB

    least = _exact_percent(setting.least_share)
    if not setting.has_enough(checked):
        return f"lost too much; at least {least} of the level must be kept, {_REMEDY}"
    losses = []
    if checked.sharpness_kept < setting.least_share:
        losses.append("its sharpness is lost")
    if 1 - checked.out_of_band_share < setting.least_share:
        losses.append("part of the signal is left out")
    promised = least_promise(checked.parts)
    if promised is not None and promised < MIN_CONTRAST_DB:
        losses.append(
            f"other fingers feel the content clearly: promised {promised:.1f} dB above them, "
            f"should be at least {MIN_CONTRAST_DB:g} dB"
        )
    return f"level good, but {', '.join(losses)}" if losses else "good"


def _exact_percent(share: float) -> str:
    """Format a percentage with all its digits."""
    return f"{100 * share:.10g} %"


def _position_row(results: "Sequence[CheckedContent]", setting: _Setting) -> Iterator[str]:
    """Format the kept percentages of several positions, and the position shown."""
    if len(results) == 1:
        return
    median = results[len(results) // 2]
    good_count = sum(setting.has_enough(checked) for checked in results)
    extremes = []
    for checked in (results[0], results[-1]):
        share = percent_down(checked.kept_share)
        extremes.append(f"{share} at {checked.at[0]:.3f},{checked.at[1]:.3f}")
    yield (
        f"{good_count} of {len(results)} positions keep at least "
        f"{_exact_percent(setting.least_share)}: {', '.join(extremes)}; "
        f"above is {median.at[0]:.3f},{median.at[1]:.3f}"
    )


def _lines(checked: "CheckedContent") -> Iterator[str]:
    """Format the levels over time, frequencies and promise of each part, and losses."""
    import numpy as np

    yield "     time [s]   wanted   felt [dB SL]"
    delay = round(checked.delay / checked.step)
    count = round(checked.duration / checked.step)
    for samples in np.array_split(np.arange(count), min(_ROWS, count)):
        expected = checked.expected[samples].max()
        felt = checked.felt[samples + delay].max()
        since = checked.step * samples[0]
        until = checked.step * (samples[-1] + 1)
        yield f"{since:6.2f} {until:6.2f} {_level(expected)} {_level(felt)}"
    yield f"felt {1000 * checked.delay:.0f} ms later"
    lasting = [part for part in checked.parts if part.stimulus.course is not None]
    taps = [part for part in checked.parts if part.stimulus.course is None]
    for title, parts in (("continuous", lasting), (counted(len(taps), "tap"), taps)):
        if parts:
            yield f"{title}: {_played(parts)}"
    for remark in checked.lost:
        yield f"lost: {remark}"


def _level(db_sl: float) -> str:
    """Format a level [dB SL], `-` if it cannot be felt."""
    return f"{db_sl:8.1f}" if db_sl > -10 else f"{'-':>8}"


def _played(parts: "Sequence[Part]") -> str:
    """Format frequencies, highest level, and the lowest promised contrast."""
    from era_haptics.lab.checks.content_check import least_promise

    tones = [part.frequency for part in parts if part.frequency is not None]
    levels = [part.sensation.level_db_sl for part in parts]
    promised = least_promise(parts)
    contrast = "" if promised is None else f", promised {promised:.1f} dB above quiet fingers"
    return f"{_span(tones)} Hz, up to {max(levels):.1f} dB SL{contrast}"


def _span(values: "Sequence[float]") -> str:
    """Format a single value, or the lowest and highest."""
    low, high = f"{min(values):g}", f"{max(values):g}"
    return low if low == high else f"{low} to {high}"
