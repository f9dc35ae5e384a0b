"""Answers for all fingers together, on the plate in virtual time.

What moving fingers are promised; fingers at rest that are answered again once the cause that held
one of them back has passed; and the way from what plays to a better answer. Two fingers that land
0.35 s apart on the paper's plate are promised 8.9 dB, since the frequency of the first is kept, and
19.5 where they land together; on the way both frequencies change.
"""

import math
from collections import Counter
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cases import shortly
from controller.play.crossfades import Crossfades
from controller.play.intent import HapticIntent, Target
from controller.play.joint_answers import answered, with_paths
from controller.play.layers import CROSSFADE
from controller.play.reports import PlayReport
from controller.play.shared_capabilities import RAMPS_ONLY
from controller.sources.touch import Contact, ContactKey, Track, track_with
from drivers.host.group import Group
from kit.chain import Chain, Position
from kit.clock import in_virtual_time, run_virtual
from kit.fingers import LAYOUT, LEFT, RIGHT, Fingers, asked, chosen_for, fingers_on, playable
from kit.fingers import table as paper_table
from kit.plates import contact_sets, smooth_rig
from kit.wires import on_two_amplifiers
from model.answer.answer import Limits
from model.answer.answer_report import Timing
from model.answer.stimulus import Finger, Placement, Stimulus
from model.config.fields import Rectangle
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import load_rig
from model.study.contact_sets import random_contacts
from model.study.exact_plates import draw_plates, harmonics_on, powers_on
from model.table.fingertip_shapes import read_fingertips
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from registry import threads
from sim.far_ends.wire_assignment import SimulatedWire

BUS = SimulatedWire("serial", speed=921_600, shared=True, line_kind="prompt")
LINES = SimulatedWire("serial", speed=921_600, unpluggable=True)


@dataclass
class EachItsOwn:
    """Every finger is to feel a buzz of its own, in a band [Hz] if there is one, and weakened."""

    band: tuple[float, float] | None = None
    gain_db: float = 0.0

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return it."""
        targets = tuple([Target(each.key, 14.0, band=self.band) for each in contacts])
        gains = {(each.key, False): self.gain_db for each in contacts}
        return HapticIntent(targets, gains_db=gains)

    def has_effect_at(self, contact: Contact) -> bool:
        """Return True: every contact has one."""
        return True


@cache
def eight_eras() -> Rig:
    """On two amplifiers."""
    path = Path(__file__).parents[3] / "examples" / "eight_eras.yaml"
    return load_rig(path, mesh="12x9")


@cache
def table() -> LocalizationTable:
    """Its table at 24 frequencies."""
    return build_table(eight_eras(), frequencies=np.linspace(40.0, 500.0, 24))


def served(chain: Chain) -> int:
    """How many fingers feel something of their own."""
    felt = chain.applied[-1].targets if chain.applied else ()
    return sum(each.held_back is None for each in felt)


@asynccontextmanager
async def bus(number: int) -> AsyncIterator[Chain]:
    """Eight ERAs on one bus, open, and three fingers at random places for 0.3 s."""
    given: dict[str, Any] = {"intent_source": EachItsOwn(), "timing": Timing(table())}
    async with Chain.on(BUS, eight_eras(), table(), **given) as chain:
        chain.is_felt = chain.must_be_felt = False
        await chain.open()
        chain.at = dict(enumerate(contact_sets(24, fingers=3, seed=5)[number]))
        await chain.hold(0.3)
        yield chain
        await chain.close()


@pytest.mark.parametrize("number", shortly(range(24), range(3)))
def test_fingers_down_before_arming_are_served_as_those_that_land_after_it(number: int) -> None:
    """Of three contents on two amplifiers of one bus, whose clocks are known from arming on.

    Within 0.2 s no fewer fingers feel theirs than once the same fingers land again.
    """

    async def run() -> tuple[int, int]:
        async with bus(number) as chain:
            await chain.operate("arm")
            await chain.hold(0.2)
            places, resting = chain.at, served(chain)
            chain.at = {}
            await chain.hold(0.02)
            chain.at = places
            await chain.hold(0.2)
            return resting, served(chain)

    resting, landing = run_virtual(run())
    assert resting >= landing


@in_virtual_time
async def test_fingers_that_rest_are_served_once_clocks_are_held(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Those of one amplifier each leave one of three out; 0.3 s after both are held none is."""
    known = {"a": math.inf, "b": math.inf}
    monkeypatch.setattr(Group, "clock_errors", property(lambda group: known))
    async with bus(0) as chain:
        await chain.operate("arm")
        await chain.hold(0.5)
        assert 0 < served(chain) < 3
        known |= {"a": 4e-6, "b": 4e-6}
        await chain.hold(0.3)
        assert served(chain) == 3


