"""Answers: several contents at once, fingers that give way, and modulation, by exact plates."""

import tracemalloc
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from kit.plates import SMALL_TABLE_HZ, contact_sets, realised, smooth_rig, smooth_table
from kit.set_table import drives, only, phased, wants
from model.answer.answer import NO_LIMITS, Answer, Layer, Limits
from model.answer.plan import answer, prepare_answers
from model.answer.promise import felt_amplitudes, loudest_power
from model.answer.stimulus import Finger, Placement, Stimulus
from model.arrays import FloatArray
from model.errors import InputError
from model.finger import detection_threshold
from model.structure.fingertips import HAND_PATCHES, HAND_STD
from model.study.exact_plates import Plates, draw_plates
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from registry.limits import HAND_LOAD

NEAR = (0.09, 0.07)
FAR = (0.25, 0.18)
THIRD = (0.05, 0.19)
FOURTH = (0.24, 0.06)
QUIET = (0.16, 0.20)
TWENTY = [(0.025 + 0.06 * x, 0.03 + 0.055 * y) for x in range(5) for y in range(4)]


def verdicts_of(served: Answer) -> list[str]:
    """Return the verdict of each finger."""
    return [sensation.verdict for sensation in served.fingers]


def promised_levels(served: Answer) -> list[float]:
    """Return the promised level of each finger [dB SL]."""
    return [sensation.promised_level_db_sl for sensation in served.fingers]


def shares_of_stroke(served: Answer, table: LocalizationTable) -> dict[str, float]:
    """Return the sum of the amplitudes of all tones of each ERA, relative to its full level."""
    shares = dict.fromkeys(table.full_levels, 0.0)
    for layer in served.layers:
        for tones in (layer.excitation, *layer.side_bands):
            for name, tone in tones.items():
                shares[name] += tone.amplitude / table.full_levels[name]
    return shares


# Figures


def nominal_plate(contact_count: int) -> Plates:
    """Return the plate without errors, for so many contacts."""
    scalar = np.ones(1)
    eras = np.ones((1, 4))
    contacts = np.ones((1, contact_count))
    return Plates(
        scalar,
        scalar,
        scalar,
        eras,
        contacts,
        eras,
        0 * contacts,
        scalar,
        np.zeros((1, 4, 2)),
        0 * eras,
        np.ones((1, 0)),
    )


@pytest.mark.parametrize(
    ("content_count", "neighbor"),
    [
        (3, Finger(QUIET)),
        (2, Finger((0.17, 0.13), is_protected=False)),
        (2, Finger((NEAR[0] + 0.003, NEAR[1]), is_protected=False)),
    ],
    ids=["quiet", "unprotected", "unprotected at a target"],
)
def test_nominal_figures_are_those_of_the_exact_plate(content_count: int, neighbor: Finger) -> None:
    """Levels and contrasts without errors, at fingers with a content, quiet ones and others.

    An unprotected finger is counted; it can also be at a target.
    """
    table = smooth_table()
    fingers = [wants(place) for place in (NEAR, FAR, THIRD)[:content_count]]

    served = phased(table, fingers, [neighbor], min_contrast_db=-99)

    resting = [] if neighbor.is_protected else [neighbor.at]
    exact = realised(table, served, nominal_plate(content_count + 1), resting=resting)
    contrasts = exact.contrast[:, 0].tolist()
    if not neighbor.is_protected:
        contrasts[-1] = None
    levels = exact.own[:content_count, 0].tolist()
    sensations = served.fingers
    assert [sensation.contrast_db for sensation in sensations] == pytest.approx(contrasts, abs=0.02)
    own = sensations[:content_count]
    assert [sensation.level_db_sl for sensation in own] == pytest.approx(levels, abs=0.02)


HAND = (0.17, 0.13)


