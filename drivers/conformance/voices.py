"""Checks of voices: no set is refused for a fade, and the oldest fades give way."""

import asyncio
from dataclasses import replace

from drivers.conformance.check import driving
from drivers.conformance.expected import Curve, cosine, steady, together
from drivers.conformance.findings import Late
from drivers.conformance.subject import Subject, layer
from drivers.protocol.sets import Command

_MAX_VOICES = 24  # voices that are tried
_SHORTENED = 0.002  # s
_PAUSE = 0.004  # s; between sets


@driving("protocol.md#what-a-channel-plays")
async def voices(subject: Subject) -> None:
    """It refuses no set for its fades: with a voice too many the oldest fade ends within 2 ms."""
    await subject.arm()
    count, ramp = subject.can["voices"], subject.can["ramp_max"]
    time = ramp / 1000
    # Each tone is at its level at once, and falls along the ramp of the next set.
    onset = subject.envelope(0.0001)
    sets = min(count, _MAX_VOICES) + 4
    share = 1 / sets
    commits: list[float] = []
    started = None
    for number in range(sets):
        tone = replace(_tone(subject, number, share), onset=onset)
        started = await subject.play(layer(0, tone, ramp=ramp))
        commits.append((started.earliest + started.latest) / 2)
        await asyncio.sleep(_PAUSE + onset.step / 10_000)
    assert started is not None  # noqa: S101
    if commits[-1] - commits[0] > 0.8 * time:
        raise Late("sets were too far apart for so many voices")
    await asyncio.sleep(2 * _SHORTENED + _slew_time(subject, share))
    curves: list[Curve] = [
        _from(cosine(time, share, 0), commits[-1] - after) for after in commits[1:]
    ]
    curves.append(steady(share))
    lasting = curves[max(sets - count, 0) :]
    status = await subject.status()
    subject.expect_at(status, {0: together(*lasting)}, started, f"the newest of {sets} voices")
    # A full pool refuses neither another layer nor a layer's silence, nor a fade of all.
    for number in subject.layers[1:3]:
        await subject.play(layer(number, _tone(subject, number, share), ramp=ramp))
    await subject.play(*(layer(number, ramp=ramp) for number in subject.layers[:3]))
    await subject.play(layer(0, subject.tone()))
    await asyncio.sleep(time + 0.01)
    await subject.expect_levels(1.0, why="after all fades")


@driving("protocol.md#what-a-channel-plays")
async def voices_of_layers(subject: Subject) -> None:
    """It cuts fades only: what lasts on all layers plays on while others fade."""
    await subject.arm()
    ramp, share = subject.can["ramp_max"], 1 / (2 * len(subject.layers))
    others = subject.layers[1:]
    await subject.play(*(layer(number, _tone(subject, number, share)) for number in others))
    for number in range(min(subject.can["voices"], _MAX_VOICES) + 2):
        tone = _tone(subject, number + len(others) + 1, share / 4)
        started = await subject.play(layer(0, tone, ramp=ramp))
    await subject.play(layer(0, ramp=0))
    await subject.pause_until(started.latest + ramp / 1000 + 0.02)
    await subject.expect_levels(share * len(others), why="layers that last, after many fades")


def _tone(subject: Subject, number: int, share: float) -> Command:
    room = max(subject.highest - subject.frequency, 0)
    return subject.tone(0, share, frequency=subject.frequency + min(10 * number, room))


def _slew_time(subject: Subject, share: float) -> float:
    """Return how long a fade takes by the slew limit [s]."""
    return float(subject.level * share * 16 / subject.can["slew"])


def _from(curve: Curve, delay: float) -> Curve:
    """Return a curve of which a time [s] has passed."""
    return lambda time: curve(time + delay)