@asynccontextmanager
async def two_fingers(
    of: LocalizationTable | None = None, rig: Rig | None = None, **options: Any
) -> AsyncIterator[tuple[Chain, EachItsOwn]]:
    """Two fingers that rest on the paper's plate, armed, for 0.5 s; of: what answers first."""
    table, source = of or paper_table(), EachItsOwn()
    given: dict[str, Any] = {"intent_source": source, "timing": Timing(table), **options}
    async with Chain.on(LINES, rig or smooth_rig(), table, **given) as chain:
        chain.is_felt = chain.must_be_felt = False
        await chain.open()
        await chain.operate("arm")
        chain.at = {1: LEFT, 2: RIGHT}
        yield chain, source
        await chain.close()


@in_virtual_time
async def test_fingers_that_rest_are_served_as_is_wanted_now() -> None:
    """In one narrow band, or 40 dB weaker, a finger feels nothing; without that both do."""
    async with two_fingers(paper_table()) as (chain, source):
        await chain.hold(0.5)
        assert served(chain) == 2
        for wanted, before, after in (("band", (99.0, 101.0), None), ("gain_db", -40.0, 0.0)):
            chain.at = {}
            await chain.hold(0.3)
            setattr(source, wanted, before)
            chain.at = {1: LEFT, 2: RIGHT}
            await chain.hold(0.5)
            assert served(chain) < 2
            setattr(source, wanted, after)
            chain.controller.cycle.request_update()
            await chain.hold(0.3)
            assert served(chain) == 2


@in_virtual_time
async def test_fingers_that_rest_are_served_within_limits_of_now() -> None:
    """An amplifier that allowed 0.3 % of its level allows all of it when it is armed again."""
    async with two_fingers(capabilities={"level_max": 30}) as (chain, _):
        await chain.hold(0.5)
        assert served(chain) == 0
        chain.far_end.amplifier.capabilities["level_max"] = 10_000
        for limits in chain.far_end.amplifier.capabilities["limits"]:
            limits["level_max"] = 10_000
        await chain.operate("disarm")
        await chain.operate("arm")
        await chain.hold(0.3)
        assert served(chain) == 2


@in_virtual_time
async def test_fingers_are_served_with_capabilities_that_became_smaller() -> None:
    """Firmware with fewer layers, short ramps and no envelopes is armed: no set is refused."""
    async with two_fingers() as (chain, _):
        await chain.hold(0.5)
        assert served(chain) == 2
        await chain.operate("disarm")
        chain.at = {}
        await chain.hold(0.3)
        chain.far_end.amplifier.capabilities.update(layers=4, ramp_max=200, knots=0)
        chain.far_end.amplifier.restart(threads.now())
        await chain.operate("arm")
        planner = chain.controller.cycle.planner
        assert planner is not None
        assert planner.capabilities.envelope_support == RAMPS_ONLY
        assert (planner.slots.layers.count, planner.capabilities.ramp_max) == (4, 0.2)
        chain.at = {1: LEFT, 2: RIGHT}
        await chain.hold(0.3)
        assert served(chain) == 2
        assert not chain.refused


@in_virtual_time
async def test_fingers_that_rest_are_served_once_a_lost_amplifier_is_back() -> None:
    """Both feel theirs 0.3 s after all are open again and armed."""
    async with two_fingers(rig=on_two_amplifiers(smooth_rig())) as (chain, _):
        await chain.hold(0.3)
        assert served(chain) == 2
        chain.far_ends[1].fault("unplug")
        await chain.hold(0.5)
        chain.far_ends[1].recover()
        await chain.controller.open()
        await chain.controller.clear()
        chain.applied.clear()
        await chain.operate("arm")
        await chain.hold(0.3)
        assert served(chain) == 2


MOVER, OTHER = (0.10, 0.08), (0.22, 0.12)
NOW = 5.0


def contact(number: int, at: tuple[float, float], vx: float = 0.0, vy: float = 0.0) -> Contact:
    """A contact with a velocity [m/s], at its place now, reported every 10 ms."""
    track: Track = ()
    for step in range(-5, 1):
        time = 0.01 * step
        track = track_with(track, NOW + time, at[0] + vx * time, at[1] + vy * time)
    return Contact(ContactKey("a", number), *at, since=0.0, track=track)


def fingers(contacts: Sequence[Contact]) -> list[Finger]:
    """Fingers at the contacts, each with a stimulus of its own."""
    return [Finger((each.x, each.y), Stimulus(14.0, name=str(each.key.id))) for each in contacts]


def test_a_moving_finger_is_answered_around_the_next_8_mm() -> None:
    """At 0.2 m/s 20 ms until it plays and 20 until weights have half changed: from 8 to 16 mm on.

    Its three places are 8 mm apart, the middle one in the middle of that way.
    """
    contacts = [contact(1, MOVER, vx=0.2), contact(2, OTHER)]
    middle, other, first, last = with_paths(fingers(contacts), contacts, NOW, paper_table().plate)
    assert [each.at[0] - MOVER[0] for each in (first, middle, last)] == pytest.approx(
        [0.004, 0.012, 0.020]
    )
    assert other == fingers(contacts)[1]
    assert sum(each.load for each in (first, middle, last)) == pytest.approx(1.0)