def test_resting_hand_is_counted_and_not_protected() -> None:
    """Next to four patches 25 mm apart, a quarter of twelve fingertips each, solved exactly.

    Its weight costs contrast, which is promised, and 90 % of plates keep it, though the load of
    each patch is known within a factor of three; an answer without the hand does not.
    """
    table = smooth_table()
    fingers = [wants(NEAR, level_db_sl=12), wants(FAR, level_db_sl=12)]
    patches = [(HAND[0] + x, HAND[1] + y) for x, y in HAND_PATCHES]
    loads = (1.0, 1.0, *[HAND_LOAD] * 4)

    served = phased(table, fingers, [Finger(HAND, load=HAND_LOAD)], min_contrast_db=-99)
    unaware = phased(table, fingers, min_contrast_db=-99)

    exact = realised(table, served, nominal_plate(6), resting=patches, loads=loads)
    contrasts = [sensation.contrast_db for sensation in served.fingers]
    assert contrasts == pytest.approx([*exact.contrast[:2, 0], None], abs=0.02)
    assert served.fingers[2].foreign_level_db_sl is None
    rng = np.random.default_rng(3)
    plates = draw_plates(rng, table.uncertainty, of=table, count=300, contact_count=6)
    pressed = np.exp(HAND_STD * rng.standard_normal((300, 4)))
    plates = replace(plates, load=np.hstack([plates.load[:, :2], pressed]))
    shares = []
    for promised in (served, unaware):
        drawn = realised(table, promised, plates, resting=patches, loads=loads)
        worst = drawn.contrast[:2].min(axis=0)
        shares.append(np.mean(worst >= promised.promised_worst_db))
    assert 0.84 <= shares[0] <= 0.97
    assert shares[1] < 0.8


def test_contents_of_one_frequency_may_meet_in_phase() -> None:
    """At a finger, amplitudes of one frequency add, powers of two: 3, 4 and 12 make 7² + 12².

    Powers of second harmonics add to these.
    """
    power = np.array([3.0, 12.0, 4.0])[:, None, None, None] ** 2
    harmonics = np.array([2.0, 3.0, 0.5])[:, None, None]
    rows = np.array([5, 2, 5])

    assert loudest_power(power, 0 * harmonics, rows, 0) == pytest.approx(193)
    assert loudest_power(power, harmonics, rows, 0) == pytest.approx(198.5)


@pytest.mark.parametrize(
    ("rows", "own", "amplitude"),
    [
        ([7, 7, 8], [True, False, False], (2 + 0) / 2),
        ([7, 6, 8], [True, False, False], (5 + 2) / 2),
        ([7, 6, 8], [True, False, True], (41**0.5 + 20**0.5) / 2),
    ],
    ids=["one frequency", "two frequencies", "two own tones"],
)
def test_tone_of_the_same_frequency_may_cancel_part_of_the_own(
    rows: list[int], own: list[bool], amplitude: float
) -> None:
    """At two points of amplitude 5 and 2, next to 3 of another content; own tones add powers."""
    power = np.array([[5.0, 2.0], [3.0, 3.0], [4.0, 4.0]])[:, None, :, None] ** 2
    weights = np.full((1, 2), 0.5, dtype=np.float32)

    felt = felt_amplitudes(power, weights, np.array(rows), np.array(own), (0,))

    assert felt == pytest.approx(amplitude)


# Frequencies


def test_drive_mode_of_the_table_is_obeyed() -> None:
    """Amplifiers that only switch get ERAs at full stroke, as for a query; or an error."""
    table = replace(smooth_table(), drive_mode="switched")
    fingers = [wants(NEAR, level_db_sl=15.0)]

    (layer,) = answer(table, fingers, quiet=[FAR]).layers
    shared = answer(table, [wants(place, name="a") for place in TWENTY[:6]])

    expected, _ = only(table, Placement((NEAR,), (FAR,)), 15.0)
    assert layer.excitation == expected.excitation
    assert len({tone.amplitude for tone in layer.excitation.values()}) == 1
    (phased_layer,) = phased(table, fingers, [FAR]).layers
    assert len(layer.excitation) <= 2 < len(phased_layer.excitation)
    assert shared.fingers[-1].verdict == "shared"
    with pytest.raises(InputError, match="phased"):
        answer(table, [wants(NEAR), wants(FAR)])


BANDS = ((40, 110), (140, 190), (230, 320))  # Hz


@pytest.mark.parametrize("is_swapped", [False, True])
def test_frequencies_are_within_their_bands(is_swapped: bool) -> None:
    """Bands that can be swapped are used once each."""
    places = (NEAR, FAR, THIRD)
    fingers = [wants(*pair) for pair in zip(places, BANDS, strict=True)]

    served = phased(smooth_table(), fingers, bands_may_swap=is_swapped, min_contrast_db=-99)

    frequencies = [layer.frequency for layer in served.layers]
    if is_swapped:
        fixed = phased(smooth_table(), fingers, min_contrast_db=-99)
        assert served.promised_worst_db > fixed.promised_worst_db
        frequencies.sort()
    for frequency, (low, high) in zip(frequencies, BANDS, strict=True):
        assert low <= frequency <= high


