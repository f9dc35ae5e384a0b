"""Onsets and endings of vibrations that the control loop sends, in virtual time.

The table's pattern drives the first channel at 0.2 of full level and 90 degrees. Its onset is a
line from silence in 21 steps of 5 ms, its ending a line to silence in 8 of them. A level has 10 000
steps, a phase 36 000.
"""

import asyncio
import cmath
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Any

import pytest

from drivers.protocol.sets import Command
from kit.chain import FINGER, OTHER, set_running
from kit.clock import in_virtual_time
from kit.set_table import SetTiming
from model.answer.answer import Layer
from model.answer.stimulus import Placement
from model.transients.base_motion import BaseEnvelope
from model.vibration import Tone
from registry import threads
from tests.controller.play.driven_loop import MOVED_FINGER, DrivenLoop, but_the_other


def envelope(tone: Tone, start: float, shares: Sequence[float]) -> BaseEnvelope:
    """Return the envelope of a tone that passes through shares of its full strength."""
    full = cmath.rect(tone.amplitude, tone.phase)
    points = [share * full for share in shares]
    return BaseEnvelope(tone.frequency, start * full, tuple(points))


class Shapes(SetTiming):
    """A timing whose envelopes are straight lines."""

    def __init__(self, largest: float = 1.0) -> None:
        super().__init__()
        self.largest = largest
        """The largest knot of an onset before the full level, as a share of it."""

    def with_envelopes(
        self, layer: Layer, placed: Placement, *, onset: bool, ending: bool
    ) -> Layer:
        """Return the layer with the lines for each ERA that plays."""
        rise = [number / 21 * self.largest for number in range(1, 21)]
        fall = [1 - number / 8 for number in range(1, 9)]
        tones = layer.excitation
        if onset:
            onsets = {era: envelope(tone, 0.0, [*rise, 1.0]) for era, tone in tones.items()}
            layer = replace(layer, onset=onsets)
        if ending:
            endings = {era: envelope(tone, 1.0, fall) for era, tone in tones.items()}
            layer = replace(layer, ending=endings)
        return layer


@asynccontextmanager
async def shaped_loop(
    *amplifiers: str, largest: float = 1.0, knots: int = 32, **options: Any
) -> AsyncIterator[DrivenLoop]:
    """A loop with these envelopes, on amplifiers that play so many knots."""
    timing = Shapes(largest)
    chain = set_running(*amplifiers, of=DrivenLoop, timing=timing, knots=knots, **options)
    async with chain as loop:
        yield loop


def onset_knots(commands: Sequence[Command]) -> list[int]:
    """How many knots the onset of each command has."""
    return [len(command.onset.knots) if command.onset else 0 for command in commands]


def ending_knots(commands: Sequence[Command]) -> list[int]:
    """How many knots the ending of each command has."""
    return [len(command.ending.knots) if command.ending else 0 for command in commands]


def has_onset(loop: DrivenLoop) -> list[bool]:
    """Whether each report of active layers states an onset."""
    return [bool(report.layer.onset) for report in loop.applied]


@in_virtual_time
async def test_touch_starts_along_its_onset() -> None:
    """No touch waits for an ending, and the last knot is the level of the command.

    It starts with its last byte: of 60 words and 12 bytes, of ten bits each at 921 600 baud.
    """
    async with shaped_loop() as loop:
        began = threads.now()
        await loop.leave(0.0525, FINGER, OTHER)

        assert loop.far_end.levels[0] == pytest.approx(0.1, abs=1e-4)
        (vibration,) = loop.vibrations
        assert [command.level for command in vibration.layer.commands] == [2000, 0, 0]
        command = vibration.layer.commands[0]
        assert command.onset is not None
        assert command.onset.step == 50
        by_hand = [(round(2000 * number / 21), 9000) for number in range(1, 21)]
        assert [*command.onset.knots] == by_hand
        assert ending_knots([command]) == [0]
        assert has_onset(loop) == [True]
        assert loop.applied[0].time - began == pytest.approx(0.001432, abs=1e-6)


