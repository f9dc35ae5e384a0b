"""Answers: several contents at once, fingers that give way, and modulation, by exact plates."""

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from kit.plates import SMALL_TABLE_HZ, contact_sets, realised, smooth_rig, smooth_table
from kit.set_table import drives, only, wants
from kit.set_table import phased as answer
from model.answer.answer import NO_LIMITS, Limits
from model.answer.answer_report import query_one
from model.answer.plan import answer as answer_by_table
from model.answer.plan import prepare_answers
from model.answer.promise import felt_amplitudes, loudest_power
from model.answer.stimulus import NEVER, Finger, Placement, Stimulus
from model.errors import InputError
from model.finger import detection_threshold
from model.structure.fingertips import HAND_PATCHES, HAND_STD
from model.study.exact_plates import Plates, draw_plates
from model.table.table_file import build_table
from registry.limits import HAND_LOAD

NEAR, FAR, THIRD, FOURTH = (0.09, 0.07), (0.25, 0.18), (0.05, 0.19), (0.24, 0.06)
QUIET = (0.16, 0.20)


def as_modeled(fingers):
    """The nominal plate, with so many fingers."""
    one = np.ones(1)
    return Plates(
        one,
        one,
        one,
        np.ones((1, 4)),
        np.ones((1, fingers)),
        np.ones((1, 4)),
        np.zeros((1, fingers)),
        one,
        np.zeros((1, 4, 2)),
        np.zeros((1, 4)),
        np.ones((1, 0)),
    )


@pytest.mark.parametrize(
    ("contents", "other"),
    [
        (3, Finger(QUIET)),
        # What asks for nothing is counted and not protected; it may also lie where one feels.
        (2, Finger((0.17, 0.13), is_protected=False)),
        (2, Finger((NEAR[0] + 0.003, NEAR[1]), is_protected=False)),
    ],
    ids=["quiet", "asks for nothing", "beside a target"],
)
def test_figures_as_modeled_are_those_of_the_exact_plate(contents, other):
    """Levels and contrasts without errors, at fingers with a content, quiet ones and others."""
    table, own = smooth_table(), (NEAR, FAR, THIRD)[:contents]
    found = answer(table, [wants(at) for at in own], [other], min_contrast_db=-99)
    lying = {} if other.is_protected else {"resting": [other.at]}
    exact = realised(table, found, as_modeled(contents + 1), **lying)
    contrasts, levels = exact.contrast[:, 0].tolist(), exact.own[:contents, 0]
    expected = contrasts if other.is_protected else [*contrasts[:contents], None]
    assert [each.contrast_db for each in found.fingers] == pytest.approx(expected, abs=0.02)
    assert [each.level_db_sl for each in found.fingers[:contents]] == pytest.approx(
        levels, abs=0.02
    )


HAND = (0.17, 0.13)


def test_a_hand_that_rests_is_counted_and_not_protected():
    """Beside four patches 25 mm apart, a quarter of twelve fingertips each, solved exactly.

    Its weight costs contrast, which is promised, and nine of ten plates keep it, though the load of
    each patch is known within a factor of three; without it they do not.
    """
    table, patches = smooth_table(), [(HAND[0] + x, HAND[1] + y) for x, y in HAND_PATCHES]
    fingers = [wants(NEAR, level_db_sl=12), wants(FAR, level_db_sl=12)]
    lying = {"resting": patches, "loads": (1.0, 1.0, *(HAND_LOAD,) * 4)}
    found = answer(table, fingers, [Finger(HAND, load=HAND_LOAD)], min_contrast_db=-99)
    nominal = realised(table, found, as_modeled(6), **lying).contrast[:2, 0]
    assert [each.contrast_db for each in found.fingers[:2]] == pytest.approx(nominal, abs=0.02)
    assert found.fingers[2].foreign_level_db_sl is found.fingers[2].contrast_db is None
    rng = np.random.default_rng(3)
    plates = draw_plates(rng, table.uncertainty, of=table, count=300, contact_count=6)
    pressed = np.exp(HAND_STD * rng.standard_normal((300, 4)))
    plates = replace(plates, load=np.concatenate([plates.load[:, :2], pressed], axis=1))
    unaware = answer(table, fingers, min_contrast_db=-99)
    kept = [
        realised(table, each, plates, **lying).contrast[:2].min(axis=0) >= each.promised_worst_db
        for each in (found, unaware)
    ]
    assert 0.84 <= kept[0].mean() <= 0.97
    assert kept[1].mean() < 0.8
    stds = table.attached.load_stds(2, (1.0, HAND_LOAD))
    assert stds.tolist() == pytest.approx([table.uncertainty.fingertip, np.log(3)], rel=0.01)


