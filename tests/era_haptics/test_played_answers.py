"""Answers of several contents from Python: played, mapped, and as an amplifier plays them."""

from dataclasses import replace

import numpy as np
import pytest

import era_haptics as era
from model.table.table_file import build_table
from real_wires import SHARED_WIRES, on_two_amplifiers, rig_on_wire
from registry import threads
from virtual_lines import in_virtual_time

RIG = on_two_amplifiers(era.load_rig(era.example_rig_path()))
PLATE = era.SolvedPlate(RIG)
ONE, OTHER, QUIET = (0.08, 0.06), (0.22, 0.16), (0.15, 0.11)


@pytest.fixture(scope="module", params=[False, True], ids=["quiet", "modulated"])
def answer(request: pytest.FixtureRequest) -> era.Answer:
    """Of two fingers, beside a quiet one that comes first, or one of them modulated."""
    frequencies = np.array([60.0, 120.0, 230.0, 250.0, 270.0])
    table = build_table(RIG, frequencies=frequencies, grid=era.Grid(4, 3), drive_mode="phased")
    # At 250 Hz, the only frequency of the table with side bands 20 Hz beside it.
    beating = era.Stimulus(modulation_hz=20, band_hz=(250.0, 250.0))
    first = era.Finger(ONE, beating), era.Finger(OTHER, era.Stimulus())
    other = era.Finger(QUIET, load=1.5), era.Finger(ONE, era.Stimulus(16.0)), first[1]
    found = era.answer(table, first if request.param else other)
    assert [len(layer.excitations) for layer in found.layers] == [3 if request.param else 1, 1]
    return found


def test_played_answer_is_the_sum_of_its_layers(answer: era.Answer) -> None:
    """At every finger and moment; over the plate at every frequency; and so are several tones."""
    played = PLATE.play(answer, duration=0.6)
    places = [each.finger.at for each in answer.fingers]
    loads = [each.finger.load for each in answer.fingers]
    alone = [PLATE.play(each, places, loads=loads, duration=0.6) for each in answer.layers]
    for number, record in enumerate(played.records):
        parts = [each.records[number].accelerations for each in alone]
        peak = np.abs(record.accelerations).max()
        np.testing.assert_allclose(record.accelerations, sum(parts), atol=1e-9 * peak)
        layer = answer.fingers[number].layer
        if layer is not None:
            level = alone[layer].fingers[number].levels_db_sl
            np.testing.assert_allclose(played.fingers[number].levels_db_sl, level, atol=1e-9)
    field = PLATE.map(answer, raster=(5, 4))
    maps = [PLATE.map(each, raster=(5, 4)) for each in answer.layers]
    together = np.concatenate([each.field for each in maps])
    order = np.argsort(np.concatenate([each.frequencies for each in maps]))
    np.testing.assert_allclose(field.field, together[order], rtol=1e-9)
    drives = {
        name: [layer[name] for one in answer.layers for layer in one.excitations]
        for name in RIG.wiring
    }
    np.testing.assert_allclose(PLATE.map(drives, raster=(5, 4)).field, field.field, rtol=1e-9)


def test_each_finger_feels_what_the_answer_says(answer: era.Answer) -> None:
    """Levels, and contrasts by the set that says least, in the end of what is played in time."""
    played = PLATE.play(answer, duration=1.5)
    by_set = [replace(played, threshold=each).fingers for each in RIG.promised_thresholds]
    assert len(by_set) == 2
    for felt, said, *by_each in zip(played.fingers, answer.fingers, *by_set, strict=True):
        assert felt.level_db_sl == pytest.approx(said.level_db_sl, abs=0.1)
        least = min(each.contrast_db for each in by_each)
        assert least == pytest.approx(said.contrast_db, abs=0.3)
    first, last = played.fingers[-2:]
    # A whole modulation, (1 + cos)² of 20 Hz, under a Hann window of 30 ms: 10 log10(3.25 / 0.10).
    swing = 15.1 if answer.layers[0].side_bands else 0.0
    assert np.ptp(first.levels_db_sl[-40:]) == pytest.approx(swing, abs=1.5 if swing else 0.2)
    frame = last.to_frame()
    assert frame["level_db_sl"].iloc[-1] == pytest.approx(last.level_db_sl, abs=0.1)


@in_virtual_time
async def test_amplifiers_play_an_answer_as_the_plate_does(answer: era.Answer) -> None:
    """Two amplifiers on a wire, by their commands: at each finger each frequency within 0.1 dB."""
    played = PLATE.play(answer, duration=1.5)
    async with rig_on_wire(RIG, SHARED_WIRES["serial"]) as hosted:
        fingers = {str(number): each.finger for number, each in enumerate(answer.fingers)}
        hosted.bench.place_fingers(
            {name: each.at for name, each in fingers.items()},
            loads={name: each.load for name, each in fingers.items()},
            now=threads.now(),
        )
        await hosted.group.arm()
        await hosted.group.apply(era.commands_for(RIG, answer))
        await hosted.beat_until(threads.now() + 4)
        hosted.bench.advance(threads.now())
        records = hosted.bench.fingers.felt(threads.now() - 0.5, threads.now())
    for number, record in enumerate(played.records):
        here, there = (
            np.sqrt((each.accelerations[-5000:] ** 2).mean(axis=0))
            for each in (record, records[str(number)])
        )
        assert 20 * np.log10(here.max() / there.max()) == pytest.approx(0, abs=0.1)


def test_play_without_targets_needs_an_answer(answer: era.Answer) -> None:
    """Drives have no fingers, and those of an answer have their loads; silence is not played."""
    for drive, given in (({"SW": 110}, {}), (answer, {"quiet": [QUIET]}), (answer, {"loads": [1]})):
        with pytest.raises(era.InputError, match="target must be"):
            PLATE.play(drive, **given)
    silent = replace(answer, contents=replace(answer.contents, streams=()))
    with pytest.raises(era.InputError, match="must have a layer"):
        PLATE.map(silent)
