"""Modulated contents: a carrier and two side bands, by plates solved exactly."""

import numpy as np
import pytest

from model.finger.perception import detection_threshold
from model.table.answer import answer
from model.table.build import build_table
from model.table.exact_plates import draw_plates, powers_on
from model.table.modulation import frequency_of, with_modulation
from model.table.question import Question
from model.table.request import Finger, Request
from paper_table import contact_sets, smooth_rig


@pytest.fixture(scope="module")
def table():
    """The paper's plate at 29 frequencies, 10 Hz apart."""
    return build_table(smooth_rig(), frequencies=np.linspace(40.0, 320.0, 29))


def powers(table, tones, places, plates):
    """Power above threshold of a drive of one frequency at fingers: (fingers, points, d)."""
    tips = table.read_fingertips(places)
    rows, power = powers_on(table, Question(tuple(places)), tones, plates)
    sensed = power[0] / detection_threshold(table.frequencies[rows]) ** 2
    return sensed.reshape(*tips.fine_weights.shape, -1), tips.fine_weights


@pytest.mark.parametrize("modulation", [10.0, 30.0])
def test_promise_of_a_modulated_content_is_kept(table, modulation):
    """On nine of ten plates that the search has not seen, side bands added by powers."""
    kept, levels = [], []
    for number, places in enumerate(contact_sets(6, fingers=3, seed=4)):
        requests = [Request(at, level_db_sl=12.0) for at in places[:2]]
        fingers = [Finger(places[2])]
        plain = answer(table, requests, fingers)
        found = with_modulation(table, requests, fingers, plain, [modulation, modulation])
        plates = draw_plates(
            np.random.default_rng(number),
            table.uncertainty,
            count=150,
            era_count=4,
            contact_count=3,
        )
        each = [
            [powers(table, tones, places, plates) for tones in (one.excitation, *one.side_bands)]
            for one in found.layers
            if one.excitation
        ]
        if len(each) < 2:
            continue
        felt = np.array([sum(power for power, _ in tones) for tones in each])
        own = [
            np.sqrt(sum((shares[j] @ np.sqrt(power[j])) ** 2 for power, shares in tones))
            for j, tones in enumerate(each)
        ]
        ratios = [own[j] / np.sqrt(felt[1 - j, j].max(axis=0)) for j in (0, 1)]
        ratios.append(np.min(own, axis=0) / np.sqrt(felt[:, 2].sum(axis=0).max(axis=0)))
        contrast = 20 * np.log10(np.min(ratios, axis=0))
        kept.append((contrast >= found.promised_worst_db).mean())
        levels.append((20 * np.log10(own[0]) >= found.layers[0].promised_level_db_sl).mean())
    assert len(kept) >= 4
    assert 0.84 <= np.mean(kept) <= 0.96
    assert 0.84 <= np.mean(levels) <= 0.96


def test_side_bands_lie_evenly_about_the_carrier_at_half_its_amplitude(table):
    """Full modulation: half of the carrier's amplitude at the finger each, 1.8 dB more in all."""
    requests = [Request((0.126, 0.081), level_db_sl=14.0), Request((0.234, 0.049))]
    plain = answer(table, requests)
    found = with_modulation(table, requests, [], plain, [20.0, None])
    layer = found.layers[0]
    carrier = frequency_of(layer)
    sides = [next(iter(tones.values())).frequency for tones in layer.side_bands]
    assert sorted(sides) == pytest.approx([carrier - 20.0, carrier + 20.0])
    assert abs(carrier - frequency_of(found.layers[1])) >= 30
    fields = {}
    for tones in (layer.excitation, *layer.side_bands):
        frequencies, amplitudes = table.amplitudes(
            tones, np.array([requests[0].at]), contacts=[each.at for each in requests]
        )
        sensed = amplitudes[0, 0] / detection_threshold(frequencies)[0]
        fields[float(frequencies[0])] = float(sensed)
    for side in sides:
        assert fields[side] / fields[carrier] == pytest.approx(
            0.5, rel=0.2
        )  # each is that of nine of ten plates
    assert 14.0 - 0.1 <= layer.promised_level_db_sl <= 15.0  # errors of three tones differ
    assert found.layers[1].excitation == plain.layers[1].excitation
    assert found.layers[1].side_bands == ()


def test_side_bands_of_their_own_leak_less_than_those_of_the_carrier(table):
    """At the same weights 20 Hz of modulation cost 5 dB and more, at their own at most 3."""
    lost = []
    for places in contact_sets(6, fingers=2, seed=7):
        requests = [Request(at, level_db_sl=12.0) for at in places]
        plain = answer(table, requests)
        found = with_modulation(table, requests, [], plain, [20.0, None])
        if found.layers[0].side_bands:
            lost.append(plain.promised_worst_db - found.promised_worst_db)
    assert len(lost) >= 4
    assert np.median(lost) < 3.0


def test_a_modulation_is_left_out_where_a_finger_would_feel_too_much(table):
    """Its bound for others' contents holds for side bands, too; no side bands beyond the table."""
    quiet = Finger((0.16, 0.20))
    requests = [Request((0.09, 0.07), level_db_sl=12.0)]
    plain = answer(table, requests, [quiet])
    modulated = with_modulation(table, requests, [quiet], plain, [30.0])
    leak = modulated.quiet[0].level_db_sl
    bounded = [Finger(quiet.at, max_foreign_db_sl=leak - 0.1)]
    assert modulated.layers[0].side_bands
    assert not with_modulation(table, requests, bounded, plain, [30.0]).layers[0].side_bands
    low = [Request((0.09, 0.07), (40.0, 50.0), level_db_sl=12.0)]
    found = answer(table, low, [quiet])
    assert with_modulation(table, low, [quiet], found, [30.0]) == found