@pytest.mark.parametrize("duration", [None, 0.04])
def test_frequency_that_plays_is_avoided(duration: float | None) -> None:
    """By 30 Hz: as on a table without the nearer ones. If the band leaves no choice, it is used.

    The promise is that of a band of the chosen frequency.
    """

    def finger_within(low: float, high: float) -> Finger:
        return Finger(NEAR, Stimulus(20, (low, high), duration))

    table = smooth_table()
    finger = finger_within(60, 300)
    playing = phased(table, [finger], [FAR]).layers[0].frequency

    served = phased(table, [finger], [FAR], avoided_hz=[playing])
    near = finger_within(playing - 5, playing + 5)
    forced = phased(table, [near], [FAR], avoided_hz=[playing])

    distant = SMALL_TABLE_HZ[np.abs(SMALL_TABLE_HZ - playing) >= 30]
    expected = phased(build_table(smooth_rig(), frequencies=distant), [finger], [FAR])
    frequency = served.layers[0].frequency
    assert frequency == expected.layers[0].frequency
    promised = phased(table, [finger_within(frequency, frequency)], [FAR]).promised_worst_db
    assert served.promised_worst_db == pytest.approx(promised, abs=0.01)
    assert forced.layers[0].frequency == playing
    assert len(forced.applied) == 1


# Levels and strokes


def test_equal_levels_lose_the_same() -> None:
    """No ERA is beyond its stroke; a content of higher priority loses less."""
    table = smooth_table()
    equal = [wants(NEAR, level_db_sl=52), wants(FAR, level_db_sl=52)]
    unequal = [wants(NEAR, level_db_sl=45), wants(FAR, level_db_sl=52, priority=1)]

    lowered = phased(table, equal, min_contrast_db=-99)
    by_priority = phased(table, unequal, min_contrast_db=-99)

    losses = 52 - np.array(promised_levels(lowered))
    assert losses[0] > 0.5
    expected = -20 * np.log10(lowered.stroke_factor)
    np.testing.assert_allclose(losses, expected, atol=1e-3)
    assert 52 - by_priority.fingers[1].promised_level_db_sl < losses[1]
    assert max(shares_of_stroke(lowered, table).values()) <= 1 + 1e-6
    assert max(shares_of_stroke(by_priority, table).values()) <= 1 + 1e-6


def test_twenty_fingers_take_little_memory(without_kernels: Callable[[], None]) -> None:
    """In numpy, whose arrays are counted: less than a table, though the level is out of reach."""
    without_kernels()
    table = smooth_table()
    prepare_answers(table)
    fingers = [wants(place, name="a", level_db_sl=60.0) for place in TWENTY]

    tracemalloc.start()
    phased(table, fingers)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert peak < 50e6


# Fingers that share or are held back


def test_only_contents_of_one_name_are_shared() -> None:
    """Of two pairs of names the nearer pair shares, though the third finger is between them."""
    places = ((0.09, 0.07), (0.14, 0.08), (0.11, 0.12), (0.25, 0.18))
    names = ("low", "high", "low", "high")
    fingers = [wants(place, name=name) for place, name in zip(places, names, strict=True)]
    separate = phased(smooth_table(), fingers, min_contrast_db=-99)

    needed = separate.promised_worst_db + 0.1
    served = phased(smooth_table(), fingers, min_contrast_db=needed)

    verdicts = verdicts_of(served)
    assert "shared" in (verdicts[0], verdicts[2])
    excitations = drives(served)
    assert excitations[2] == excitations[0]
    assert excitations[1] != excitations[3]


@pytest.mark.parametrize(("priority", "verdict"), [(1, "own"), (-1, "held back")])
def test_content_that_needs_12_db_is_own_or_held_back(priority: int, verdict: str) -> None:
    """By its priority; contents that need 6 dB are mixed."""
    first, second = wants(NEAR), wants(FAR)
    demanding = wants(THIRD, min_contrast_db=12.0, priority=priority)

    mixed = phased(smooth_table(), [first, second, wants(THIRD)])
    served = phased(smooth_table(), [first, second, demanding])

    assert "mixed" in verdicts_of(mixed)
    verdicts = verdicts_of(served)
    assert verdicts[2] == verdict
    assert "held back" in verdicts