def test_drive_mode_of_the_table_is_obeyed():
    """Amplifiers that only switch get ERAs at full stroke, as one finger's query; or a refusal."""
    table = replace(smooth_table(), drive_mode="switched")
    requests, others = [wants(NEAR, level_db_sl=15.0)], [Finger(FAR)]
    (layer,) = answer_by_table(table, requests, quiet=others).layers
    (phased,) = answer(table, requests, others).layers
    assert layer.excitation == only(table, Placement((NEAR,), (FAR,)), 15.0)[0].excitation
    assert len(layer.excitation) <= 2 < len(phased.excitation)
    assert len({tone.amplitude for tone in layer.excitation.values()}) == 1
    with pytest.raises(InputError, match="phased"):
        answer_by_table(table, [wants(NEAR), wants(FAR)])
    shared = [wants(at, name="a") for at in TWENTY[:6]]  # one from the start
    assert answer_by_table(table, shared).fingers[-1].verdict == "shared"


def test_frequencies_are_apart_and_within_their_bands():
    """Bands hold; bands that may be exchanged are each taken once, for a contrast no worse.

    Where they leave no choice, it is said that two contents are near.
    """
    table, bands = smooth_table(), ((40, 110), (140, 190), (230, 320))
    requests = [wants(at, band) for at, band in zip((NEAR, FAR, THIRD), bands, strict=True)]
    kept = answer(table, requests, min_contrast_db=-99)
    swapped = answer(table, requests, bands_may_swap=True, min_contrast_db=-99)
    free = answer(table, [wants(at) for at in (NEAR, FAR, THIRD)], apart_hz=60, min_contrast_db=-99)
    kept_hz, swapped_hz, free_hz = (
        [each.frequency for each in found.layers] for found in (kept, swapped, free)
    )
    for order in (kept_hz, sorted(swapped_hz)):
        assert all(low <= f <= high for f, (low, high) in zip(order, bands, strict=True))
    assert swapped.promised_worst_db > kept.promised_worst_db
    assert np.diff(sorted(free_hz)).min() >= 60
    near = answer(table, [wants(at, (90, 95)) for at in (NEAR, FAR)])
    assert "closer than 30 Hz" in near.applied[0]


@pytest.mark.parametrize("duration", [None, 0.04])
def test_what_plays_already_is_kept_away_from(duration):
    """By 30 Hz, short or not: as on a table without the nearer ones; else it is said.

    What is promised is that of a band of the one frequency.
    """
    table, own = smooth_table(), Finger(NEAR, Stimulus(20, (60, 300), duration))

    def within(low, high):
        return replace(own, stimulus=replace(own.stimulus, band_hz=(low, high)))

    avoided = answer(table, [own], [FAR]).layers[0].frequency
    found = answer(table, [own], [FAR], avoided_hz=[avoided])
    left = SMALL_TABLE_HZ[np.abs(SMALL_TABLE_HZ - avoided) >= 30]
    expected = answer(build_table(smooth_rig(), frequencies=left), [own], [FAR])
    f = found.layers[0].frequency
    assert f == expected.layers[0].frequency
    promised = answer(table, [within(f, f)], [FAR]).promised_worst_db
    assert found.promised_worst_db == pytest.approx(promised, abs=0.01)
    near = answer(table, [within(avoided - 5, avoided + 5)], [FAR], avoided_hz=[avoided])
    assert (near.layers[0].frequency, len(near.applied)) == (avoided, 1)


def test_contents_of_one_frequency_may_meet_in_phase():
    """At a finger, amplitudes of one frequency add, powers of two: 3, 4 and 12 make 7² + 12².

    Powers of second harmonics add to these.
    """
    power = np.array([3.0, 12.0, 4.0])[:, None, None, None] ** 2
    harmonics = np.array([2.0, 3.0, 0.5])[:, None, None]
    assert loudest_power(power, 0 * harmonics, np.array([5, 2, 5]), 0) == pytest.approx(193)
    assert loudest_power(power, harmonics, np.array([5, 2, 5]), 0) == pytest.approx(198.5)


