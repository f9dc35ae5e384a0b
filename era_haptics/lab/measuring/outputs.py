"""Find which sound-card output drives which actuator by playing on one output after the other.

Either a person feels or sees a soft tone, or an accelerometer is placed next to each actuator in
turn. The latter also works for a poorly known plate: an actuator moves its own position more than
the others do, and the velocity there determines the power it gives to the plate. Responses at all
positions are compared with the rig's model, normalized per frequency. The unknown delay of the
sound card is fitted jointly for all outputs. Polarities are relative to the majority.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import typer
from scipy.optimize import linear_sum_assignment

from era_haptics.lab.measuring.recording_checks import check_levels
from era_haptics.lab.measuring.sound_card import (
    Desk,
    Multisine,
    ResponseEstimate,
    SoundCard,
    estimate,
    open_card,
    play_on_one,
    ramped,
    run_time,
)
from model.arrays import ComplexArray, FloatArray, IntArray
from model.commands.calibrate_cli import check_rig_output
from model.commands.options import next_line
from model.errors import InputError
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.rig.rig_writing import save_beside
from registry.plugins import did_you_mean

_TONE = 160.0
"""Usual frequency [Hz] of the tone: felt well, and soft in air."""

BURST, PAUSE = 0.4, 0.2
"""Time [s] of a burst, ramped over its quarters, and between two."""

_BURSTS = 3
_OCTAVES = 4.0  # highest over lowest line
_STEP = 20  # Hz; lines are one above its multiples, so that sums of two fall between lines
_PERIODS = 2
_DELAYS = np.arange(0, 0.05, 1e-4)  # s
_MOVED = 5.0  # times the noise, in the median over frequencies
_COHERENT = 0.9
_RATTLE = 0.1  # of the lines played, at even ones
_WEAK = 0.5  # of the median level
_MARGIN = 0.05  # of the mean correlation, over the next best assignment


def tone(
    desk: Desk, output: int, *, outputs: int, rate: float, level: float, frequency: float | None
) -> FloatArray:
    """Samples (n, outputs) of three short bursts on one output, counted from 1.

    frequency [Hz]: None for the usual one, or the nearest within the rig's limits. Raises
    InputError for what these do not allow.
    """
    limits, ramp = desk.rig.limits, BURST / 4
    if frequency is None:
        frequency = float(np.clip(_TONE, limits.frequency_min, limits.frequency_max))
    desk.check_frequencies(np.array([frequency]), what="--frequency")
    desk.check_times(seconds=BURST, slew=np.pi / 2 * level / ramp)
    times = np.arange(round(BURST * rate)) / rate
    sine = level * np.sin(2 * np.pi * frequency * times)[:, None]
    silence = np.zeros((round(PAUSE * rate), 1))
    burst = np.concatenate([ramped(sine, round(ramp * rate)), silence])
    return np.asarray(np.tile(burst, (_BURSTS, 1)) * np.eye(outputs)[output - 1])


@dataclass(frozen=True)
class OutputFinding:
    """Finding for one output, counted from 1; era: the ERA it drives, None for none.

    polarity (1 or -1) and relative_level (relative to the median and to the model) are None without
    an accelerometer; verdict: the problem and its remedy.
    """

    output: int
    era: str | None = None
    polarity: int | None = None
    relative_level: float | None = None
    verdict: str = "ok"


def listen_to_outputs(
    desk: Desk,
    card: SoundCard,
    beside: int,
    *,
    outputs: int,
    level: float,
    move: Callable[[str], None],
) -> list[OutputFinding]:
    """Play on each output for a few seconds at each position, and assign it to an actuator.

    beside: input, counted from 1, of the accelerometer that is placed next to each actuator; move:
    called with the name of the next actuator. Raises InputError or LinkError for a clipped or
    silent input, InputError if outputs cannot be distinguished.
    """
    limits = desk.rig.limits
    low, high = limits.frequency_min, min(limits.frequency_max, _OCTAVES * limits.frequency_min)
    lines = np.arange(1.0, high + 1e-6, _STEP)
    sines = Multisine(lines[lines >= low], 1, card.rate, level)
    desk.check_times(seconds=run_time(_PERIODS), slew=sines.slew)
    found: list[list[ResponseEstimate]] = []
    for era in desk.rig.eras:
        move(era.name)
        runs = [
            play_on_one(card, sines, output, outputs=outputs, periods=_PERIODS)
            for output in range(1, outputs + 1)
        ]
        check_levels(np.concatenate(runs), {beside: f"sensor next to {era.name}"})
        found.append([estimate(sines, [run[:, [beside - 1]]]) for run in runs])
    return _judged(desk.rig, sines.frequencies, found)


def _judged(
    rig: Rig, frequencies: FloatArray, found: Sequence[Sequence[ResponseEstimate]]
) -> list[OutputFinding]:
    """Assign outputs to actuators by the responses next to each actuator at frequencies (f,) [Hz].

    found: by actuator and output. Raises InputError if outputs cannot be distinguished.
    """
    points = np.array([[era.x, era.y] for era in rig.eras])
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=rig.limits.frequency_max)
    model = free.acceleration(rig.eras, frequencies, points, loads=rig.masses).transpose(1, 0, 2)
    values = np.array([[each.values[:, 0, 0] for each in place] for place in found])
    noise = np.array([[each.std[:, 0] for each in place] for place in found])
    moved = np.median(np.abs(values) / noise, axis=2).max(axis=0)  # (outputs,)
    audible = np.flatnonzero(moved >= _MOVED)
    if not audible.size:
        raise InputError("no output moves the plate: check amplifier, its supply and cables")
    values = values[:, audible].transpose(1, 2, 0)
    rows, eras, signs = matched(values, model, frequencies)
    levels = _size(values[rows]) / _size(model[eras])
    dead = "dead: moves nothing; check its cable and amplifier"
    heard = [OutputFinding(n + 1, relative_level=0.0, verdict=dead) for n in range(len(moved))]
    for row, era, sign, level in zip(rows, eras, signs, levels / np.median(levels), strict=True):
        n = int(audible[row])
        verdict = _verdict(found[era][n], sign=sign, level=level)
        heard[n] = OutputFinding(n + 1, rig.eras[era].name, int(sign), float(level), verdict)
    return heard


def _verdict(beside: ResponseEstimate, *, sign: int, level: float) -> str:
    """Return the verdict on an output that moves the plate."""
    if beside.even[0] > _RATTLE or np.median(beside.coherence) < _COHERENT:
        return "loose: it rattles; fasten it"
    if level < _WEAK:
        return "loose, or its gain is low: fasten it, and check the amplifier's knob"
    return "backwards: exchange its two wires" if sign < 0 else "ok"


def matched(
    values: ComplexArray, model: ComplexArray, frequencies: FloatArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Which responses (o, f, s) are which of a model's (e, f, s): numbers of both, and signs.

    Signs are relative to the majority. Raises InputError where another assignment fits nearly
    as well.
    """
    one, other = _even(values), _even(model)
    late = np.exp(2j * np.pi * np.outer(_DELAYS, frequencies))
    alike = np.einsum("tf,ofs,efs->toe", late, one, other.conj(), optimize=True).real
    best, rows, eras, moment = _assigned(np.abs(alike))
    for row, era in zip(rows, eras, strict=True):
        without = np.abs(alike)
        without[:, row, era] = 0
        if best - _assigned(without)[0] < _MARGIN * len(rows):
            raise InputError(
                "outputs must differ next to their actuators, got two assignments that fit nearly "
                "equally well; check that the accelerometer was moved each time, or omit --beside "
                "and enter which actuator moved"
            )
    signs = np.sign(alike[moment, rows, eras])
    return rows, eras, np.asarray(signs * (1 if signs.sum() >= 0 else -1), dtype=int)


