"""Modulated contents: a carrier and two side bands, by plates solved exactly."""

from dataclasses import replace
from itertools import chain

import numpy as np
import pytest

from model.answer.answer import Limits
from model.answer.promise import with_gains
from model.answer.stimulus import Finger, Placement
from model.finger import detection_threshold
from model.study.verification import draw_plates, powers_on
from model.table.table import read_fingertips
from model.table.table_file import build_table
from plates import contact_sets, smooth_rig
from set_table import phased as answer
from set_table import wants


@pytest.fixture(scope="module")
def table():
    """The paper's plate at 29 frequencies, 10 Hz apart; ERAs move without harmonics."""
    rig = smooth_rig()
    known = replace(rig.uncertainty, modulus=0.0, place=0.0, harmonic=0.0)
    return build_table(replace(rig, uncertainty=known), frequencies=np.linspace(40.0, 320.0, 29))


def powers(table, tones, places, plates):
    """Power above threshold of a drive of one frequency at fingers: (fingers, points, d)."""
    tips = read_fingertips(table, places)
    rows, power = powers_on(table, Placement(tuple(places)), tones, plates)
    sensed = power[0] / detection_threshold(table.frequencies[rows]) ** 2
    return sensed.reshape(*tips.fine_weights.shape, -1), tips.fine_weights


def modulated(finger, modulation):
    """The finger with a modulation [Hz]."""
    return replace(finger, stimulus=replace(finger.stimulus, modulation_hz=modulation))


def sides_of(layer):
    """Frequencies of a layer's side bands."""
    return sorted(next(iter(tones.values())).frequency for tones in layer.side_bands)


def test_contents_lowered_alike_are_served_as_before(table):
    """Contrasts are ratios of levels, so none of crowded fingers has less than it had."""
    crowded = 0
    for places in contact_sets(8, fingers=4, seed=4):
        requests = [wants(at, level_db_sl=15.0) for at in places]
        found = answer(table, requests, min_contrast_db=-99.0)
        if found.promised_worst_db < 6.0:
            crowded += 1
            for gain_db in (-1.0, -3.0, -7.0):
                lowered = with_gains(table, found, np.full(4, gain_db))
                assert lowered.promised_worst_db == pytest.approx(found.promised_worst_db, abs=1e-4)
    assert crowded > 2