def test_a_tone_of_the_same_frequency_may_cancel_part_of_ones_own():
    """At two points of amplitude 5 and 2, beside 3 of another content: 2 and 0, 1 in the mean."""
    power = np.array([[5.0, 2.0], [3.0, 3.0], [4.0, 4.0]])[:, None, :, None] ** 2
    weights = np.full((1, 2), 0.5, dtype=np.float32)
    first = np.array([True, False, False])
    for rows, felt in (([7, 7, 8], 1.0), ([7, 6, 8], 3.5)):
        found = felt_amplitudes(power, weights, np.array(rows), first, (0,))
        assert found == pytest.approx(felt)
    # Of two tones of one's own, the second beside none: at both points 5 and 2, with 4 each.
    both = felt_amplitudes(power, weights, np.array([7, 6, 8]), np.array([True, False, True]), (0,))
    assert both == pytest.approx((41**0.5 + 20**0.5) / 2)


def test_two_fingers_that_share_and_no_other_are_served():
    """So near that no contents of their own reach 6 dB: there is nobody to be quiet at."""
    requests = [wants(at, may_share=True) for at in ((0.16, 0.06), (0.19, 0.06))]
    found = answer(smooth_table(), requests)
    assert "shares" in found.applied[-1]
    assert min(felt.promised_level_db_sl for felt in found.fingers) > 19.9
    assert {felt.promised_contrast_db for felt in found.fingers} == {None}


def test_what_is_held_back_is_null_in_json_and_what_has_little_contrast_is_said():
    """A higher priority takes the whole stroke: JSON has no infinity.

    At a level that leaves a quiet finger more than 6 dB nothing is changed but said.
    """
    own = [{"at": NEAR, "level_db_sl": 60.0, "priority": 1}, {"at": FAR, "level_db_sl": 12.0}]
    held = query_one(smooth_table(), {"own": own, "mode": "phased"})
    assert held["fingers"][1]["verdict"] == "held back"
    json.dumps(held, allow_nan=False)
    found = answer(smooth_table(), [wants(NEAR)], [Finger(QUIET)], min_contrast_db=99)
    assert found.promised_worst_db < 99
    assert ["99" in each for each in found.applied] == [True]


def test_levels_share_the_stroke_by_one_factor_and_by_priority():
    """No ERA beyond its stroke; equals lose as much, a higher priority loses nothing."""
    table = smooth_table()
    equal = answer(table, [wants(at, level_db_sl=52) for at in (NEAR, FAR)], min_contrast_db=-99)
    lost = [52 - each.promised_level_db_sl for each in equal.fingers]
    assert lost[0] == pytest.approx(lost[1], abs=1e-3)
    assert lost[0] == pytest.approx(-20 * np.log10(equal.stroke_factor), abs=1e-3)
    assert lost[0] > 0.5
    first = answer(
        table,
        [wants(NEAR, level_db_sl=45), wants(FAR, level_db_sl=52, priority=1)],
        min_contrast_db=-99,
    )
    for found in (equal, first):
        for era in table.eras:
            tones = [each.excitation[era.name].amplitude for each in found.layers]
            assert sum(tones) <= era.stroke * (1 + 1e-6)
    assert 52 - first.fingers[1].promised_level_db_sl < lost[1]


def test_a_louder_content_does_not_starve_a_softer_one():
    """It is lowered first: the softer keeps its level, at least as long as it is the softer."""
    table, soft = smooth_table(), 12.0
    requests = [wants(NEAR, level_db_sl=60), wants(FAR, level_db_sl=soft)]
    found = answer(table, requests, min_contrast_db=-99)
    loud = found.fingers[0].promised_level_db_sl
    assert soft < loud < 60 - 0.5
    assert [f"{loud:.1f} dB SL" in each for each in found.applied] == [True]
    assert found.fingers[1].promised_level_db_sl == pytest.approx(soft, abs=1e-3)
    assert found.stroke_factor == pytest.approx(10 ** ((loud - 60) / 20), rel=1e-3)
    full = [
        sum(each.excitation[era.name].amplitude for each in found.layers) / era.stroke
        for era in table.eras
    ]
    assert max(full) == pytest.approx(1.0, abs=1e-5)
    # Two that both must be lowered end at one level.
    requests = [wants(NEAR, level_db_sl=57), wants(FAR, level_db_sl=54)]
    found = answer(table, requests, min_contrast_db=-99)
    felt = [each.promised_level_db_sl for each in found.fingers]
    assert felt[0] == pytest.approx(felt[1], abs=1e-3)
    assert felt[0] < 53.5


