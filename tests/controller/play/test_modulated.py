"""A modulated content beside a steady one, over the wire at the fingertips."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import hilbert

from controller.effects.effect import Region
from controller.effects.kinds import Buzz, Click
from controller.effects.layout import SurfaceLayout
from controller.play.intent import Pulse, Target
from controller.play.layer_contents import Content, LayerContent
from controller.play.layers import Layers, Sets
from controller.sources.touch import Contact, ContactKey
from model.answer.answer import Layer
from model.answer.answer_report import Timing
from model.answer.stimulus import Placement
from model.config.fields import Rectangle
from model.vibration import Tone
from plates import smooth_rig
from several_fingers import ABOVE, LEFT, RIGHT, Fingers, fingers_on, playable, table
from virtual_lines import in_virtual_time

LAYOUT = SurfaceLayout(
    (
        Region("left", Rectangle(0.0, 0.0, 0.15, 0.12), on_press="rough"),
        Region("right", Rectangle(0.16, 0.0, 0.14, 0.12), on_press="smooth"),
    ),
    {"rough": Buzz(level=14.0, modulation=20.0), "smooth": Buzz(level=14.0)},
    elsewhere=None,
)


def depth_of(fingers: Fingers, id: str) -> float:
    """How deep the envelope at a finger comes and goes 20 times a second, 1 for to zero."""
    now, bench = asyncio.get_running_loop().time(), fingers.far.bench
    bench.advance(now)
    record = bench.fingers.felt(now - 0.5, now)
    envelope = np.abs(hilbert(record[id].accelerations @ record[id].weights))[200:-200]
    times = np.arange(len(envelope)) / bench.sample_rate
    part = envelope * np.hanning(len(envelope))
    return float(2 * abs((part * np.exp(-2j * np.pi * 20.0 * times)).sum()) / part.sum())


@in_virtual_time
async def test_a_modulated_content_beats_at_its_own_finger_and_at_no_other() -> None:
    """Of its envelope all comes and goes 20 times a second; that of the other hardly does."""
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT}, held=1.5) as fingers:
        applied = fingers.applied[-1]
        assert len(applied.contents) == 4
        first, second = applied.targets
        voices = [one.content for one in applied.contents.values()]
        of_first = sorted(each.frequency or 0.0 for each in voices if each.key[0].id == 1)
        assert first.frequency == of_first[1]
        assert np.diff(of_first).tolist() == [20.0, 20.0]
        assert 0.8 < depth_of(fingers, "1") < 1.3
        assert depth_of(fingers, "2") < 0.35
        assert second.verdict == "own"


@in_virtual_time
async def test_a_modulated_content_is_steady_where_layers_are_few() -> None:
    """Two contents of four layers leave one for a click; a lone one takes three."""
    async with fingers_on(table(), LAYOUT, layers=4, at={1: LEFT, 2: RIGHT}, held=1.0) as fingers:
        assert len(fingers.applied[-1].contents) == 2
        del fingers.at[2]
        await fingers.hold(0.31)  # after 0.3 s phases would agree by chance
        fingers.at[1] = (LEFT[0] - 0.02, LEFT[1])
        await fingers.hold(1.0)
        assert len(fingers.applied[-1].contents) == 3
        # Its carrier has played before: side bands join it on the amplifier's clock.
        assert 0.8 < depth_of(fingers, "1") < 1.3


@in_virtual_time
async def test_a_click_without_a_layer_is_said_until_one_is_free() -> None:
    """Side bands and a click of 0.15 s take all four: the next click, 60 ms later, waits."""
    regions = (
        LAYOUT.regions[0],
        replace(LAYOUT.regions[1], on_press="click"),
        Region("above", Rectangle(0.0, 0.13, 0.3, 0.09), on_press="click"),
    )
    effects = {**LAYOUT.effects, "click": Click(level=14.0, duration=0.15)}
    layout = replace(LAYOUT, regions=regions, effects=effects)
    async with fingers_on(table(), layout, layers=4, at={1: LEFT}, held=0.5) as fingers:
        fingers.at |= {2: RIGHT, 3: ABOVE}
        await fingers.hold(0.12)
        felt = {each.contact.key.id: each.held_back for each in fingers.applied[-1].targets}
        assert (felt[1], felt[2]) == (None, None)
        assert felt[3] is not None
        assert "4 contents" in felt[3]
        await fingers.hold(0.06)
        felt = {each.contact.key.id: each.held_back for each in fingers.applied[-1].targets}
        assert felt == {1: None, 3: None}


@in_virtual_time
async def test_a_slide_to_another_band_keeps_the_beat() -> None:
    """Carrier and side bands change their frequencies together, in one phase at the finger."""
    west = Region("west", Rectangle(0.0, 0.0, 0.17, 0.12), on_press="rough", on_move="rough")
    east = Region("east", Rectangle(0.17, 0.0, 0.13, 0.12), on_press="rough", on_move="rough")
    bands = replace(west, band=(200.0, 300.0)), replace(east, band=(100.0, 160.0))
    async with fingers_on(
        table(), replace(LAYOUT, regions=bands), at={1: LEFT}, held=0.5
    ) as fingers:
        for x in np.linspace(LEFT[0], RIGHT[0], 8):
            fingers.at = {1: (float(x), LEFT[1])}
            await fingers.hold(0.08)
        await fingers.hold(1.0)
        assert max(one.content.frequency for one in fingers.applied[-1].contents.values()) < 200
        assert 0.8 < depth_of(fingers, "1") < 1.3


@in_virtual_time
async def test_voices_of_one_finger_end_together() -> None:
    """When it lifts, all its layers fall silent, and the other's is not touched."""
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT}, held=1.0) as fingers:
        contents = fingers.applied[-1].contents
        (own,) = (number for number, one in contents.items() if one.content.key[0].id == 2)
        before = len(fingers.committed)
        del fingers.at[1]
        await fingers.hold(0.3)
        sets = [layer for _, _, layers in fingers.committed[before:] for layer in layers]
        ended = {layer.layer for layer in sets if not layer.renew}
        assert len(ended) == 3
        assert own not in ended
        assert [*fingers.applied[-1].contents] == [own]