@pytest.mark.parametrize(("margin", "verdict"), [(0.1, "own"), (-0.1, "held back")])
def test_finger_that_must_not_be_disturbed_is_not(margin: float, verdict: str) -> None:
    """A content that leaks more than the finger allows is held back."""
    table = smooth_table()
    unbounded = phased(table, [wants(NEAR)], [Finger(QUIET)])
    bound = unbounded.fingers[1].foreign_level_db_sl + margin

    served = phased(table, [wants(NEAR)], [Finger(QUIET, max_foreign_db_sl=bound)])

    assert served.fingers[0].verdict == verdict
    assert served.fingers[1].foreign_level_db_sl <= bound


def test_lowest_priority_is_held_back() -> None:
    """Its finger has the contrast that it would have had, and the level of the others there."""
    higher = [wants(place, priority=1) for place in (NEAR, THIRD, FOURTH)]
    fingers = [*higher, wants(FAR)]
    separate = phased(smooth_table(), fingers, min_contrast_db=-99)

    needed = separate.promised_worst_db + 0.1
    served = phased(smooth_table(), fingers, min_contrast_db=needed)

    *others, held_back = served.fingers
    assert held_back.verdict == "held back"
    assert held_back.layer is None
    assert held_back.promised_contrast_db == separate.fingers[3].promised_contrast_db
    assert held_back.foreign_level_db_sl < 20
    assert [sensation.layer for sensation in others] == [0, 1, 2]


# Side bands


@pytest.fixture(scope="module")
def table() -> LocalizationTable:
    """The paper's plate at 29 frequencies, 10 Hz apart; ERAs move without harmonics."""
    rig = smooth_rig()
    known = replace(rig.uncertainty, modulus=0.0, place=0.0, touch_position=0.0, harmonic=0.0)
    return build_table(replace(rig, uncertainty=known), frequencies=np.linspace(40.0, 320.0, 29))


FIRST = (0.126, 0.081)
SECOND = (0.234, 0.049)


def modulated(finger: Finger, modulation: float) -> Finger:
    """Return the finger with a modulation [Hz]."""
    return replace(finger, stimulus=replace(finger.stimulus, modulation_hz=modulation))


def side_frequencies(layer: Layer) -> list[float]:
    """Return the frequencies of a layer's side bands [Hz]."""
    frequencies = set()
    for tones in layer.side_bands:
        frequencies |= {tone.frequency for tone in tones.values()}
    return sorted(frequencies)


def test_side_bands_have_half_the_amplitude_of_the_carrier(table: LocalizationTable) -> None:
    """At the finger, for full modulation; they add up to 1.8 dB, less where tolerances differ.

    On either side of the carrier; the content of another finger stays the same.
    """
    first = wants(FIRST, level_db_sl=14.0)
    second = wants(SECOND)
    steady = phased(table, [first, second])

    served = phased(table, [modulated(first, 20.0), second])

    layer, other_layer = served.layers
    carrier = layer.frequency
    assert side_frequencies(layer) == pytest.approx([carrier - 20.0, carrier + 20.0])
    sensed: list[FloatArray] = []
    for tones in (layer.excitation, *layer.side_bands):
        frequencies, amplitudes = table.amplitudes(
            tones, np.array([FIRST]), contacts=[FIRST, SECOND]
        )
        sensed.append(amplitudes[0, 0] / detection_threshold(frequencies)[0])
    # each is that of 90 % of plates
    assert sensed[1:] == pytest.approx([sensed[0] / 2] * 2, rel=0.2)
    assert 13.9 <= served.fingers[0].promised_level_db_sl <= 15.0
    assert abs(carrier - other_layer.frequency) >= 30
    assert other_layer.excitation == steady.layers[1].excitation
    assert other_layer.side_bands == ()


def test_modulation_is_left_out_if_another_finger_would_feel_too_much(
    table: LocalizationTable,
) -> None:
    """Its bound for crosstalk holds for side bands too; none are beyond the table's frequencies."""
    quiet = Finger(QUIET)
    finger = wants(NEAR, level_db_sl=12.0, modulation_hz=30.0)
    low = wants(NEAR, (40.0, 50.0), 12.0, modulation_hz=30.0)

    free = phased(table, [finger], [quiet])
    bound = free.fingers[1].foreign_level_db_sl - 0.1
    bounded = phased(table, [finger], [replace(quiet, max_foreign_db_sl=bound)])
    at_the_edge = phased(table, [low], [quiet])

    assert free.layers[0].side_bands
    assert free.applied == ()
    for steady in (bounded, at_the_edge):
        assert steady.layers[0].excitation
        assert not steady.layers[0].side_bands
        assert len(steady.applied) == 1


