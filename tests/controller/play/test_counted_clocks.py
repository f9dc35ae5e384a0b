"""Clocks of two amplifiers as answers count them, also while one is not held."""

import logging
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from controller.effects.player import EffectPlayer
from controller.play.counted_clocks import CountedClocks
from controller.play.selected_contents import leaks_db_sl
from controller.sources.touch import Contact, ContactKey
from drivers.host.group import Group
from drivers.protocol.definition import CLOCK_UNKNOWN
from kit.chain import FarEnd
from kit.clock import in_virtual_time
from kit.plates import smooth_rig, smooth_table
from model.answer.answer_report import Timing
from model.ensemble.attached_plate import AttachedPlate, PlateOnEras
from model.ensemble.draws import EXACT_CLOCKS
from model.rig.rig import Channel, Rig, Uncertainty
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from registry import threads
from sim.amplifier.amplifier_clock import Crystal
from sim.far_ends.wire_assignment import SimulatedWire
from sim.plant.imperfections import draw_imperfections
from tests.controller.play.fingers_on_layouts import LAYOUT, LEFT, RIGHT, Fingers, sensations

LOGGER = "controller.play.counted_clocks"
IDENTIFIED = Uncertainty(0.015, 1.5, 0.002, 0.01, 1.1, 0.5, modulus=0.0, place=0.0, harmonic=0.0)
"""Tolerances of a plate that has been identified."""
WIRE = SimulatedWire("serial", speed=921_600, shared=True, line_kind="prompt")
BOTH_AMPLIFIERS = (0, 1, 0, 1)
"""Groups of ERAs that have a clock each."""


def on_two_amplifiers(rig: Rig, channels: list[Channel]) -> Rig:
    """The rig with its ERAs on these channels of amplifiers a and b."""
    names = [era.name for era in rig.eras]
    wiring = dict(zip(names, channels, strict=True))
    return replace(rig, amplifiers={"a": "sim://", "b": "sim://"}, wiring=wiring)


ALTERNATING_RIG = on_two_amplifiers(
    smooth_rig(), [Channel("a", 0), Channel("b", 0), Channel("a", 1), Channel("b", 1)]
)


def test_answers_count_a_clock_again_before_it_is_worse_than_counted() -> None:
    """A quarter more than the known error is counted, until that is passed or far too much."""
    errors = {"a": 8e-6, "b": 4e-6}
    clocks = CountedClocks(ALTERNATING_RIG, lambda: errors)

    first = clocks.counted_by(smooth_table())
    assert first.clocks.errors == pytest.approx((10e-6, 5e-6))
    errors |= {"a": 9.9e-6, "b": 3e-6}
    assert clocks.counted_by(first) is first
    errors["a"] = 10.1e-6
    worse = clocks.counted_by(first)
    assert worse.clocks.errors[0] == pytest.approx(12.625e-6)
    errors["a"] = 5e-6
    better = clocks.counted_by(worse)
    assert better.clocks.errors[0] == pytest.approx(6.25e-6)


def test_clock_of_a_single_amplifier_is_not_counted() -> None:
    """Its error is not even asked for."""
    rig = smooth_rig()
    wiring = {era.name: Channel("a", number) for number, era in enumerate(rig.eras)}
    clocks = CountedClocks(replace(rig, wiring=wiring), lambda: pytest.fail("not needed"))
    table = smooth_table()
    assert clocks.counted_by(table) is table
    assert table.clocks == EXACT_CLOCKS


