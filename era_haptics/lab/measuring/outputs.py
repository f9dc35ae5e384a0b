"""Find which sound-card output drives which actuator by playing on one output after the other.

A person feels or sees a soft tone.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import typer

from era_haptics.lab.measuring.desk import Desk
from era_haptics.lab.measuring.multisine import ramped
from era_haptics.lab.measuring.sound_card import SoundCard, open_card
from model.arrays import FloatArray
from model.commands.calibrate_cli import check_rig_output
from model.commands.options import next_line
from model.rig.rig_file import load_rig
from model.rig.rig_writing import save_beside
from registry.plugins import did_you_mean

_TONE = 160.0
"""Usual frequency [Hz] of the tone: felt well, and soft in air."""

BURST = 0.4
"""Duration of a burst [s], ramped over its first and last quarter."""

PAUSE = 0.2
"""Pause after a burst [s]."""

_BURSTS = 3
_NONE, _AGAIN = "-", "r"  # replies on the terminal


@dataclass(frozen=True)
class OutputFinding:
    """ERA that an output drives, None for none; the output is counted from 1."""

    output: int
    era: str | None
    verdict: str


def tone(
    desk: Desk, output: int, *, outputs: int, rate: float, level: float, frequency: float | None
) -> FloatArray:
    """Samples (n, outputs) of three short bursts on one output, counted from 1.

    frequency [Hz]: None for the usual one, or the nearest within the rig's limits. Raises
    InputError for what these do not allow.
    """
    limits = desk.rig.limits
    ramp = BURST / 4
    if frequency is None:
        frequency = float(np.clip(_TONE, limits.frequency_min, limits.frequency_max))
    desk.check_frequencies(np.array([frequency]), what="--frequency")
    desk.check_times(seconds=BURST, slew=np.pi / 2 * level / ramp)
    times = np.arange(round(BURST * rate)) / rate
    sine = level * np.sin(2 * np.pi * frequency * times)[:, None]
    silence = np.zeros((round(PAUSE * rate), 1))
    burst = np.concatenate([ramped(sine, round(ramp * rate)), silence])
    return np.asarray(np.tile(burst, (_BURSTS, 1)) * np.eye(outputs)[output - 1])


def find_outputs(
    rig_file: Path,
    device: str,
    *,
    output: Path | None,
    count: int | None,
    level: float,
    frequency: float | None,
) -> tuple[list[str], dict[str, Any], bool]:
    """Find which output drives which actuator; return the report, and whether all are correct.

    output: rig file to write; frequency [Hz]: of the audible tone. Raises InputError, LinkError.
    """
    rig = load_rig(rig_file)
    if output is not None:
        check_rig_output(output, rig_file)
    desk = Desk(rig, ())
    desk.check_level(level)
    count = count or max(desk.wiring.era_outputs.values())
    with closing(open_card(device, outputs=count, inputs=0, limit=level)) as card:
        findings = _requested(desk, card, count, level=level, frequency=frequency)
    rig_channels = {name: number - 1 for name, number in desk.wiring.era_outputs.items()}
    channels = {finding.era: finding.output - 1 for finding in findings if finding.era}
    missing = [name for name in rig_channels if name not in channels]
    is_as_in_rig = channels == rig_channels
    files = []
    rows = [*_rows(findings, rig_channels, channels, missing)]
    if output is not None and not missing:
        assert rig.document is not None  # noqa: S101  it was read from a file
        keys = {"eras": {name: {"channel": channel} for name, channel in channels.items()}}
        comment = f"{rig_file.name} with channels as found by `era outputs`:"
        save_beside(output, rig.document, keys, comment=comment)
        files = [str(output)]
        rows.append(f"wrote {output}")
    elif not (missing or is_as_in_rig):
        wired = rig_file.with_stem("wired")
        rows.append(next_line("era", "outputs", rig_file, "--device", device, "-o", wired))
    answer = {
        "outputs": [asdict(finding) for finding in findings],
        "channels": channels,
        "missing": missing,
        "is_as_in_rig": is_as_in_rig,
        "files": files,
    }
    is_right = not missing and (is_as_in_rig or bool(files))
    return rows, answer, is_right


def _requested(
    desk: Desk, card: SoundCard, count: int, *, level: float, frequency: float | None
) -> list[OutputFinding]:
    """Ask on the terminal which actuator each output drives."""
    names = {name.lower(): name for name in desk.wiring.era_outputs}  # not assigned yet
    findings = []
    for number in range(1, count + 1):
        played = tone(desk, number, outputs=count, rate=card.rate, level=level, frequency=frequency)
        question = (
            f"Output {number} of {count}: which moved? {', '.join(names.values())}; {_NONE} none, "
            f"{_AGAIN} again"
        )
        reply = _AGAIN
        while reply == _AGAIN:
            card.run(played)
            reply = _reply_to(question, names)
        era = names.pop(reply, None)
        findings.append(OutputFinding(number, era, verdict="ok" if era else "moves nothing"))
    return findings


def _reply_to(question: str, names: Mapping[str, str]) -> str:
    """Ask on the terminal until the reply is a name, none or again; names: by lower-case name."""
    while True:
        reply: str = typer.prompt(question, err=True).strip().lower()
        if reply in {*names, _NONE, _AGAIN}:
            return reply
        choices = ", ".join(names.values())
        typer.echo(f"{reply!r} must be one of {choices}; {did_you_mean(reply, names)}", err=True)


def _rows(
    findings: Sequence[OutputFinding],
    rig_channels: Mapping[str, int],
    channels: Mapping[str, int],
    missing: Sequence[str],
) -> Iterator[str]:
    """Yield a table of the outputs, then the channels if they differ from the rig."""
    yield "output  drives      channel"
    for finding in findings:
        yield _row(finding, rig_channels).rstrip()
    if missing:
        yield f"on no output: {', '.join(missing)}; check cables and amplifier, or --outputs"
    elif channels == rig_channels:
        yield "channels match the rig"
    else:
        yield "eras:"
        yield from (f"  {name}: {{channel: {channel}}}" for name, channel in channels.items())


def _row(finding: OutputFinding, rig_channels: Mapping[str, int]) -> str:
    """Format the finding for one output."""
    if finding.era is None:
        return f"{finding.output:6d}  {'-':10s} {'-':>8}  {finding.verdict}"
    channel = finding.output - 1
    rig_channel = rig_channels[finding.era]
    verdict = "" if channel == rig_channel else f"the rig has channel {rig_channel}"
    return f"{finding.output:6d}  {finding.era:10s} {channel:>8}  {verdict}"
