"""Questions and answers: what is refused, what is measured."""

import math
from dataclasses import replace

import numpy as np
import pytest

from model.errors import InputError
from model.fem.assembly import assemble
from model.fem.harmonic import direct_acceleration
from model.finger.fingertip import fingertip_points
from model.finger.perception import detection_threshold
from model.table.pattern import Pattern
from model.table.pattern_choice import UnreachableLevel
from model.table.question import Question
from model.vibration.peak import tone_amplitudes
from paper_table import FREQUENCIES, contact_sets, smooth_rig, smooth_table

TARGET, QUIET = (0.09, 0.07), ((0.25, 0.18),)


@pytest.mark.parametrize(
    "arguments",
    [
        {"targets": ()},
        {"quiet": tuple((0.2, y / 50) for y in range(10))},
        {"level_db_sl": math.nan},
        {"level_db_sl": 201.0},
        {"level_db_sl": -300.0},
        {"targets": (TARGET, (0.2, 0.1), TARGET)},
        {"quiet": QUIET * 2},
        {"quiet": (TARGET,)},
        {"targets": ((0.2, 0.1), TARGET), "quiet": ((0.095, 0.07),)},
        {"search_time": math.nan},
        {"drive_mode": "loud"},
        {"eras_at_most": 0},
        {"softer_db": (0.0, 3.0)},
        {"softer_db": (-1.0,)},
        {"softer_db": (math.nan,)},
    ],
    ids=str,
)
def test_question_refuses_what_no_table_can_answer(arguments):
    """Numbers of contacts, levels, times, modes and ERAs; contacts on top of each other."""
    Question((TARGET,), QUIET)
    with pytest.raises(InputError):
        Question(**{"targets": (TARGET,)} | arguments)


@pytest.mark.parametrize(
    "question",
    [
        Question(((0.1, math.inf),)),
        Question((TARGET,), ((math.nan, 0.1),)),
        Question((TARGET,), drive_mode="phased", playable=("switched",)),
        Question((TARGET,), playable=("graded",)),
        Question((TARGET,), frequencies=(600.0, 800.0)),
        Question((TARGET,), eras_at_most=9),
        Question((TARGET,), eras_at_most=3, drive_mode="graded"),
    ],
)
def test_query_refuses_what_table_or_amplifiers_lack(question):
    """Contacts off the plate; modes, frequencies and numbers of ERAs that cannot be driven."""
    with pytest.raises(InputError):
        smooth_table().query(question)


@pytest.mark.parametrize(
    ("question", "is_exhaustive"),
    [
        (Question((TARGET,), QUIET, drive_mode="phased"), True),
        (Question((TARGET, (0.2, 0.1)), drive_mode="phased"), False),
        (Question((TARGET,), QUIET, drive_mode="graded"), False),
        (Question((TARGET, (0.2, 0.1))), True),
        (Question((TARGET,), QUIET, eras_at_most=4), False),
    ],
)
def test_query_names_a_level_that_is_reached_when_too_loud(question, is_exhaustive):
    """The error says whether the level it names is the highest, and that level has a pattern."""
    with pytest.raises(UnreachableLevel) as refusal:
        smooth_table().query(replace(question, level_db_sl=120.0))
    assert refusal.value.is_exhaustive == is_exhaustive
    reachable = refusal.value.reachable_db_sl
    assert 20 < reachable < 120
    assert smooth_table().query(replace(question, level_db_sl=reachable))


def test_query_with_four_eras_is_searched_exactly():
    """The contrast of the answer is its own upper bound; with two ERAs there is no bound."""
    pattern = smooth_table().query(Question((TARGET,), QUIET, eras_at_most=4))
    assert pattern.contrast_bound_db == pytest.approx(pattern.contrast_db, abs=1e-4)
    assert smooth_table().query(Question((TARGET,), QUIET)).contrast_bound_db is None