def test_losses_of_a_clock_are_logged_once_with_their_count(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five losses within a second are one warning; after 10 s the return is logged with the count.

    Answers follow each change immediately.
    """
    now = 0.0
    errors = {"a": 4e-6, "b": 4e-6}
    monkeypatch.setattr(threads, "now", lambda: now)
    clocks = CountedClocks(ALTERNATING_RIG, lambda: errors)
    table = clocks.counted_by(smooth_table())
    caplog.set_level(logging.INFO, logger=LOGGER)

    for _ in range(5):
        errors["b"] = math.inf
        table = clocks.counted_by(table)
        assert table.clocks.groups == BOTH_AMPLIFIERS
        now += 0.1
        errors["b"] = 4e-6
        table = clocks.counted_by(table)
        assert table.clocks.groups == ()
        now += 0.1
    now += 9.8  # 9.9 s since its return
    table = clocks.counted_by(table)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]

    now += 0.2
    table = clocks.counted_by(table)
    table = clocks.counted_by(table)
    errors["b"] = math.inf
    clocks.counted_by(table)
    levels = [record.levelno for record in caplog.records]
    assert levels == [logging.WARNING, logging.INFO, logging.WARNING]
    assert "losses before: 5" in caplog.messages[1]
    for message in caplog.messages:
        assert "amplifier b" in message


def halves() -> Rig:
    """The paper's rig after identification, with each half of it on an amplifier."""
    channels = [Channel("a", 0), Channel("a", 1), Channel("b", 0), Channel("b", 1)]
    return on_two_amplifiers(replace(smooth_rig(), uncertainty=IDENTIFIED), channels)


@cache
def table_of_halves() -> LocalizationTable:
    """Its table at 29 frequencies."""
    return build_table(halves(), frequencies=np.linspace(40.0, 320.0, 29))


@asynccontextmanager
async def two_fingers(*, has_unsteered_clock: bool) -> AsyncIterator[Fingers]:
    """Two fingers that come a second after arming, each with a content.

    has_unsteered_clock: whether amplifier b reports that its clock is not steered.
    """
    rig = halves()
    table = table_of_halves()
    crystals = {"a": Crystal(), "b": Crystal(error=40e-6)}
    async with Fingers.on(
        WIRE,
        rig,
        table,
        imperfections=replace(draw_imperfections(rig, seed=1), crystals=crystals),
        intent_source=EffectPlayer(LAYOUT),
        timing=Timing(table),
    ) as fingers:
        if has_unsteered_clock:
            fingers.far.bench.amplifiers["b"].capabilities["clock_error"] = CLOCK_UNKNOWN
        await fingers.open()
        await fingers.operate("arm")
        await fingers.hold(1.0)
        fingers.at = {1: LEFT, 2: RIGHT}
        yield fingers
        await fingers.close()


@in_virtual_time
async def test_promise_is_kept_with_a_clock_that_is_not_steered() -> None:
    """Contents use the ERAs of one amplifier each; 40 ppm are 0.4 ms after 10 s."""
    async with two_fingers(has_unsteered_clock=True) as fingers:
        await fingers.hold(10.0)
        contrasts = fingers.contrasts()
        targets = sensations(fingers.applied[-1])
        assert contrasts.keys() == {1, 2}
        for id, contrast in contrasts.items():
            promise = targets[id].sensation.promised_contrast_db
            assert contrast > promise, f"finger {id}"


class AlwaysChanging(dict[ContactKey | None, float]):
    """Changes of fingers in every plan."""

    def __bool__(self) -> bool:
        return True


def active_frequencies(far_end: FarEnd) -> set[float]:
    """Frequencies that an amplifier plays and is to continue [Hz]."""
    voices = [voice for channel in far_end.amplifier.outputs for voice in channel]
    return {voice.frequency for voice in voices if voice.transition.last}


def common_frequencies(fingers: Fingers) -> set[float]:
    """Frequencies that both amplifiers play [Hz]."""
    return set.intersection(*map(active_frequencies, fingers.far_ends))


@pytest.mark.parametrize(
    ("is_changing", "seconds"), [(False, 0.1), (True, 0.2)], ids=["resting", "changing"]
)
@in_virtual_time
async def test_contents_leave_a_clock_that_is_lost(
    monkeypatch: pytest.MonkeyPatch, is_changing: bool, seconds: float
) -> None:
    """Within 0.1 s none plays on both amplifiers, though no finger has changed.

    Within 0.2 s if fingers change in every plan: clocks are counted every 0.1 s then.
    """
    errors = {"a": 2e-6, "b": 2e-6}
    monkeypatch.setattr(Group, "clock_errors", property(lambda group: errors))
    async with two_fingers(has_unsteered_clock=False) as fingers:
        await fingers.hold(1.0)
        assert common_frequencies(fingers) != set()
        if is_changing:
            fingers.controller.cycle.tracker._changed = AlwaysChanging()

        errors["b"] = math.inf
        await fingers.hold(seconds)
        assert common_frequencies(fingers) == set()
        await fingers.hold(0.5)
        assert common_frequencies(fingers) == set()
        assert set.union(*map(active_frequencies, fingers.far_ends)) != set()


@in_virtual_time
async def test_status_of_several_amplifiers_eliminates_no_plate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """For 16 ERAs that takes 0.2 s without heartbeats: it is done before touches."""
    eliminations: list[object] = []
    eliminate = PlateOnEras.of

    def record(plate: AttachedPlate, *counts: int) -> PlateOnEras:
        eliminations.append(plate)
        return eliminate(plate, *counts)

    monkeypatch.setattr(PlateOnEras, "of", record)
    table = replace(table_of_halves())
    source = EffectPlayer(LAYOUT)
    timing = Timing(table_of_halves())
    async with Fingers.on(WIRE, halves(), table, intent_source=source, timing=timing) as fingers:
        await fingers.open()
        assert eliminations
        eliminations.clear()
        leaks_db_sl(table, (), (Contact(ContactKey("panel", 1), *LEFT, since=0.0),))
        assert eliminations == []