@pytest.mark.parametrize("modulation", [10.0, 30.0])
def test_promise_of_a_modulated_content_is_kept(table, modulation):
    """On nine of ten plates that the search has not seen, side bands added by powers."""
    kept, levels = [], []
    for number, places in enumerate(contact_sets(6, fingers=3, seed=4)):
        requests = [wants(at, level_db_sl=12.0) for at in places[:2]]
        fingers = [Finger(places[2])]
        found = answer(table, [modulated(each, modulation) for each in requests], fingers)
        plates = draw_plates(
            np.random.default_rng(number),
            table.uncertainty,
            of=table,
            count=150,
            contact_count=3,
        )
        each = [
            [powers(table, tones, places, plates) for tones in (one.excitation, *one.side_bands)]
            for one in found.layers
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
        levels.append((20 * np.log10(own[0]) >= found.fingers[0].promised_level_db_sl).mean())
    assert len(kept) >= 4
    assert 0.84 <= np.mean(kept) <= 0.96
    assert 0.84 <= np.mean(levels) <= 0.96


def test_side_bands_lie_evenly_about_the_carrier_at_half_its_amplitude(table):
    """Full modulation: half of the carrier's amplitude at the finger each, 1.8 dB more in all."""
    requests = [wants((0.126, 0.081), level_db_sl=14.0), wants((0.234, 0.049))]
    plain = answer(table, requests)
    found = answer(table, [modulated(requests[0], 20.0), requests[1]])
    layer = found.layers[0]
    carrier = layer.frequency
    sides = sides_of(layer)
    assert sides == pytest.approx([carrier - 20.0, carrier + 20.0])
    assert abs(carrier - found.layers[1].frequency) >= 30
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
    assert (
        14.0 - 0.1 <= found.fingers[0].promised_level_db_sl <= 15.0
    )  # errors of three tones differ
    assert found.layers[1].excitation == plain.layers[1].excitation
    assert found.layers[1].side_bands == ()


def test_side_bands_of_their_own_leak_less_than_those_of_the_carrier(table):
    """At the same weights 20 Hz of modulation cost 5 dB and more, at their own at most 3."""
    lost = []
    for places in contact_sets(6, fingers=2, seed=7):
        requests = [wants(at, level_db_sl=12.0) for at in places]
        plain = answer(table, requests)
        found = answer(table, [modulated(requests[0], 20.0), requests[1]])
        if found.layers[0].side_bands:
            lost.append(plain.promised_worst_db - found.promised_worst_db)
    assert len(lost) >= 4
    assert np.median(lost) < 3.0


def test_a_modulation_is_left_out_where_a_finger_would_feel_too_much(table):
    """Its bound for others' contents holds for side bands, too; no side bands beyond the table."""
    quiet = Finger((0.16, 0.20))
    requests = [wants((0.09, 0.07), level_db_sl=12.0, modulation_hz=30.0)]
    found = answer(table, requests, [quiet])
    assert found.layers[0].side_bands
    assert found.applied == ()
    bounded = Finger(quiet.at, max_foreign_db_sl=found.fingers[1].foreign_level_db_sl - 0.1)
    low = wants((0.09, 0.07), (40.0, 50.0), 12.0, modulation_hz=30.0)
    for steady in (answer(table, requests, [bounded]), answer(table, [low], [quiet])):
        assert steady.layers[0].excitation
        assert not steady.layers[0].side_bands
        assert len(steady.applied) == 1


def test_a_modulation_is_left_out_where_its_own_finger_would_have_too_little_contrast(table):
    """A content alone, beside a quiet finger, that asks for what it has steady, less 0.1 dB."""
    request, quiet = wants((0.126, 0.081), level_db_sl=12.0), Finger((0.234, 0.049))
    plain = answer(table, [request], [quiet])
    found = answer(table, [modulated(request, 20.0)], [quiet])
    assert found.layers[0].side_bands
    assert found.promised_worst_db < plain.promised_worst_db - 0.1
    asks = replace(request, min_contrast_db=plain.promised_worst_db - 0.1)
    steady = answer(table, [modulated(asks, 20.0)], [quiet])
    assert steady.promised_worst_db == plain.promised_worst_db
    assert not steady.layers[0].side_bands


def test_fingers_that_share_or_are_held_back_feel_side_bands_too(table):
    """What they say of others' contents nine of ten unseen plates keep; their bounds hold."""
    shares = [
        wants((0.296, 0.177), name="a"),
        wants((0.241, 0.174), name="a"),
        wants((0.182, 0.21)),
    ]
    held = [
        wants((0.042, 0.184), priority=1),
        wants((0.089, 0.108), priority=1),
        wants((0.242, 0.085), max_foreign_db_sl=8.0),
    ]
    for requests, verdict in ((shares, "shared"), (held, "held back")):
        plain = answer(table, requests)
        (finger,) = (n for n, each in enumerate(plain.fingers) if each.verdict == verdict)
        own = plain.fingers[finger].layer
        other = next(n for n, each in enumerate(plain.fingers) if each.layer not in (None, own))
        requests[other] = modulated(requests[other], 20.0)
        found = answer(table, requests)
        said = found.fingers[finger].foreign_level_db_sl
        assert found.fingers[finger].verdict == verdict
        assert found.layers[found.fingers[other].layer].side_bands
        places = [each.at for each in requests]
        plates = draw_plates(
            np.random.default_rng(1), table.uncertainty, of=table, count=200, contact_count=3
        )
        tones = [
            tones
            for each in found.layers
            if finger not in each.fingers
            for tones in (each.excitation, *each.side_bands)
        ]
        power = sum(powers(table, each, places, plates)[0][finger] for each in tones)
        level = 10 * np.log10(power.max(axis=0))
        assert 0.82 <= (level <= said).mean() <= 0.97
        requests[finger] = replace(requests[finger], max_foreign_db_sl=said - 0.1)
        assert not any(each.side_bands for each in answer(table, requests).layers)


@pytest.mark.parametrize("modulation", [15.0, 25.0])
def test_a_modulation_between_two_steps_of_the_table_plays_the_nearest(table, modulation):
    """At steps of 10 Hz 15 are 10 or 20 and 25 are 20 or 30, the same on both sides."""
    requests = [wants((0.126, 0.081), (150.0, 200.0)), wants((0.234, 0.049), (290.0, 320.0))]
    found = answer(table, [modulated(requests[0], modulation), requests[1]])
    carrier, (low, high) = found.layers[0].frequency, sides_of(found.layers[0])
    assert carrier - low == pytest.approx(high - carrier)
    assert abs(high - carrier - modulation) == pytest.approx(5.0)


def test_side_bands_stay_within_what_amplifiers_play(table):
    """At the lowest frequency of 100 Hz a carrier needs 120 Hz, else it is steady."""
    requests = [wants((0.126, 0.081), (100.0, 110.0), modulation_hz=20.0)]
    fingers = [Finger((0.234, 0.049))]
    assert answer(table, requests, fingers).layers[0].side_bands
    assert not answer(table, requests, fingers, limits=Limits((100.0, 300.0))).layers[0].side_bands


@pytest.mark.parametrize("modulation", [20.0, 30.0])
def test_all_tones_of_two_contents_are_apart(table, modulation):
    """By 30 Hz, side bands of one and carrier and side bands of the other, where any is."""
    gaps = []
    for places in contact_sets(8, fingers=2, seed=7):
        found = answer(table, [wants(at, modulation_hz=modulation) for at in places])
        if any(each.side_bands for each in found.layers):
            one, other = ([each.frequency, *sides_of(each)] for each in found.layers)
            gaps.append(min(abs(a - b) for a in one for b in other))
    assert len(gaps) >= 4
    assert min(gaps) >= 30.0


@pytest.mark.parametrize("priorities", [[1], [1, 1], [1, 2]])
def test_side_bands_are_within_the_stroke(table, priorities):
    """At their peaks the amplitudes of all tones of an ERA add up to its stroke at most."""
    places = contact_sets(1, fingers=3, seed=4)[0]
    requests = [
        wants(at, level_db_sl=40.0, priority=priority, modulation_hz=10.0)
        for at, priority in zip(places[:2], priorities, strict=False)
    ]
    others = [Finger(at) for at in places[len(requests) :]]
    found = answer(table, requests, others, min_contrast_db=-99.0)
    assert any(layer.side_bands for layer in found.layers)
    stroke = dict.fromkeys(table.full_levels, 0.0)
    for layer in found.layers:
        for name, tone in chain(
            *(tones.items() for tones in (layer.excitation, *layer.side_bands))
        ):
            stroke[name] += tone.amplitude / table.full_levels[name]
    assert max(stroke.values()) == pytest.approx(1.0, abs=1e-5)
    levels = [felt.promised_level_db_sl for felt in found.fingers[: len(requests)]]
    assert found.stroke_factor == pytest.approx(10 ** ((min(levels) - 40.0) / 20), rel=1e-4)
    assert "is lowered to" in found.applied[-1]
