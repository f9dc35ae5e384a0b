"""Clicks, crossfades and modulated contents of fingers on a layout, over the wire."""

import pytest

from kit.clock import in_virtual_time
from tests.controller.play.fingers_on_layouts import (
    ABOVE,
    LEFT,
    RIGHT,
    Hands,
    hands,
    lasting_contents,
    sensations,
)

TWO_FINGERS = {1: LEFT, 2: RIGHT}
FIRST_LANDED = (0.2133, 0.0366)
SECOND_LANDED = (0.1206, 0.1132)
"""Two fingers that land here 0.35 s apart are promised 8.9 dB, because the frequency of the first
is kept, and 19.5 dB where they land together. Both are led to other frequencies one after the
other, each along 300 ms."""


async def land(fingers: Hands, *, resting: float) -> None:
    """Let two fingers land apart, and the second rest for a time [s]."""
    fingers.at[1] = FIRST_LANDED
    await fingers.hold(0.35)
    fingers.at[2] = SECOND_LANDED
    await fingers.hold(resting)


@in_virtual_time
async def test_content_that_ends_with_a_click_ends_along_100_ms() -> None:
    """A finger slides out of its region amid the onset: its click starts as its buzz ends."""
    layout = "click when it leaves the left"
    async with hands({1: (0.148, 0.08)}, layout=layout, held=0.03) as fingers:
        fingers.mark()
        fingers.at[1] = (0.1515, 0.08)
        await fingers.hold(0.02)
        assert fingers.driven == {0: False, 1: True}
        assert fingers.ramps == {0: 100, 1: 10}


@in_virtual_time
async def test_click_precedes_continuous_contents_of_other_fingers() -> None:
    """An answer to these is being computed for 70 ms; the click is sent as that arrives.

    Its latency counts from its touch, 20 ms after the change that the answer is for.
    """
    async with hands(TWO_FINGERS, layout="click above", held=0.5) as fingers:
        fingers.slow_answers(0.07)
        fingers.mark()
        fingers.at[1] = (0.146, 0.081)
        await fingers.hold(0.02)
        fingers.at[3] = ABOVE
        await fingers.hold(0.3)
        assert 0.07 <= fingers.times_of(2)[0] <= 0.075
        assert 0.047 <= (fingers.latencies[0] or 0.0) <= 0.058


@in_virtual_time
async def test_click_plays_for_its_whole_duration_though_its_answer_takes_longer() -> None:
    """The answer for the click and two fingers takes 60 ms, the click 40."""
    async with hands(TWO_FINGERS, layout="click above", held=0.5) as fingers:
        fingers.slow_answers(0.06)
        fingers.mark()
        fingers.at[3] = ABOVE
        await fingers.hold(0.3)
        start, end = fingers.times_of(2)[:2]
        assert 0.06 <= start <= 0.066
        assert 0.1 <= end <= 0.116
        assert fingers.driven == {0: True, 1: True, 2: False}


@in_virtual_time
async def test_click_that_cannot_be_played_is_reported_though_no_layer_changes() -> None:
    """A resting finger slides 4 mm into the region of a click, which the table refuses."""
    positions = {1: LEFT, 2: (0.158, 0.049)}
    async with hands(positions, layout="click on the right", held=0.5) as fingers:
        fingers.mark()
        fingers.refuse_answers("nothing is felt there")
        fingers.at[2] = (0.162, 0.049)
        await fingers.hold(0.02)
        assert fingers.new_commits == []
        assert fingers.status("held_back") == {1: None, 2: "nothing is felt there"}


@in_virtual_time
async def test_click_is_6_db_above_the_buzz_of_its_finger_and_30_hz_from_all() -> None:
    """As modeled, in two sets of its own layer; continuous contents are not touched."""
    async with hands(TWO_FINGERS, held=0.6) as fingers:
        former = fingers.applied[-1]
        fingers.mark()
        fingers.play("click", 1)
        await fingers.hold(0.02)
        buzz = sensations(former)[1].sensation.level_db_sl
        click = sensations(fingers.applied[-1])[1].sensation.level_db_sl
        assert click - buzz == pytest.approx(6.0, abs=0.1)
        assert fingers.spacing >= 30
        assert fingers.played_effects == ["low", "high", "click"]

        await fingers.hold(0.28)
        assert fingers.changes == [[2], [2]]
        assert lasting_contents(fingers.applied[-1]) == lasting_contents(former)


@in_virtual_time
async def test_continuous_content_has_the_stroke_that_a_loud_click_leaves_then_all() -> None:
    """It is raised amid the 40 ms of another finger's click: both need 1.2 strokes.

    It is never silent, nor refused by the amplifiers.
    """
    async with hands({1: LEFT}, layout="loud click on the right", held=0.6) as fingers:
        fingers.at[2] = RIGHT
        await fingers.hold(0.012)
        fingers.mark()
        fingers.play("loud", 1)
        await fingers.hold(0.138)
        first, last = fingers.new_reports[0], fingers.new_reports[-1]
        gain = sensations(last)[1].level_db_sl - sensations(first)[1].level_db_sl
        assert gain > 0.5
        assert fingers.status("held_back")[1] is None

        fingers.mark()
        await fingers.hold(0.36)
        assert fingers.new_reports == []
        assert (fingers.silenced, fingers.refused) == ([], [])
        assert fingers.levels_db_sl()[1] >= 43