def test_query_says_that_a_search_was_incomplete_when_it_ran_out_of_time():
    """A level that only more than two ERAs reach is not called unreachable."""
    question = Question((TARGET,), QUIET, eras_at_most=4)
    with pytest.raises(UnreachableLevel) as refusal:
        smooth_table().query(replace(question, level_db_sl=120.0, eras_at_most=2))
    louder = replace(question, level_db_sl=refusal.value.reachable_db_sl + 0.5)
    assert smooth_table().query(louder).level_db_sl == louder.level_db_sl
    with pytest.raises(InputError) as incomplete:
        smooth_table().query(replace(louder, search_time=0.0))
    assert not isinstance(incomplete.value, UnreachableLevel)


def test_frequencies_are_those_that_the_amplifiers_play():
    """With amplifiers from 150 to 250 Hz no tone lies outside, in any mode."""
    for mode in ("switched", "graded", "signed", "phased"):
        pattern = smooth_table().query(
            Question((TARGET,), QUIET, drive_mode=mode, frequencies=(150.0, 250.0))
        )
        assert all(150 <= tone.frequency <= 250 for tone in pattern.excitation.values())
    only = float(FREQUENCIES[9])  # an amplifier's lowest and highest are among what it plays
    pattern = smooth_table().query(Question((TARGET,), QUIET, frequencies=(only, only)))
    assert {tone.frequency for tone in pattern.excitation.values()} == {only}


@pytest.mark.parametrize("mode", ["graded", "signed", "phased"])
def test_an_answer_is_what_the_direct_solver_says(mode):
    """Level, contrast and the loudest quiet level of a pattern, by the sparse direct solve."""
    rig, table = smooth_rig(), smooth_table()
    target, *quiet = contact_sets(1, fingers=4, seed=2)[0]
    pattern = table.query(Question((target,), tuple(quiet), level_db_sl=17.0, drive_mode=mode))
    discs = [fingertip_points(*place, rig.plate) for place in (target, *quiet)]
    matrices = assemble(rig.plate, rig.mesh)
    frequencies, amplitudes = tone_amplitudes(
        pattern.excitation,
        rig.eras,
        lambda f: direct_acceleration(matrices, rig.eras, f, np.concatenate(discs)),
    )
    count = len(discs[0])
    above = np.sqrt(((amplitudes.T / detection_threshold(frequencies)) ** 2).sum(axis=1))
    peak = amplitudes.sum(axis=0)
    assert 20 * np.log10(above[:count].mean()) == pytest.approx(17.0, abs=0.02)
    assert pattern.quiet_level_db_sl == pytest.approx(20 * np.log10(above[count:].max()), abs=0.05)
    contrast = 20 * np.log10(peak[:count].mean() / peak[count:].max())
    assert pattern.contrast_db == pytest.approx(contrast, abs=0.05)


def test_measures_follow_from_levels():
    """By hand: 20 dB SL here and 4 there are 16 between; unaware at -10, so up to 6 is usable."""
    pattern = Pattern({}, 0.02, 20.0, 15.0, 4.0)
    assert pattern.contrast_db_sl == 16.0
    assert pattern.quiet_is_unaware is False
    assert pattern.usable_level_db_sl == 6.0
    deaf = replace(pattern, quiet_level_db_sl=-10.0)
    assert deaf.quiet_is_unaware is True
    assert deaf.usable_level_db_sl == 20.0
    alone = replace(pattern, contrast_db=None, quiet_level_db_sl=None)
    assert alone.quiet_is_unaware is None
    assert alone.usable_level_db_sl == 20.0


def test_the_usable_level_leaves_quiet_fingers_unaware():
    """Asked again for what is usable, the quiet finger is unaware."""
    table = smooth_table()
    loud = table.query(Question((TARGET,), QUIET, drive_mode="phased", level_db_sl=40.0))
    assert loud.quiet_is_unaware is False
    soft = table.query(
        Question((TARGET,), QUIET, drive_mode="phased", level_db_sl=loud.usable_level_db_sl - 1e-3)
    )
    assert soft.quiet_is_unaware is True


