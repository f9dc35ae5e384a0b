"""`era outputs`: ask a person or an accelerometer, report the channels, and write them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer

from model.commands.calibrate_cli import check_rig_output
from model.commands.options import next_line
from model.config.document import edited_text, read_document
from model.files.array_file import whole_or_nothing
from model.rig.rig_file import load_rig
from registry.plugins import did_you_mean
from sim.desk.measuring.desk import Desk
from sim.desk.measuring.outputs import Heard, listen, tone
from sim.desk.measuring.sound_card import SoundCard, open_card

_NONE, _AGAIN = "-", "r"


def find_outputs(
    rig_file: Path,
    device: str,
    *,
    beside: int | None,
    output: Path | None,
    count: int | None,
    level: float,
    frequency: float | None,
) -> tuple[list[str], dict[str, Any], bool]:
    """Find which of so many outputs drives which actuator; return the report, and if all is right.

    beside: input of an accelerometer, None to ask on the terminal; output: rig to write; frequency
    [Hz]: of the tone that is felt. Raises InputError, LinkError.
    """
    if output is not None:
        check_rig_output(output, rig_file)
    desk = Desk(load_rig(rig_file), ())
    desk.check(level)
    count = count or desk.output - 1
    with closing(open_card(device, outputs=count, inputs=beside or 0, limit=level)) as card:
        if beside is None:
            heard = _asked(desk, card, count, level=level, frequency=frequency)
        else:
            heard = listen(desk, card, beside, outputs=count, level=level, move=_moved)
    own = {name: at - 1 for name, at in desk.eras}
    channels = {each.era: each.output - 1 for each in heard if each.era}
    missing = [name for name in own if name not in channels]
    is_right = channels == own
    files = []
    rows = [*_rows(heard, own, channels, missing)]
    if output is not None and not missing:
        _write(rig_file, output, channels)
        files = [str(output)]
        rows.append(f"wrote {output}")
    elif not (missing or is_right):
        again = ["--beside", str(beside)] if beside is not None else []
        wired = rig_file.with_stem("wired")
        rows.append(next_line("era", "outputs", rig_file, "--device", device, "-o", wired, *again))
    answer = {
        "outputs": [asdict(each) for each in heard],
        "channels": channels,
        "missing": missing,
        "is_as_in_rig": is_right,
        "files": files,
    }
    are_well = all(each.verdict == "ok" for each in heard if each.era)
    return rows, answer, are_well and not missing and (is_right or bool(files))


def _moved(name: str) -> None:
    typer.prompt(
        f"Put the accelerometer beside {name}, and press Enter", "", show_default=False, err=True
    )


def _asked(
    desk: Desk, card: SoundCard, count: int, *, level: float, frequency: float | None
) -> list[Heard]:
    """What each output drives, as is said on the terminal."""
    names, found = {name.lower(): name for name, _ in desk.eras}, list[Heard]()
    for number in range(1, count + 1):
        played = tone(desk, number, outputs=count, rate=card.rate, level=level, frequency=frequency)
        left = ", ".join(names.values())
        question = f"Output {number} of {count}: which moved? {left}; {_NONE} none, {_AGAIN} again"
        said = _AGAIN
        while said == _AGAIN:
            card.run(played)
            while (said := typer.prompt(question, err=True).strip().lower()) not in {
                *names, _NONE, _AGAIN
            }:  # fmt: skip
                typer.echo(f"{said!r} is none of {left}; {did_you_mean(said, names)}", err=True)
        era = names.pop(said, None)
        found.append(Heard(number, era, verdict="ok" if era else "moves nothing"))
    return found


def _write(rig_file: Path, output: Path, channels: Mapping[str, int]) -> None:
    """Write the rig with these channels."""

    def change(data: Any) -> None:
        for name, channel in channels.items():
            data["eras"][name]["channel"] = channel

    text = edited_text(read_document(rig_file), change)
    with whole_or_nothing(output) as stream:
        stream.write(f"# Channels as found by `era outputs`:\n{text}".encode())


def _rows(
    heard: Sequence[Heard],
    own: Mapping[str, int],
    channels: Mapping[str, int],
    missing: Sequence[str],
) -> Iterator[str]:
    has_levels = any(each.relative_level is not None for each in heard)
    yield "output  drives      channel" + ("  polarity    level" if has_levels else "")
    for each in heard:
        channel, more, verdict = channels.get(each.era or ""), "", each.verdict
        if each.polarity and each.relative_level:
            sign = "+" if each.polarity > 0 else "-"
            more = f"  {sign:>8s}  {20 * math.log10(each.relative_level):+5.1f} dB"
        if each.era and channel != own[each.era]:
            verdict = f"the rig has channel {own[each.era]}; {verdict}"
        verdict = verdict.removesuffix("ok").removesuffix("; ")
        drives = f"{each.output:6d}  {each.era or '-':10s} {'-' if channel is None else channel:>8}"
        yield f"{drives}{more}  {verdict}".rstrip()
    if missing:
        yield f"on no output: {', '.join(missing)}; check cables and amplifier, or --outputs"
    elif channels == own:
        yield "channels are as in the rig"
    else:
        yield "eras:"
        yield from (f"  {name}: {{channel: {channel}}}" for name, channel in channels.items())