@pytest.mark.parametrize(("resting", "duration"), [(0.15, 0.042), (0.25, 0.022)])
@in_virtual_time
async def test_finger_that_lifts_amid_a_crossfade_is_silent_immediately(
    resting: float, duration: float
) -> None:
    """As the new content rises, along the ending of 40 ms of the old one, which plays in full.

    As the old one falls, along a ramp of 20 ms.
    """
    async with hands(layout="one region") as fingers:
        await land(fingers, resting=resting)
        assert fingers.status("frequency_hz") == {1: 140, 2: 190}
        fingers.mark()
        del fingers.at[1]
        await fingers.hold(0.012)
        assert fingers.changes == [[0, 2]]
        assert fingers.driven == {0: False, 2: False}
        ends = [
            voice.silent_from - fingers.marked_at
            for voices in fingers.far_end.amplifier.outputs
            for voice in voices
            if voice.layer in (0, 2)
        ]
        assert max(ends) <= duration


@in_virtual_time
async def test_touch_amid_a_crossfade_is_answered_immediately() -> None:
    """The next set has all three contents; the falling tone ends with it."""
    async with hands(layout="one region") as fingers:
        await land(fingers, resting=0.25)
        fingers.mark()
        fingers.at[3] = (0.05, 0.19)
        await fingers.hold(0.06)
        assert fingers.new_commits[0].time <= 0.02
        assert fingers.driven == {0: False, 1: True, 2: True, 3: True}
        assert len(fingers.contents) == 3
        assert fingers.held_back == {1: None, 2: None, 3: None}


@in_virtual_time
async def test_click_amid_a_crossfade_is_30_hz_from_every_tone() -> None:
    """Also from the falling tone of 230 Hz, which continues in its layer.

    In the band of the click that leaves 100 and 110 Hz; without the falling tone 220 to 240 Hz too.
    """
    async with hands(layout="one region") as fingers:
        await land(fingers, resting=0.25)
        assert fingers.status("frequency_hz") == {1: 140, 2: 190}
        fingers.mark()
        fingers.play("click", 2)
        await fingers.hold(0.03)
        assert fingers.new_commits[0].time <= 0.02
        assert fingers.changes == [[3]]
        (frequency,) = fingers.click_frequencies
        assert frequency in (100.0, 110.0)


@in_virtual_time
async def test_no_crossfade_without_a_free_layer() -> None:
    """Both of two layers are active, and keep their frequencies."""
    async with hands(layout="one region") as fingers:
        fingers.controller.cycle.planner.slots.layers.count = 2
        await land(fingers, resting=0.09)
        fingers.mark()
        await fingers.hold(1.41)
        assert max(fingers.ramps.values(), default=0) < 300
        assert fingers.contrasts().keys() == {1, 2}
        assert fingers.status("frequency_hz") == {1: 230, 2: 190}


@in_virtual_time
async def test_modulated_content_beats_at_its_own_finger_and_at_no_other() -> None:
    """The whole envelope beats 20 times a second; that of the other finger hardly does."""
    async with hands(TWO_FINGERS, layout="modulated", held=1.5) as fingers:
        depths = fingers.depths()
        assert 0.8 <= depths[1] <= 1.3
        assert depths[2] < 0.35
        assert len(fingers.contents) == 4
        assert fingers.status("verdict") == {1: "own", 2: "own"}


@in_virtual_time
async def test_modulated_content_is_steady_if_layers_are_few() -> None:
    """Two contents of four layers leave one for a click; a lone one takes three.

    Its carrier is already active: the side bands join it on the amplifier's clock. After 0.31 s
    their phases would not agree by chance.
    """
    async with hands(TWO_FINGERS, layout="modulated", held=1.0, layers=4) as fingers:
        assert len(fingers.contents) == 2
        del fingers.at[2]
        await fingers.hold(0.31)
        fingers.at[1] = (0.106, 0.081)
        await fingers.hold(1.0)
        assert len(fingers.contents) == 3
        assert 0.8 <= fingers.depths()[1] <= 1.3


@in_virtual_time
async def test_click_without_a_layer_is_reported_until_one_is_free() -> None:
    """Side bands and a click of 0.15 s take all four; the next click, 60 ms later, waits."""
    layout = "modulated beside clicks"
    async with hands({1: LEFT}, layout=layout, held=0.5, layers=4) as fingers:
        fingers.at |= {2: RIGHT, 3: ABOVE}
        await fingers.hold(0.12)
        assert "4 simultaneous vibrations" in fingers.status("held_back")[3]
        await fingers.hold(0.06)
        assert fingers.held_back == {1: None, 3: None}


@in_virtual_time
async def test_refused_voice_takes_the_other_voices_of_its_finger_along() -> None:
    """A carrier without one side band would be another content: the finger feels none.

    It is tried again once, 50 ms later, when the former content has faded.
    """
    async with hands({2: RIGHT}, layout="modulated", held=0.5) as fingers:
        refusals = fingers.refuse_layers("no more", 3)
        fingers.mark()
        fingers.at[1] = LEFT
        await fingers.hold(0.5)
        assert refusals == pytest.approx([0.005, 0.005, 0.05, 0.05], abs=0.005)
        assert fingers.held_back == {1: "no more", 2: None}