@in_virtual_time
async def test_ending_follows_and_changes_no_active_level() -> None:
    """It is sent within 10 ms after the onset; by hand, eight steps down, the last is silence."""
    async with shaped_loop() as loop:
        began = threads.now()
        await loop.leave(0.107, FINGER, OTHER)
        loop.put(FINGER, OTHER)
        looks = await loop.look(0.012)

        assert [level for _, level in looks] == pytest.approx([0.2] * len(looks), abs=1e-4)
        assert onset_knots(loop.first_commands) == [20, 0]
        command = loop.first_commands[1]
        assert command.keep_phase
        assert command.ending is not None
        assert command.ending.step == 50
        ending_levels = [level for level, _ in command.ending.knots]
        assert ending_levels == [1750, 1500, 1250, 1000, 750, 500, 250]
        levels = [command.level for command in loop.vibrations[1].layer.commands]
        assert levels == [2000, 0, 0]
        assert loop.vibrations[1].time - began == pytest.approx(0.111, abs=0.006)


@in_virtual_time
async def test_lifted_target_fades_along_its_ending_while_another_finger_stays() -> None:
    """Half of the ending takes 20 ms; the finger that stays feels nothing."""
    async with shaped_loop(intent_source=but_the_other()) as loop:
        await loop.hold(0.3, down=[OTHER, FINGER])
        await loop.leave(0.020, OTHER)
        assert loop.far_end.levels[0] == pytest.approx(0.1, abs=1e-3)
        await asyncio.sleep(0.0205)
        assert not loop.is_loud
        assert "no effect plays there" in loop.silenced[-1].reason
        await loop.leave(0.001)
        assert loop.far_end.names()[-1] == "Silence"


@in_virtual_time
async def test_last_lift_skips_the_ending() -> None:
    """Zero is reached within 20 ms: endings are for fingers that stay."""
    async with shaped_loop() as loop:
        await loop.hold(0.3, down=[FINGER])
        await loop.leave(0.020)
        assert not loop.is_loud


@in_virtual_time
async def test_lift_before_the_onset_is_over_skips_the_ending() -> None:
    """An ending leads from the full level; lifted half way up, the target fades along 20 ms."""
    async with shaped_loop(intent_source=but_the_other()) as loop:
        await loop.hold(0.05, down=[OTHER, FINGER])
        loop.put(OTHER)
        looks = await loop.look(0.021)
        assert max(level for _, level in looks) <= 0.101
        assert not loop.is_loud


@in_virtual_time
async def test_continued_tone_has_no_onset() -> None:
    """A finger that slides feels the same frequency without a gap, and an ending again."""
    async with shaped_loop() as loop:
        await loop.hold(0.2, down=[FINGER, OTHER])
        await loop.hold(0.2, down=[MOVED_FINGER, OTHER])
        assert onset_knots(loop.first_commands) == [20, 0, 0, 0]
        assert ending_knots(loop.first_commands) == [0, 7, 0, 7]
        continued = [command.keep_phase for command in loop.first_commands]
        assert continued == [False, True, True, True]
        assert has_onset(loop) == [True, False]


@in_virtual_time
async def test_ending_gives_way_to_a_touch() -> None:
    """It is staged on two amplifiers when the finger slides; that set is the next to play.

    The set of the slide has its ending afterwards.
    """
    async with shaped_loop("main", "side") as loop:
        loop.delay_replies(0.002)
        await loop.leave(0.105, FINGER, OTHER)
        await loop.delay_replies_from("Set", 0.002).wait()
        await loop.leave(0.1, MOVED_FINGER, OTHER)
        assert ending_knots(loop.first_commands) == [0, 0, 7]
        assert loop.refused == []


@in_virtual_time
async def test_ramps_replace_envelopes_when_amplifiers_cannot_play_them() -> None:
    """No envelope is sent; the ramp is reported."""
    async with shaped_loop(knots=0) as loop:
        await loop.hold(0.3, down=[FINGER, OTHER])
        assert onset_knots(loop.first_commands) == [0]
        assert [vibration.layer.ramp for vibration in loop.vibrations] == [15]
        assert has_onset(loop) == [False]


@in_virtual_time
async def test_ramp_replaces_an_onset_that_the_ledger_refuses() -> None:
    """A knot beyond full stroke is not sent, and the pattern is played."""
    async with shaped_loop(largest=6.0) as loop:
        await loop.hold(0.05, down=[FINGER, OTHER])
        assert onset_knots(loop.first_commands) == [0]
        assert loop.far_end.levels[0] > 0
        assert has_onset(loop) == [False]
        assert loop.refused == []