@in_virtual_time
async def test_a_refused_voice_takes_the_others_of_its_finger_along() -> None:
    """A carrier without one side band would be another content: the finger feels none.

    It is tried again 50 ms later, when what the other felt before has faded, and no more; the other
    plays on.
    """
    async with fingers_on(table(), LAYOUT, at={2: RIGHT}, held=0.5) as fingers:
        refused = fingers.refuse(
            "no more",
            lambda layers: sum(any(t.level for t in each.tones) for each in layers) >= 3,
        )
        fingers.at[1], count = LEFT, len(fingers.committed)
        await fingers.hold(0.5)
        assert refused[-1] - refused[0] == pytest.approx(0.05, abs=0.005)
        assert all(layers for _, _, layers in fingers.committed[count:])  # no Silence
        targets = {each.contact.key.id: each for each in fingers.applied[-1].targets}
        assert targets[1].held_back == "no more"
        assert len([each for each in fingers.applied[-1].targets if each.contact.key.id == 1]) == 1
        assert {one.content.key[0].id for one in fingers.applied[-1].contents.values()} == {2}


def test_a_shared_content_that_changes_beside_a_click_of_its_finger_keeps_its_layer() -> None:
    """The click has begun first: what is decided next restarts neither of the two."""
    contacts = [Contact(ContactKey("a", n), *at, since=0.0) for n, at in enumerate((LEFT, RIGHT))]
    shared = tuple((each, Target(each.key, 14.0)) for each in contacts)
    click = Target(contacts[0].key, 14.0, pulse=Pulse(0.04, requested_at=0.0))
    pattern = Layer({"SW": Tone(100.0, 1e-6)})
    lasting = Content((shared[0][0].key, 0), shared, Placement((LEFT,)), pattern)
    alone = ((contacts[0], click),)
    clicking = Content((contacts[0].key, 0), alone, Placement((LEFT,)), pattern)
    playing = Layers(smooth_rig(), playable(4), Timing(table()), expiry_of=lambda key: 0.0)
    contents = {
        number: LayerContent(one, pattern, drive={})
        for number, one in ((1, clicking), (0, lasting))
    }
    playing.start(Sets(started=frozenset({0})), contents, 0.0)
    numbers = playing.numbered([lasting, clicking])
    assert numbers == {0: lasting, 1: clicking}
    assert playing.starting(numbers) == []
