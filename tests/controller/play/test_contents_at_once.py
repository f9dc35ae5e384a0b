"""Several fingers, each with a content of its own, on the plate in virtual time."""

import asyncio
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from controller.daemon.messages import PlateView
from controller.effects.kinds import Buzz, Click
from controller.effects.layout import SurfaceLayout, layout_of
from controller.play.intent import HapticIntent, Pulse, Target
from controller.play.selection import Chooser, Selector
from controller.sources.touch import Contact, ContactKey
from courses import follow
from drivers.protocol.sets import LayerSet
from model.answer import answer
from model.arrays import Complex64Array
from model.config.document import data_text, parse_document
from set_table import SetTiming
from several_fingers import (
    ABOVE,
    LAYOUT,
    LEFT,
    RIGHT,
    Hands,
    answers_take,
    chosen_for,
    fingers_on,
    places_of,
    playable,
    table,
)
from virtual_lines import in_virtual_time
from yaml_files import read_yaml

FILE = read_yaml(Path(__file__).with_name("fingers.yaml"))
LAYOUTS = {
    name: layout_of(parse_document(name, data_text(each)), None)
    for name, each in FILE["layouts"].items()
}


@asynccontextmanager
async def hands(
    *, fingers: Mapping[int, Any] = MappingProxyType({}), layout: str = "plain", **options: Any
) -> AsyncIterator[Hands]:
    """Fingers on a layout of the file, with a first mark; options: as of `fingers_on`."""
    given = {"at": places_of(fingers), **options}
    async with fingers_on(table(), LAYOUTS[layout], of=Hands, **given) as found:
        with pytest.MonkeyPatch.context() as found.patch:
            found.layouts = LAYOUTS
            found.marks()
            yield found


@pytest.mark.parametrize("name", FILE["courses"])
def test_fingers_keep_to_their_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(FILE["courses"][name], hands)


def answering_after(seconds: float, monkeypatch: pytest.MonkeyPatch) -> asyncio.AbstractEventLoop:
    """Let every answer of the thread take a time [s]; returns the running loop."""
    answers_take(monkeypatch, seconds)
    return asyncio.get_running_loop()


def begun(committed: Sequence[tuple[float, int, tuple[LayerSet, ...]]]) -> list[Sequence[LayerSet]]:
    """The sets that change what plays: neither renewals nor endings."""
    sets = list[Sequence[LayerSet]]()
    for _, _, layers in committed:
        endings = [command.ending for one in layers for command in one.commands]
        if not (layers[0].renew or any(endings)):
            sets.append(layers)
    return sets


@in_virtual_time
async def test_what_lasts_has_what_a_loud_click_leaves_and_all_of_it_after_that() -> None:
    """A finger's vibration is raised amid the 40 ms of another's click: both need 1.2 strokes.

    It is never silent, nor refused by the amplifiers.
    """
    regions = (LAYOUT.regions[0], replace(LAYOUT.regions[1], on_press="click"))
    effects = {**LAYOUT.effects, "click": Click(level=44.0), "loud": Buzz(level=44.0)}
    layout = SurfaceLayout(regions, effects, elsewhere=None)
    async with fingers_on(table(), layout, at={1: LEFT}, held=0.6) as fingers:
        begin = asyncio.get_running_loop().time()
        fingers.at[2] = RIGHT
        await fingers.hold(0.012)
        fingers.play("loud")
        await fingers.hold(0.2)
        raised = [each for each in fingers.applied if each.time > begin + 0.012]
        felt = [each for applied in raised for each in applied.targets if each.contact.key.id == 1]
        assert {each.held_back for each in felt} == {None}
        assert felt[0].level_db_sl < felt[-1].level_db_sl - 0.5
        assert not fingers.silenced
        assert raised[-1].time - begin <= 0.15
        await fingers.hold(0.3)
        assert fingers.levels_db_sl()[1] >= 43