def test_what_is_felt_on_a_way_is_the_mean_power_there_and_a_share_for_side_bands() -> None:
    """Nominal contrasts of both, by three places on the plate solved exactly.

    To the foreign power at either finger comes a fiftieth, over the number of ERAs, of what the
    other one feels of its own. The promise is kept on nine of ten plates that deviate, within eight
    in a hundred.
    """
    contacts, table = [contact(1, MOVER, vx=0.2), contact(2, OTHER)], paper_table()
    question = asked(
        [(each, Target(each.key, 14.0, content=str(each.key.id))) for each in contacts]
    )
    found = answered(table, question, question.lasting, playable(), now=NOW)
    middle, other, first, last = with_paths(fingers(contacts), contacts, NOW, table.plate)
    at = (middle, first, last, other)
    placed = Placement(
        tuple([each.at for each in at[:3]]), (other.at,), tuple([each.load for each in at])
    )
    shares, rng = read_fingertips(table, [other.at]).fine_weights[0], np.random.default_rng(3)
    of_plates = []
    for known, count in ((Uncertainty.none(), 1), (table.uncertainty, 300)):
        plates = draw_plates(rng, known, of=table, count=count, contact_count=4)
        powers = []
        for layer in found.layers:
            rows, power = powers_on(table, placed, layer.excitation, plates)
            felt = power[0] * table.sensitivities[:, rows, None] ** 2 / table.thresholds[rows] ** 2
            felt += harmonics_on(table, placed, layer.excitation, plates)
            felt = felt.reshape(len(felt), 4, -1, count)
            powers.append((felt[:, :3].mean(axis=1), felt[:, 3]))
        contrasts = []
        for own in (0, 1):
            foreign, of_other = powers[1 - own][own], powers[1 - own][1 - own].mean(axis=1)
            heard = (foreign + 0.02 / len(table.eras) * of_other[:, None]).max(axis=1)
            level = (shares[:, None] * np.sqrt(powers[own][own])).sum(axis=1)
            contrasts.append(20 * np.log10(level / np.sqrt(heard)).min(axis=0))
        of_plates.append(np.array(contrasts))
    nominal, drawn = of_plates
    for sensed, felt_here, on_plates in zip(found.fingers, nominal, drawn, strict=True):
        assert sensed.contrast_db == pytest.approx(float(felt_here[0]), abs=0.8)
        assert np.mean(on_plates >= sensed.promised_contrast_db) == pytest.approx(0.9, abs=0.08)
    assert len(found.layers) == len(found.fingers) == 2


FIRST, SECOND = (0.2133, 0.0366), (0.1206, 0.1132)


def worst(applied: PlayReport) -> float:
    """Promise of the worst finger."""
    return min(each.sensation.promised_contrast_db or 0.0 for each in applied.targets)


def frequencies(applied: PlayReport) -> dict[int, float]:
    """By finger."""
    return {each.contact.key.id: each.frequency or 0.0 for each in applied.targets}


async def apart(fingers: Fingers, *, then: float) -> int:
    """Let two fingers land 0.35 s apart, and rest; returns how many sets were committed by then."""
    fingers.at = {1: FIRST}
    await fingers.hold(0.35)
    fingers.at[2] = SECOND
    await fingers.hold(0.09)
    count = len(fingers.committed)
    await fingers.hold(then - 0.09)
    return count


WHOLE = replace(
    LAYOUT,
    regions=(replace(LAYOUT.regions[0], shape=Rectangle(0.0, 0.0, 0.3, 0.22), on_press="any"),),
)
"""Every finger feels the same effect, of 14 dB SL, at any frequency."""


def contacts_at(*places: Position) -> list[Contact]:
    """Contacts that rest."""
    return [Contact(ContactKey("a", n), *at, since=0.0) for n, at in enumerate(places)]