def test_mirrored_contacts_get_mirrored_phased_patterns():
    """West and east swap: the same contrast, and each ERA's level at its mirror image."""
    table = smooth_table()
    length = table.plate.length
    west = table.query(Question((TARGET,), QUIET, drive_mode="phased"))
    east = table.query(
        Question(((length - 0.09, 0.07),), ((length - 0.25, 0.18),), drive_mode="phased")
    )
    assert east.contrast_db == pytest.approx(west.contrast_db, abs=0.05)
    for name, mirrored in {"SW": "SE", "SE": "SW", "NE": "NW", "NW": "NE"}.items():
        assert east.excitation[mirrored].frequency == west.excitation[name].frequency
        assert east.excitation[mirrored].amplitude == pytest.approx(
            west.excitation[name].amplitude, rel=1e-2
        )


def test_the_strongest_era_of_a_frequency_has_phase_zero():
    """No phase is absolute; the others are told from the strongest."""
    for place, *quiet in contact_sets(4, fingers=3, seed=12):
        pattern = smooth_table().query(Question((place,), tuple(quiet), drive_mode="phased"))
        strongest = max(pattern.excitation.values(), key=lambda tone: tone.amplitude)
        assert strongest.phase == 0.0
        assert sum(tone.phase == 0.0 for tone in pattern.excitation.values()) == 1


@pytest.mark.parametrize("softer", [(0.0, 0.0), (0.0, 8.0), (6.0, 0.0)])
def test_two_targets_both_feel_it(softer):
    """Both at the level that each wants or above, one of them right at it."""
    table = smooth_table()
    first, second, quiet = contact_sets(1, fingers=3, seed=9)[0]
    question = Question(
        (first, second), (quiet,), drive_mode="phased", level_db_sl=15.0, softer_db=softer
    )
    pattern = table.query(question)
    levels = []
    for place in (first, second):
        points = fingertip_points(*place, table.plate)
        frequencies, amplitudes = table.amplitudes(pattern.excitation, points)
        above = np.sqrt(((amplitudes.T / detection_threshold(frequencies)) ** 2).sum(axis=1))
        levels.append(20 * np.log10(above.mean()))
    assert min(np.array(levels) + softer) == pytest.approx(15.0, abs=0.01)


@pytest.mark.parametrize("mode", ["switched", "graded", "signed", "phased"])
def test_a_lone_finger_is_told_from_the_plate_around_it(mode):
    """The pattern's ratio to the rms of cell centres beyond 5 cm is what the answer says."""
    table = smooth_table()
    pattern = table.query(Question((TARGET,), drive_mode=mode))
    centres = table.cell_centres
    far = centres[np.hypot(*(centres - TARGET).T) > 0.05]
    points = np.concatenate([fingertip_points(*TARGET, table.plate), far])
    peak = table.amplitudes(pattern.excitation, points)[1].sum(axis=0)
    count = len(points) - len(far)
    ratio = 20 * np.log10(peak[:count].mean() / np.sqrt((peak[count:] ** 2).mean()))
    assert pattern.surroundings_contrast_db == pytest.approx(ratio, abs=0.01)
    assert pattern.contrast_db is None


def test_two_fingers_alone_are_told_from_what_is_near_neither():
    """Both are targets; only cells beyond 5 cm of the one and of the other are around them."""
    table = smooth_table()
    places = (TARGET, QUIET[0])
    pattern = table.query(Question(places, drive_mode="phased"))
    centres = table.cell_centres
    far = centres[[min(math.dist(centre, each) for each in places) > 0.05 for centre in centres]]
    discs = [fingertip_points(*each, table.plate) for each in places]
    peaks = [
        table.amplitudes(pattern.excitation, points)[1].sum(axis=0) for points in (*discs, far)
    ]
    felt = min(peak.mean() for peak in peaks[:2])
    ratio = 20 * np.log10(felt / np.sqrt((peaks[2] ** 2).mean()))
    assert pattern.surroundings_contrast_db == pytest.approx(ratio, abs=0.01)