def test_fingers_that_may_share_feel_one_content():
    """The nearest two of those that may; all others keep their own.

    Fingers whose contents have one name share, and no others: of two pairs of names the nearer pair
    shares, though the third finger is between them.
    """
    places = ((0.09, 0.07), (0.14, 0.08), (0.25, 0.18), (0.05, 0.19))
    requests = [
        wants(at, may_share=at in places[:3], priority=int(at == places[1])) for at in places
    ]
    found = answer(smooth_table(), requests, min_contrast_db=3.7)
    assert found.fingers[0].verdict == "shared"
    assert drives(found)[0] == drives(found)[1]
    assert drives(found)[2] != drives(found)[1]
    assert "shares" in found.applied[0]

    places = ((0.09, 0.07), (0.14, 0.08), (0.11, 0.12), (0.25, 0.18))
    requests = [wants(at, name=name) for at, name in zip(places, ["low", "high"] * 2, strict=True)]
    every = answer(smooth_table(), requests, min_contrast_db=-99)
    found = answer(smooth_table(), requests, min_contrast_db=every.promised_worst_db + 0.1)
    assert "shared" in {found.fingers[0].verdict, found.fingers[2].verdict}
    assert drives(found)[2] == drives(found)[0]
    assert drives(found)[1] != drives(found)[3]


TWENTY = [(0.025 + 0.06 * x, 0.03 + 0.055 * y) for x in range(5) for y in range(4)]


def test_twenty_fingers_take_little_memory(without_kernels):
    """In numpy, whose arrays are counted: less than a table, though the level is out of reach."""
    without_kernels()
    table = smooth_table()
    prepare_answers(table)
    tracemalloc.start()
    answer(table, [wants(at, name="a", level_db_sl=60.0) for at in TWENTY])
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()


def test_what_is_to_be_own_is_own_or_makes_contents_give_way():
    """With 12 dB or held back, whichever priority is lower; what 6 dB suffice for is mixed."""
    table, places = smooth_table(), (NEAR, FAR, THIRD)
    mixed = answer(table, [wants(at) for at in places])
    assert {each.verdict for each in mixed.fingers} >= {"mixed"}
    for priority, verdict in ((1, "own"), (-1, "held back")):
        requests = [
            wants(at, min_contrast_db=12.0, priority=priority) if at == THIRD else wants(at)
            for at in places
        ]
        found = answer(table, requests)
        assert found.fingers[2].verdict == verdict
        assert "held back" in {each.verdict for each in found.fingers}


def test_a_finger_that_must_not_be_disturbed_is_not():
    """Contents that leak more than it allows are held back, to the last; quieter ones are not."""
    table = smooth_table()
    played = answer(table, [wants(NEAR)], [Finger(QUIET)])
    leak = played.fingers[1].foreign_level_db_sl
    for bound, verdict in ((leak + 0.1, "own"), (leak - 0.1, "held back")):
        found = answer(table, [wants(NEAR)], [Finger(QUIET, max_foreign_db_sl=bound)])
        assert found.fingers[0].verdict == verdict
        assert found.fingers[1].foreign_level_db_sl <= bound
    requests = [wants(NEAR, priority=-1, max_foreign_db_sl=-30.0), wants(FAR)]
    found = answer(table, requests)
    assert [each.verdict for each in found.fingers] == ["own", "held back"]


def test_the_lowest_priority_is_held_back():
    """With the contrast that it would have had, and the level of the others there.

    A content that is left alone keeps its band: that of the one held back is not its own.
    """
    requests = [wants(at, priority=int(at != FAR)) for at in (NEAR, FAR, THIRD, FOURTH)]
    every = answer(smooth_table(), requests, min_contrast_db=-99)
    found = answer(smooth_table(), requests, min_contrast_db=every.promised_worst_db + 0.1)
    held = found.fingers[1]
    assert held.verdict == "held back"
    assert held.layer is None
    assert held.promised_contrast_db == every.fingers[1].promised_contrast_db
    assert held.foreign_level_db_sl < 20
    assert sorted(each.layer for each in found.fingers if each is not held) == [0, 1, 2]

    banded = wants(NEAR, (470, 500)), wants(FAR, (40, 320), priority=-1)
    requests = [replace(each, sharing=NEVER) for each in banded]
    alone = answer(smooth_table(), requests, min_contrast_db=99)
    assert alone.fingers[1].verdict == "held back"
    assert {470 <= tone.frequency <= 500 for tone in drives(alone)[0].values()} == {True}