@in_virtual_time
async def test_fingers_that_land_apart_come_to_the_promise_of_those_that_land_together() -> None:
    """Within 1 dB, a content at a time; all that sounds at once is 30 Hz apart, and it is felt.

    It rises in a layer of its own along 300 ms, and what it replaces falls as long, 81 ms later, to
    below any threshold; then that has ended.
    """
    targets = tuple((each, Target(each.key, 14.0)) for each in contacts_at(FIRST, SECOND))
    together = chosen_for(targets, playable())
    promised = min(
        each.sensation.promised_contrast_db or 0.0 for each in together.finger_sensations
    )
    async with fingers_on(paper_table(), WHOLE) as fingers:
        count = await apart(fingers, then=0.6)
        fades = [each for each in fingers.committed[count:] if each[2][0].ramp == 300]
        (rising, _, (new,)), (falling, _, (old,)), *_ = fades
        assert (new.layer, old.layer) == (2, 0)
        assert falling - rising == pytest.approx(0.081, abs=0.005)
        assert {command.level for command in old.commands} == {1}  # 1e-4 of the stroke
        assert all(command.keep_phase for command in old.commands)
        await fingers.hold(0.3)
        assert fingers.far_end.status()["tokens"][old.layer] == 0
        assert old.layer not in fingers.applied[-1].contents
        await fingers.hold(0.6)
        landed, *steps = fingers.applied[1:]
        assert worst(landed) < promised - 6
        assert worst(steps[-1]) >= promised - 1
        for before, after in pairwise([landed, *steps]):
            (led,) = {*frequencies(after).values()} - {*frequencies(before).values()}
            assert all(abs(led - each) >= 30 for each in frequencies(before).values())
            if before is not landed:
                assert after.time - before.time >= 0.38  # no two fade at once
        assert min(fingers.contrasts().values()) >= worst(steps[-1])


@in_virtual_time
async def test_a_finger_that_moves_again_within_a_second_is_not_led_again() -> None:
    """The last step, and the first of the next way, are a second apart or more."""
    async with fingers_on(paper_table(), WHOLE) as fingers:
        await apart(fingers, then=1.1)
        steps = [each.time for each in fingers.applied[2:]]
        assert len(steps) == 2
        fingers.at[2] = (0.20, 0.15)
        await fingers.hold(1.5)
        led = [each.time for each in fingers.applied if each.settled_after == CROSSFADE]
        assert all(time - steps[-1] >= 1.0 for time in led[2:])


def test_every_step_keeps_30_hz_between_all_that_sounds() -> None:
    """Twelve sets of three fingers anywhere, of whom the third has come last, or has left."""
    rng, found = np.random.default_rng(5), 0
    for number in range(12):
        places = random_contacts(rng, 3, paper_table().plate, margin=0.013)
        targets = [(each, Target(each.key, 14.0)) for each in contacts_at(*places)]
        before = chosen_for(targets[:2], playable()) if number % 2 else None
        playing = {each.key: each for each in before.contents} if before else {}
        landed = chosen_for(targets, playable(), before=playing)
        resting = tuple(targets) if number % 2 else tuple(targets[:2])
        keys = {contact.key for contact, _ in resting}
        felt = {each.key: each for each in landed.contents if each.key.finger in keys}
        if {key for key, _ in felt} != keys:
            continue
        beside = {each.contact.key: each.frequency or 0.0 for each in landed.finger_sensations}
        beside = {key: beside[key] for key in keys}
        for step in Crossfades(paper_table(), asked(resting, felt), playable()).steps():
            after = {each.contact.key: each.frequency or 0.0 for each in step.finger_sensations}
            changed = [key for key in keys if after[key] != beside[key]]
            assert len(changed) <= 1
            for key in changed:
                assert all(abs(after[key] - each) >= 30 for each in beside.values())
                found += 1
            beside = after
    assert found >= 3


def test_what_does_not_fit_beside_what_plays_is_not_led_to() -> None:
    """Of stroke for 1.2 times what plays: both together need more.

    What it was promised for a way, here 2 dB less, is said anew as of fingers that rest.
    """
    targets = tuple((each, Target(each.key, 14.0)) for each in contacts_at(FIRST, SECOND))
    first = chosen_for(targets[:1], playable())
    landed = chosen_for(targets, playable(), before={each.key: each for each in first.contents})
    felt, drives = {each.key: each for each in landed.contents}, Counter[str]()
    for each in landed.contents:
        drives.update({name: tone.amplitude for name, tone in each.layer.excitation.items()})
    limited = replace(
        playable(), limits=Limits((40.0, 320.0), {n: 1.2 * each for n, each in drives.items()})
    )
    assert Crossfades(paper_table(), asked(targets, felt), playable()).steps()
    assert not Crossfades(paper_table(), asked(targets, felt), limited).steps()
    moving = {
        key: [
            replace(one, promised_contrast_db=one.promised_contrast_db - 2.0)
            for one in each.sensations
            if one.promised_contrast_db is not None
        ]
        for key, each in felt.items()
    }
    felt = {key: replace(each, sensations=tuple(moving[key])) for key, each in felt.items()}
    (rested,) = Crossfades(paper_table(), asked(targets, felt), limited).steps()
    assert rested.contents == landed.contents
    for one, other in zip(rested.finger_sensations, landed.finger_sensations, strict=True):
        contrast = other.sensation.promised_contrast_db
        assert one.sensation.promised_contrast_db == pytest.approx(contrast, abs=0.1)