@in_virtual_time
async def test_an_answer_is_shaped_by_the_timing_it_began_with(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Others are put in place meanwhile, whose timing has no envelopes: what was begun has one."""
    answering_after(0.03, monkeypatch)
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT}, held=0.01) as fingers:
        fingers.controller.replace_answers(table(), SetTiming())  # type: ignore[arg-type]
        await fingers.hold(0.3)
        (applied,) = fingers.applied
        assert all(one.layer.onset for one in applied.contents.values())


@in_virtual_time
async def test_what_is_not_served_says_why() -> None:
    """Of six fingers the four newest have the four layers; the plate cannot serve all of these."""
    async with fingers_on(table(), LAYOUT, layers=4) as fingers:
        x = (0.03, 0.08, 0.13, 0.18, 0.23, 0.28)
        fingers.at = {id: (at, 0.05 + 0.12 * (id % 2)) for id, at in enumerate(x, start=1)}
        await fingers.hold(0.5)
        felt = {each.contact.key.id: each for each in fingers.applied[-1].targets}
        assert felt.keys() == fingers.at.keys()
        for each in felt.values():
            assert each.verdict in ("own", "mixed", "shared", "held back")
            assert (each.held_back is None) == (each.verdict in ("own", "mixed"))
            assert "(" not in (each.held_back or "")  # no object of the program
        assert {felt[id].verdict for id in (1, 2)} == {"held back"}  # the earliest
        assert felt[1].held_back == (
            "no layer is free: the amplifiers play 4 contents at once; lift a finger"
        )
        others = [felt[id] for id in (3, 4, 5, 6) if felt[id].verdict == "held back"]
        assert others
        assert all("6 dB of contrast" in (each.held_back or "") for each in others)


@in_virtual_time
async def test_status_says_what_each_finger_feels() -> None:
    """Keys of the API: by finger its content and verdict; by layer what the ERAs play."""
    async with fingers_on(table(), LAYOUT, at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=0.5) as fingers:
        applied = fingers.applied[-1]
        view = PlateView(lambda key: "buzz", applied.contacts, applied)
        event = view.pattern_event()
        assert event is not None
        assert len(event.layers) == 3
        for contact, (number, one) in zip(event.contacts, applied.contents.items(), strict=True):
            assert (contact.role, contact.held_back) == ("target", None)
            promised = contact.promised_contrast_db
            assert promised is not None
            assert contact.verdict == ("own" if promised >= 12 else "mixed")
            assert contact.level_db_sl == pytest.approx(14.0, abs=0.5)
            assert contact.foreign_level_db_sl == pytest.approx(14.0 - promised, abs=2.0)
            assert contact.frequency_hz == one.content.frequency
            tones = event.layers[str(number)].values()
            assert {tone.frequency_hz for tone in tones} == {contact.frequency_hz}
        assert len({contact.frequency_hz for contact in event.contacts}) == 3


@in_virtual_time
async def test_what_is_shared_stays_weak_while_its_weakest_finger_feels_a_click() -> None:
    """Of five that share a vibration one has 20 dB less: so has the vibration, amid its click."""
    contacts = [Contact(ContactKey("s", n), 0.05 + 0.02 * n, 0.05, 0.0) for n in range(5)]
    lasting = [Target(each.key, 14.0, content="buzz") for each in contacts]
    clicking = [*lasting, replace(lasting[0], pulse=Pulse(0.04, 1.0), content="click")]
    selector, found = Selector(Chooser(table())), list[list[float]]()
    for targets in (lasting, lasting, clicking):
        gains = {(each.key, each.is_short): 0.0 for each in targets}
        gains |= {key: -20.0 for key in gains if key[0] == contacts[0].key}
        chosen = selector.select(contacts, HapticIntent(tuple(targets)), playable(), now=1.0)
        found.append([each.gain_db for each in chosen.weakened(gains).contents])
        await asyncio.sleep(0.1)
    assert found[1:] == [[-20.0], [-20.0, -20.0]]


def test_a_content_whose_own_contrast_is_not_why_it_is_held_back_says_so() -> None:
    """Both in one narrow band: the first would have had 3 dB beside it, it 16 itself."""
    contacts = [
        Contact(ContactKey("a", n), *at, since=0.0)
        for n, at in enumerate(((0.06, 0.06), (0.2, 0.1)))
    ]
    targets = [(each, Target(each.key, 20.0, band=(99.0, 101.0))) for each in contacts]
    found = chosen_for(targets, playable(4))
    (held_back,) = found.not_served
    assert held_back.promised_contrast_db is not None
    assert held_back.promised_contrast_db > 12
    assert held_back.held_back is not None
    assert "another finger" in held_back.held_back


def test_a_kept_frequency_keeps_its_phase_at_the_finger() -> None:
    """As it moves by 1 cm and another joins, at its new place; by the fields of the table."""
    contacts = [Contact(ContactKey("a", n), *at, since=0.0) for n, at in enumerate((LEFT, RIGHT))]
    targets = [(each, Target(each.key, 14.0)) for each in contacts]
    first = chosen_for(targets, playable(4))
    before = {each.key: each for each in first.contents}
    moved = replace(contacts[0], x=contacts[0].x + 0.01)
    third = Contact(ContactKey("a", 2), *ABOVE, since=0.0)
    joined = [(moved, targets[0][1]), targets[1], (third, Target(third.key, 14.0))]
    second = chosen_for(joined, playable(4), before=before)
    places = [(each.x, each.y) for each, _ in joined]
    fields = table().unit_fields(np.array(places), contacts=places)
    kept = 0
    for content in second.contents:
        then = before.get(content.key)
        if then is not None and then.frequency == content.frequency:
            at = places.index((content.targets[0][0].x, content.targets[0][0].y))
            now, old = (_felt(each.layer, fields[:, :, at]) for each in (content, then))
            assert np.angle(now / old) == pytest.approx(0.0, abs=1e-3)
            kept += 1
    assert kept


def _felt(pattern: answer.Layer, fields: Complex64Array) -> complex:
    """Acceleration at a finger of a pattern of one frequency, by each ERA's field (f, eras)."""
    (frequency,) = {tone.frequency for tone in pattern.excitation.values()}
    row = int(np.flatnonzero(table().frequencies == frequency)[0])
    eras = {era.name: (number, era.stroke) for number, era in enumerate(table().eras)}
    return complex(
        sum(
            tone.amplitude / eras[name][1] * np.exp(1j * tone.phase) * fields[row, eras[name][0]]
            for name, tone in pattern.excitation.items()
        )
    )