def test_modulation_is_left_out_if_it_costs_a_required_contrast(table: LocalizationTable) -> None:
    """A content that requires its steady contrast less 0.1 dB stays steady."""
    finger = wants(FIRST, level_db_sl=12.0)
    quiet = [Finger(SECOND)]
    steady = phased(table, [finger], quiet)
    contrast = steady.promised_worst_db - 0.1

    free = phased(table, [modulated(finger, 20.0)], quiet)
    demanding = replace(finger, min_contrast_db=contrast)
    served = phased(table, [modulated(demanding, 20.0)], quiet)

    assert free.layers[0].side_bands
    assert free.promised_worst_db < contrast
    assert served.promised_worst_db == steady.promised_worst_db
    assert not served.layers[0].side_bands


SHARING = [
    wants((0.296, 0.177), name="a"),
    wants((0.241, 0.174), name="a"),
    wants((0.182, 0.21)),
]
"""The first two share; the third content is modulated."""
GIVING_WAY = [
    wants((0.042, 0.184), priority=1),
    wants((0.089, 0.108), priority=1),
    wants((0.242, 0.085), max_foreign_db_sl=8.0),
]


@pytest.mark.parametrize(
    ("requests", "verdict"), [(SHARING, "shared"), (GIVING_WAY, "held back")], ids=["share", "wait"]
)
def test_fingers_that_share_or_are_held_back_feel_side_bands(
    table: LocalizationTable, requests: list[Finger], verdict: str
) -> None:
    """Their promised crosstalk is kept by 90 % of plates, and their bounds hold."""
    steady = phased(table, requests)
    finger = verdicts_of(steady).index(verdict)
    layers = [sensation.layer for sensation in steady.fingers]
    neighbor = next(n for n, layer in enumerate(layers) if layer not in (None, layers[finger]))
    fingers = list(requests)
    fingers[neighbor] = modulated(fingers[neighbor], 20.0)

    served = phased(table, fingers)
    crosstalk = served.fingers[finger].foreign_level_db_sl
    fingers[finger] = replace(fingers[finger], max_foreign_db_sl=crosstalk - 0.1)
    bounded = phased(table, fingers)

    assert served.fingers[finger].verdict == verdict
    assert served.layers[served.fingers[neighbor].layer].side_bands
    rng = np.random.default_rng(1)
    plates = draw_plates(rng, table.uncertainty, of=table, count=200, contact_count=3)
    levels = realised(table, served, plates).foreign[finger]
    assert 0.82 <= np.mean(levels <= crosstalk) <= 0.97
    assert [layer.side_bands for layer in bounded.layers] == [()] * len(bounded.layers)


@pytest.mark.parametrize(("limits", "count"), [(NO_LIMITS, 2), (Limits((100.0, 300.0)), 0)])
def test_side_bands_are_within_the_frequencies_of_amplifiers(
    table: LocalizationTable, limits: Limits, count: int
) -> None:
    """From 100 Hz on, a carrier up to 110 Hz has none at 20 Hz."""
    finger = wants(FIRST, (100.0, 110.0), modulation_hz=20.0)

    (layer,) = phased(table, [finger], [Finger(SECOND)], limits=limits).layers

    assert len(layer.side_bands) == count


@pytest.mark.parametrize("priorities", [[1], [1, 1], [1, 2]])
def test_side_bands_are_within_the_stroke(table: LocalizationTable, priorities: list[int]) -> None:
    """At their peaks the amplitudes of all tones of an ERA add up to its stroke at most."""
    (places,) = contact_sets(1, fingers=3, seed=4)
    fingers = []
    for place, priority in zip(places, priorities, strict=False):
        fingers.append(wants(place, level_db_sl=40.0, priority=priority, modulation_hz=10.0))
    quiet = places[len(fingers) :]

    served = phased(table, fingers, quiet, min_contrast_db=-99.0)

    assert max(len(layer.side_bands) for layer in served.layers) == 2
    assert max(shares_of_stroke(served, table).values()) == pytest.approx(1.0, abs=1e-5)
    lowest = min(promised_levels(served)[: len(fingers)])
    assert served.stroke_factor == pytest.approx(10 ** ((lowest - 40.0) / 20), rel=1e-4)
    assert "is lowered to" in served.applied[-1]