def test_a_finger_without_protection_gives_way_to_more_contrast():
    """The others have more than where the finger is kept quiet."""
    first, second, third = (wants(at, priority=int(at != THIRD)) for at in (NEAR, FAR, THIRD))
    alone, beside = (
        answer(
            smooth_table(),
            [first, second, replace(third, is_protected=is_protected)],
            min_contrast_db=9.0,
        )
        for is_protected in (False, True)
    )
    assert alone.fingers[2].verdict == beside.fingers[2].verdict == "held back"
    assert alone.promised_worst_db > beside.promised_worst_db + 1


@pytest.fixture(scope="module")
def table():
    """The paper's plate at 29 frequencies, 10 Hz apart; ERAs move without harmonics."""
    rig = smooth_rig()
    known = replace(rig.uncertainty, modulus=0.0, place=0.0, harmonic=0.0)
    return build_table(replace(rig, uncertainty=known), frequencies=np.linspace(40.0, 320.0, 29))


def modulated(finger, modulation):
    """The finger with a modulation [Hz]."""
    return replace(finger, stimulus=replace(finger.stimulus, modulation_hz=modulation))


def sides_of(layer):
    """Frequencies of a layer's side bands."""
    return sorted(next(iter(tones.values())).frequency for tones in layer.side_bands)


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


def test_a_modulation_is_left_out_where_a_finger_would_feel_too_much(table):
    """Its bound for others' contents holds for side bands, too; no side bands beyond the table.

    Nor where its own finger would have too little contrast: a content alone, beside a quiet finger,
    that asks for what it has steady, less 0.1 dB.
    """
    quiet = Finger((0.16, 0.20))
    requests = [wants((0.09, 0.07), level_db_sl=12.0, modulation_hz=30.0)]
    found = answer(table, requests, [quiet])
    assert found.layers[0].side_bands
    assert found.applied == ()
    bounded = replace(quiet, max_foreign_db_sl=found.fingers[1].foreign_level_db_sl - 0.1)
    low = wants((0.09, 0.07), (40.0, 50.0), 12.0, modulation_hz=30.0)
    for steady in (answer(table, requests, [bounded]), answer(table, [low], [quiet])):
        assert steady.layers[0].excitation
        assert not steady.layers[0].side_bands
        assert len(steady.applied) == 1

    request, quiet = wants((0.126, 0.081), level_db_sl=12.0), Finger((0.234, 0.049))
    plain, found = (answer(table, [each], [quiet]) for each in (request, modulated(request, 20.0)))
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
        plates = draw_plates(
            np.random.default_rng(1), table.uncertainty, of=table, count=200, contact_count=3
        )
        level = realised(table, found, plates).foreign[finger]
        assert 0.82 <= (level <= said).mean() <= 0.97
        requests[finger] = replace(requests[finger], max_foreign_db_sl=said - 0.1)
        assert not any(each.side_bands for each in answer(table, requests).layers)


def test_a_modulation_between_two_steps_of_the_table_plays_the_nearest(table):
    """At steps of 10 Hz 15 are 10 or 20 and 25 are 20 or 30, the same on both sides.

    Side bands stay within what amplifiers play: at the lowest frequency of 100 Hz a carrier needs
    120 Hz, else it is steady.
    """
    request, other = wants((0.126, 0.081), (150.0, 200.0)), wants((0.234, 0.049), (290.0, 320.0))
    for modulation in (15.0, 25.0):
        (layer, _) = answer(table, [modulated(request, modulation), other]).layers
        low, high = sides_of(layer)
        assert layer.frequency - low == pytest.approx(high - layer.frequency)
        assert abs(high - layer.frequency - modulation) == pytest.approx(5.0)
    low = wants((0.126, 0.081), (100.0, 110.0), modulation_hz=20.0)
    for limits, count in ((NO_LIMITS, 2), (Limits((100.0, 300.0)), 0)):
        (layer,) = answer(table, [low], [Finger((0.234, 0.049))], limits=limits).layers
        assert len(layer.side_bands) == count


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
    tones = [each for layer in found.layers for each in (layer.excitation, *layer.side_bands)]
    shares = [
        sum(each[name].amplitude for each in tones if name in each) / full
        for name, full in table.full_levels.items()
    ]
    assert max(shares) == pytest.approx(1.0, abs=1e-5)
    levels = [felt.promised_level_db_sl for felt in found.fingers[: len(requests)]]
    assert found.stroke_factor == pytest.approx(10 ** ((min(levels) - 40.0) / 20), rel=1e-4)
    assert "is lowered to" in found.applied[-1]