def _assigned(alike: FloatArray) -> tuple[float, IntArray, IntArray, int]:
    """The best sum over a delay's assignment, its rows and columns, and the delay's number."""
    pairs = [linear_sum_assignment(each, maximize=True) for each in alike]
    sums = [each[pair].sum() for each, pair in zip(alike, pairs, strict=True)]
    best = int(np.argmax(sums))
    return float(sums[best]), *pairs[best], best


def _size(values: ComplexArray) -> FloatArray:
    """The norm of each response (n, f, s)."""
    return np.asarray(np.linalg.norm(values, axis=(1, 2)))


def _even(values: ComplexArray) -> ComplexArray:
    """Scale responses (n, f, s) so that all have one norm and all frequencies weigh the same."""
    scaled = values / np.sqrt((np.abs(values) ** 2).mean(axis=(0, 2)))[:, None]
    return np.asarray(scaled / _size(scaled)[:, None, None])


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
    """Find which output drives which actuator; return the report, and whether all are correct.

    beside: input of an accelerometer, None to ask on the terminal; output: rig file to write;
    frequency [Hz]: of the audible tone. Raises InputError, LinkError.
    """
    rig = load_rig(rig_file)
    if output is not None:
        check_rig_output(output, rig_file)
    desk = Desk(rig, ())
    desk.check(level)
    count = count or desk.output - 1
    with closing(open_card(device, outputs=count, inputs=beside or 0, limit=level)) as card:
        if beside is None:
            heard = _requested(desk, card, count, level=level, frequency=frequency)
        else:
            heard = listen_to_outputs(desk, card, beside, outputs=count, level=level, move=_moved)
    own = {name: at - 1 for name, at in desk.eras}
    channels = {each.era: each.output - 1 for each in heard if each.era}
    missing = [name for name in own if name not in channels]
    is_right = channels == own
    files = []
    rows = [*_rows(heard, own, channels, missing)]
    if output is not None and not missing:
        assert rig.document is not None  # noqa: S101  it was read from a file
        keys = {"eras": {name: {"channel": channel} for name, channel in channels.items()}}
        comment = f"{rig_file.name} with channels as found by `era outputs`:"
        save_beside(output, rig.document, keys, comment=comment)
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
        f"Put the accelerometer next to {name}, and press Enter", "", show_default=False, err=True
    )


def _requested(
    desk: Desk, card: SoundCard, count: int, *, level: float, frequency: float | None
) -> list[OutputFinding]:
    """Ask on the terminal which actuator each output drives."""
    names, found = {name.lower(): name for name, _ in desk.eras}, list[OutputFinding]()
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
                typer.echo(f"{said!r} must be one of {left}; {did_you_mean(said, names)}", err=True)
        era = names.pop(said, None)
        found.append(OutputFinding(number, era, verdict="ok" if era else "moves nothing"))
    return found


def _rows(
    heard: Sequence[OutputFinding],
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
        yield "channels match the rig"
    else:
        yield "eras:"
        yield from (f"  {name}: {{channel: {channel}}}" for name, channel in channels.items())
