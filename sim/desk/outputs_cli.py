"""`era outputs`: which output of a sound card drives which actuator of a rig."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.commands.options import JsonOption, RigArgument, next_line, print_report

if TYPE_CHECKING:
    from sim.desk.measuring.desk import Desk
    from sim.desk.measuring.outputs import Heard
    from sim.desk.measuring.sound_card import SoundCard

_LEVEL = 0.1
_WRONG = 1
_NONE, _AGAIN = "-", "r"


def outputs(
    rig_file: RigArgument,
    device: Annotated[
        str,
        typer.Option(
            metavar="DEVICE", help="Sound card: jack, jack:CLIENT, or a device of PortAudio."
        ),
    ],
    beside: Annotated[
        int | None,
        typer.Option(
            metavar="INPUT",
            help="Listen with an accelerometer on this input, put beside each actuator in turn.",
            min=1,
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="RIG2", help="Write the rig with these channels."),
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(
            "--outputs", metavar="N", help="Test the first N outputs; default: of the rig.", min=1
        ),
    ] = None,
    level: Annotated[
        float, typer.Option(help="Largest sample of each output, 1 is full scale.")
    ] = _LEVEL,
    frequency: Annotated[
        float | None,
        typer.Option(metavar="HZ", help="Tone that is felt; default: nearest to 160 Hz."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Find which output drives which actuator.

    Play a soft tone on one output after the other, and ask which actuator moved. Or listen with an
    accelerometer, whose sensitivity does not matter, which also tells what is dead, loose or wired
    backwards. Exit status 1 for those, and for channels that are not those of the rig and not
    written.
    """
    from model.commands.fitted_rig_cli import check_rig_output
    from model.rig.file import load_rig
    from sim.desk.measuring.desk import Desk
    from sim.desk.measuring.outputs import listen
    from sim.desk.measuring.sound_card import open_card

    if output is not None:
        check_rig_output(output, rig_file)
    rig = load_rig(rig_file)
    desk = Desk(rig, ())
    desk.check(level)
    count = count or desk.output - 1
    with closing(open_card(device, outputs=count, inputs=beside or 0, limit=level)) as card:
        if beside is None:
            heard = _asked(desk, card, count, level=level, frequency=frequency)
        else:
            heard = listen(desk, card, beside, outputs=count, level=level, move=_moved)
    channels = {each.era: each.output - 1 for each in heard if each.era}
    own = {name: at - 1 for name, at in desk.eras}
    missing = [name for name in own if name not in channels]
    is_written = output is not None and not missing
    if output is not None and is_written:
        _write(rig_file, output, channels)
    is_wrong = any(each.verdict for each in heard if each.era) or bool(missing)
    is_wrong = is_wrong or (channels != own and not is_written)
    again: list[str | Path] = ["era", "outputs", rig_file, "--device", device]
    again += ["-o", rig_file.with_stem("wired")]
    if beside is not None:
        again += ["--beside", str(beside)]
    rows = [
        *_rows(heard, own, channels, missing, has_levels=beside is not None),
        f"wrote {output}" if is_written else None,
        None if missing or channels == own or is_written else next_line(*again),
    ]
    answer = {
        "outputs": [
            {
                "output": each.output,
                "era": each.era or None,
                "polarity": (-1 if each.is_reversed else 1) if beside and each.era else None,
                "relative_level": each.level if beside else None,
                "verdict": each.verdict or "ok",
            }
            for each in heard
        ],
        "channels": channels,
        "missing": missing,
        "is_as_in_rig": channels == own,
        "files": [str(output)] if is_written else [],
    }
    print_report(rows, answer, as_json=as_json)
    if is_wrong:
        raise typer.Exit(_WRONG)


def _moved(name: str) -> None:
    typer.prompt(
        f"Put the accelerometer beside {name}, and press Enter", "", show_default=False, err=True
    )


def _asked(
    desk: "Desk", card: "SoundCard", count: int, *, level: float, frequency: float | None
) -> "list[Heard]":
    """What each output drives, as is said on the terminal."""
    from sim.desk.measuring.outputs import Heard, default_tone, tone

    names, found = [name for name, _ in desk.eras], list[Heard]()
    for number in range(1, count + 1):
        signal = tone(
            desk, number, outputs=count, rate=card.rate, level=level,
            frequency=frequency or default_tone(desk.rig),
        )  # fmt: skip
        taken = [each.era for each in found if each.era]
        said = _said(partial(card.run, signal), number, count, names, taken)
        found.append(Heard(number, said, verdict="" if said else "moves nothing"))
    return found


def _said(
    play: Callable[[], object],
    number: int,
    count: int,
    names: Sequence[str],
    taken: Sequence[str],
) -> str:
    """The actuator that has moved, as the person says; "" for none."""
    from registry.suggestions import did_you_mean

    left = [name for name in names if name not in taken]
    by_lower = {name.lower(): name for name in left} | {_NONE: "", _AGAIN: _AGAIN}
    said = _AGAIN
    while said == _AGAIN:
        play()
        said = ""
        question = (
            f"Output {number} of {count}: which moved? {', '.join(left)}; {_NONE} none, "
            f"{_AGAIN} again"
        )
        while (text := typer.prompt(question, err=True).strip().lower()) not in by_lower:
            typer.echo(f"{text!r} is none of them; {did_you_mean(text, left)}".strip(), err=True)
        said = by_lower[text]
    return said


def _write(rig_file: Path, output: Path, channels: Mapping[str, int]) -> None:
    """Write the rig with these channels."""
    from model.config.document import read_document
    from model.config.editing import edited_text
    from model.files.array_file import whole_or_nothing

    def change(data: object) -> None:
        for name, channel in channels.items():
            data["eras"][name]["channel"] = channel  # type: ignore[index]

    text = edited_text(read_document(rig_file), change)
    with whole_or_nothing(output) as stream:
        stream.write(f"# Channels as found by `era outputs`:\n{text}".encode())


def _rows(
    heard: "Sequence[Heard]",
    own: Mapping[str, int],
    channels: Mapping[str, int],
    missing: Sequence[str],
    *,
    has_levels: bool,
) -> Iterator[str]:
    import math

    yield "output  drives      channel" + ("  polarity    level" if has_levels else "")
    for each in heard:
        more = ""
        if has_levels and each.era:
            sign = "-" if each.is_reversed else "+"
            more = f"  {sign:>8s}  {20 * math.log10(each.level):+5.1f} dB"
        channel = str(channels[each.era]) if each.era else "-"
        verdict = each.verdict
        if each.era and channels[each.era] != own[each.era]:
            verdict = f"the rig has channel {own[each.era]}" + (f"; {verdict}" * bool(verdict))
        yield f"{each.output:6d}  {each.era or '-':10s} {channel:>8s}{more}  {verdict}".rstrip()
    if missing:
        yield f"on no output: {', '.join(missing)}; check cables and amplifier, or --outputs"
    elif dict(channels) == dict(own):
        yield "channels are as in the rig"
    else:
        yield "eras:"
        yield from (f"  {name}: {{channel: {channel}}}" for name, channel in channels.items())
