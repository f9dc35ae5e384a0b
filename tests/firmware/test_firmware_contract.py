"""The firmware beside the simulated amplifier, under conformance, and with the host on lines."""

import cmath
import math
import random
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from drivers.protocol.definition import BY_NUMBER, READINGS, ahead
from firmware_machine import LINES, RATE, FirmwareEnd, MovedFirmware, Pair, RandomHost, Sent
from long_form import shortly
from sim.amplifier.simulated_amplifier import Amplifier
from virtual_lines import judged

REQUESTS = 600
TOLERANCE = 3e-4  # of full level: 16-bit samples, and fixed point in up to 16 voices
ROUNDED = {"levels": 2, "watchdog_left": 1, "age": 2}
"""Where replies differ by rounding."""
CLOCK_ERROR = 1e-6  # s; that of config.h
BOARDS_OWN = {each.name for each in READINGS}
LIMITED = 4  # the flag: one is foreseen at a commit, the other seen in samples
BUILDS = {"-DSMALLEST": 4, **{f"-DCHANNELS={channels}": channels for channels in (4, 8, 16)}}
"""Options of the compiler, with the number of channels."""


def like(amplifier: Amplifier, firmware: Sent) -> Amplifier:
    """Return a simulated amplifier with the capabilities of the firmware."""
    amplifier.capabilities = firmware.values()
    amplifier.restart(0.0)
    return amplifier


def differences(made: Sent, expected: Sent) -> list[str]:
    """Names of what differs."""
    if made[:2] != expected[:2]:
        return [f"{made[:2]} for {expected[:2]}"]
    if made.number not in (30, 31, *BY_NUMBER):
        return []
    ours, theirs = made.values(), expected.values()
    ours["flags"], theirs["flags"] = (each.get("flags", 0) & ~LIMITED for each in (ours, theirs))
    for row in (*ours.get("commands", []), *theirs.get("commands", [])):
        row["phase"] *= row["level"] > 0  # of no level there is none
    return [
        f"{name}: {ours[name]} for {theirs[name]}"
        for name in ours
        if name not in BOARDS_OWN and not agree(name, ours[name], theirs[name])
    ]


def agree(name: str, ours: object, theirs: object) -> bool:
    """Whether values of a name are the same, or as good as."""
    if isinstance(ours, list) and isinstance(theirs, list):
        pairs = zip(ours, theirs, strict=True)
        return len(ours) == len(theirs) and all(agree(name, *each) for each in pairs)
    if isinstance(ours, dict) and isinstance(theirs, dict):
        return all(agree(each, ours[each], theirs[each]) for each in ours)
    if name in ("clock", *ROUNDED):
        assert isinstance(ours, int)
        assert isinstance(theirs, int)
        if name == "clock":  # its samples come out when they are due, one later
            return abs(ahead(theirs, ours) - 1 / RATE) < CLOCK_ERROR
        return abs(ours - theirs) <= ROUNDED[name]
    return ours == theirs


def value_at(amplifier: Amplifier, channel: int, time: float) -> float:
    """What it plays at a time [s]: Im[A(t) exp(2 pi i f clock(t))], limited."""
    total, seconds = 0.0, amplifier.clock.seconds(time)
    for voice in amplifier.playback.all_voices[channel]:
        turned = cmath.exp(2j * math.pi * voice.frequency * seconds)
        total += (voice.transition.at(time) * turned).imag
    return min(max(total, -1.0), 1.0)


@pytest.mark.parametrize("build", shortly(BUILDS, ["-DSMALLEST"]))
@pytest.mark.parametrize("seed", shortly(range(4), [0]))
def test_random_requests_have_the_same_replies_and_samples(
    build: str, seed: int, moved: Callable[..., Path]
) -> None:
    """Sets in parts, commits, silence, stops and nonsense, every few milliseconds.

    What differs on other wires is their frames: see conformance, and damaged frames.
    """
    draw, channels = random.Random(seed), BUILDS[build]
    firmware = MovedFirmware(moved(build), channels=channels)
    amplifier = Amplifier("a", channels=channels)
    like(amplifier, Pair(firmware, Amplifier("b", channels=channels)).ask(2, [])[0][0])
    pair = Pair(firmware, amplifier)
    host = RandomHost(draw, amplifier.capabilities)
    for _ in range(REQUESTS):
        clock = amplifier.clock.reading(pair.moment)
        for number, words in host.requests(amplifier.latch, clock):
            made, expected = pair.ask(number, words)
            assert len(made) == len(expected), (made, expected)
            for ours, theirs in zip(made, expected, strict=True):
                assert differences(ours, theirs) == [], (pair.time, number, words)
        check_samples(pair, draw, draw.choice([0, 1, 1, 2, 5, 10, 30, draw.choice([30, 400])]))


def check_samples(pair: Pair, draw: random.Random, wait: int) -> None:
    """Let a time [ms] pass, and compare some samples of every channel."""
    pair.firmware.samples()
    first, begin = round(pair.time * RATE), pair.moment - pair.time
    expected = {}
    for index in sorted(draw.sample(range(wait * RATE // 1000), min(3, wait))):
        at = (first + index) / RATE + begin
        pair.amplifier.tick(at)
        for channel in range(pair.amplifier.playback.channels):
            expected[index, channel] = value_at(pair.amplifier, channel, at)
    pair.time = round(pair.time + wait / 1000, 3)
    pair.firmware.move(pair.time)
    samples = pair.firmware.samples()
    off = {place: samples[place] - value for place, value in expected.items()}
    assert {place: each for place, each in off.items() if abs(each) > TOLERANCE} == {}, pair.time


SKIPPED = {"sensors", "steps_as_stated", "readings", "measured", "limited"}
OF_WIRE = {"rtu": {"events", "clock_rate"}, "tcp": {"events"}}
"""Skipped too: on RTU two silent intervals of 1.75 ms make exchanges too long for two."""


@pytest.mark.parametrize("kind", LINES)
def test_firmware_passes_conformance(kind: str, replaying: Path) -> None:
    """Every check of its wire; nothing is skipped but what it has not."""
    results = judged(kind, far=partial(FirmwareEnd, kind, replaying))
    failed = [f"{each.check.name}: {each.reason}" for each in results if each.result == "failed"]
    assert not failed, failed
    skipped = {each.check.name for each in results if each.result == "skipped"}
    assert skipped == SKIPPED | OF_WIRE.get(kind, set())
