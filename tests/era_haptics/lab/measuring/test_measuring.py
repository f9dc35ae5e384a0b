"""Measurement of a plate through a sound card, and what is rejected.

The plate on the desk is in memory, simulated from a seed, and compared with the plate in time.
"""

import ctypes
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import LinkError
from era_haptics.command import run_era
from era_haptics.lab.measuring import simulated_measurement
from era_haptics.lab.measuring.desk import Desk
from era_haptics.lab.measuring.measure import MeasuredResponses, measure
from era_haptics.lab.measuring.multisine import (
    Multisine,
    ResponseEstimate,
    estimate,
    multisine_frequencies,
)
from era_haptics.lab.measuring.recording_checks import check_wiring
from era_haptics.lab.measuring.runs import play_and_record
from era_haptics.lab.measuring.sensor_file import WiredSensor
from era_haptics.lab.measuring.sound_card import SoundCard
from examples.make_measured import Accelerometer, record_responses
from kit.desk_plate import Converters, DeskModel, DeskPlate, Truth
from model.errors import InputError
from model.response_files import measurement_of, read_measured
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import example_rig_path, load_rig
from model.structure.attachments import PointLoad
from processes.sound_cards import DeskCard
from sim.soft_amp.engine import callback_address

PLACES = ((0.03, 0.05), (0.20, 0.11))
FIXED = tuple(WiredSensor(f"P{n}", x, y, n, 1e-3) for n, (x, y) in enumerate(PLACES, start=1))
MOVED = tuple(replace(each, input=1, mass=20e-3) for each in FIXED)
FREQUENCIES = np.array([61.0, 151.0, 311.0])


@pytest.mark.parametrize("sensors", [FIXED, MOVED], ids=["fixed", "moved"])
def test_responses_are_those_of_the_plate_in_time(sensors, monkeypatch, tmp_path) -> None:
    """Of a plate that is the rig's, without noise; a sensor of 20 g weighs where it is moved to."""
    monkeypatch.setattr(simulated_measurement, "NOISE", 0.0)
    rig = replace(load_rig(example_rig_path()), uncertainty=Uncertainty.none())
    output = tmp_path / "measured.csv"
    simulated_measurement.measured_by_simulation(
        Desk(rig, sensors), output, frequencies=FREQUENCIES, seed=0
    )
    found = measurement_of(read_measured(output), rig)
    for number, each in enumerate(sensors):
        load = PointLoad(each.x, each.y, mass=each.mass)
        loaded = replace(rig, masses=(*rig.masses, load) if each.mass else rig.masses)
        in_time = record_responses(loaded, [Accelerometer("", each.x, each.y)], FREQUENCIES)
        error = found.values[:, number] - in_time.values[:, 0]
        assert np.abs(error).max() < 0.03 * np.abs(in_time.values).max()


def test_one_command_measures_a_plate_that_deviates_as_its_seed_draws_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same for the same seed, another one for another; it says where to calibrate to."""
    sensors = tmp_path / "sensors.csv"
    sensors.write_text("sensor,x_m,y_m,input,mv_per_m_s2\nP1,0.03,0.05,1,10\nP2,0.2,0.11,2,10\n")
    rig = example_rig_path()
    found = []
    for seed in ("0", "0", "1"):
        output = tmp_path / f"{len(found)}.csv"
        options = ["--simulated", "--sensors", str(sensors), "-o", str(output), "--seed", seed]
        assert run_era(["measure", str(rig), *options, "--frequencies", "61:301:40"]) == 0
        assert f"-o {tmp_path / 'calibrated.yaml'}" in capsys.readouterr().out
        found.append(measurement_of(read_measured(output), load_rig(rig)).values)
    np.testing.assert_array_equal(found[0], found[1])
    assert np.abs(found[2] / found[0] - 1).max() > 0.05


RATE = 8_000.0
DELAY = 73
LEVEL = 0.3
SENSOR_PLACES = ((0.03, 0.05), (0.20, 0.11), (0.29, 0.20))
SENSORS = tuple(
    WiredSensor(f"P{n}", x, y, n, 2e-3) for n, (x, y) in enumerate(SENSOR_PLACES, start=1)
)
PLAYED_HZ = np.array([61.0, 151.0, 233.0, 311.0])


def card(truth: Truth, *, noise: float = 0.0, is_shared: bool = False, **wires: object) -> DeskCard:
    """A sound card in front of the plate at rest."""
    converters = Converters(delay=DELAY, noise=noise)
    plate = DeskPlate(truth, SENSORS, rate=RATE, converters=converters, seed=1, is_shared=is_shared)
    return DeskCard(plate, rate=RATE, **wires)  # type: ignore[arg-type]


def sines(desk: Desk, frequencies: np.ndarray = PLAYED_HZ) -> Multisine:
    """Multisines of all ERAs and of the loop-back."""
    return Multisine(frequencies, len(desk.rig.eras) + 1, RATE, LEVEL)


@pytest.fixture(scope="module")
def undisturbed(rig: Rig, truth: Truth) -> MeasuredResponses:
    """The plate measured with nothing wrong."""
    desk = Desk(rig, SENSORS)
    return measure(desk, card(truth), sines(desk))


def test_estimate_uses_all_rounds_of_runs_and_requires_whole_recordings() -> None:
    """Two rounds give the gains of a wire; one period, or a signal that ends early, is refused."""
    sines = Multisine(np.array([61.0, 151.0]), 3, 1000.0, level=0.1)
    gains = np.array([[1.0, -2.0, 0.5], [0.0, 3.0, -1.0]])
    signals = [sines.signal(run, periods=4)[1000:3000] for run in range(6)]
    runs = [signal @ gains.T for signal in signals]
    np.testing.assert_allclose(estimate(sines, runs).values, [gains, gains], atol=1e-9)
    with pytest.raises(InputError, match="at least 2 periods, got 1"):
        estimate(sines, [run[:1000] for run in runs])
    card = SoundCard(outputs=3, inputs=2, limit=1.0)
    card.rate = sines.rate
    with pytest.raises(InputError, match=r"at least 3 s, .* got 2 s"):
        play_and_record(card, signals[0], settling=1.0, seconds=2.0, is_whole=np.any)


def test_multisine_has_its_level_and_orthogonal_runs() -> None:
    """No sample above the level in any run; at each line the runs form a unitary matrix."""
    multisine = Multisine(multisine_frequencies(40, 500), 5, RATE, LEVEL)
    runs = [multisine.signal(run, periods=2) for run in range(5)]
    assert 0.9 * LEVEL < np.abs(runs).max() <= LEVEL * (1 + 1e-9)
    assert (multisine.frequencies % 2 == 1).all()
    spectra = np.array([np.fft.rfft(run[4000:12000], axis=0) for run in runs])
    for line in (41, 251, 499):
        matrix = spectra[:, line] / np.abs(spectra[:, line])
        np.testing.assert_allclose(matrix @ matrix.conj().T, 5 * np.eye(5), atol=1e-6)


def test_measured_responses_are_those_of_the_plate(
    rig: Rig, truth: Truth, undisturbed: MeasuredResponses
) -> None:
    """Against its own closed form: hidden delay and filter are taken out, and the delay is told.

    What is left is the ringing of the start, 1 s before.
    """
    found = undisturbed
    model = DeskModel(truth, np.array(SENSOR_PLACES)).under()
    strokes = np.array([era.stroke for era in rig.eras])
    exact = model.response(PLAYED_HZ) / strokes
    loud = np.abs(exact) > 0.05 * np.abs(exact).max(axis=(1, 2), keepdims=True)
    # The filter of inputs at 8 kHz has a ripple over this band, which the loop-back takes out too.
    np.testing.assert_allclose(found.responses.values[loud], exact[loud], rtol=0.02)
    assert found.responses.names == ("P1", "P2", "P3")
    assert found.latency * RATE == pytest.approx(DELAY, abs=1)
    assert (found.repeated, found.coherence.min() > 0.999) == (0, True)


def test_a_card_without_an_output_to_spare_measures_by_a_y_cable(
    rig: Rig, truth: Truth, undisturbed: MeasuredResponses
) -> None:
    """The last ERA's output is the loop-back's, too: four runs, the same responses and delay.

    Inputs exchanged, and another ERA's output in the cable, are reported with their places.
    """
    desk = Desk(rig, SENSORS, is_shared=True)
    sines = Multisine(PLAYED_HZ, 4, RATE, LEVEL)
    sound = card(truth, is_shared=True)
    found = measure(desk, sound, sines)
    difference = found.responses.values - undisturbed.responses.values
    assert np.linalg.norm(difference) < 0.01 * np.linalg.norm(undisturbed.responses.values)
    assert (sound.runs, desk.wiring.loopback_output) == (4, 4)
    assert found.latency * RATE == pytest.approx(DELAY, abs=1)
    for wires, cause in (
        ({"on_inputs": [0, 3, 2, 1], "on_outputs": [0, 1, 2, 3, 3]}, "at input 2.*P2"),
        ({"on_outputs": [0, 1, 2, 3, 1]}, "output 2 of ERA SE"),
    ):
        with pytest.raises(InputError, match=cause):
            measure(desk, card(truth, **wires), sines)


@pytest.mark.parametrize(
    ("wires", "repeated"),
    [({"lost": [1]}, 1), ({"late": [2]}, 1), ({"reported": 1}, 0)],
    ids=["1", "2", "none"],
)
def test_run_that_lost_a_block_is_played_again(
    rig: Rig, truth: Truth, undisturbed: MeasuredResponses, wires: dict[str, object], repeated: int
) -> None:
    """128 samples are missing in a run, or before it, which nothing reports.

    Runs would not be orthogonal. Losses that a driver alone reports, as PortAudio does over a
    synchronous server, repeat nothing.
    """
    desk = Desk(rig, SENSORS)
    sound = card(truth, **wires)
    found = measure(desk, sound, sines(desk))
    assert (found.repeated, sound.runs) == (repeated, 5 + repeated)
    difference = found.responses.values - undisturbed.responses.values
    assert np.linalg.norm(difference) < 0.01 * np.linalg.norm(undisturbed.responses.values)


@pytest.mark.parametrize(
    ("wires", "error", "cause"),
    [
        ({"on_inputs": [0, 3, 2, 1]}, InputError, "at input 2.*P2"),
        ({"lost": range(99)}, LinkError, "lost in 3 attempts"),
        (
            {"on_outputs": [0, 4, 2, 3, 1]},
            InputError,
            "0.9 of output 2 of ERA SE: outputs are swap",
        ),
        pytest.param(
            {"on_inputs": [0, 1, 3, 3]},
            InputError,
            "input 3 must have sensor P3, got output 5",
            id="the cable also at the input of a sensor",
        ),
        ({"gain": 50.0}, InputError, "clipping"),
        ({"gain": 0.0}, LinkError, "all inputs are silent"),
        ({"on_inputs": [0, 1, 2, 2]}, InputError, "input 4 must bring back .* by a cable"),
        ({"noise": 1.5}, LinkError, "coherence"),
        ({"drifts": {4: 50e-6}}, InputError, r"clock.* 50 ppm at the loop-back"),
        ({"drifts": dict.fromkeys((1, 2, 3, 4), -9e-6)}, InputError, r"clock.* -9 .*loop-back"),
        ({"drifts": {2: 20e-6}}, InputError, r"clock.* 20 ppm at sensor P2 \(input 2\)"),
    ],
)
def test_wrong_desks_are_refused_with_their_cause(
    rig: Rig, truth: Truth, wires: dict[str, object], error: type[Exception], cause: str
) -> None:
    """Inputs or outputs swapped, blocks lost, clipped, off, no cable, noise, two clocks."""
    desk = Desk(rig, SENSORS)
    played = sines(desk)
    if "noise" in wires:
        played = replace(played, level=0.03)  # as loud as the noise, without clipping
    with pytest.raises(error, match=cause):
        measure(desk, card(truth, **wires), played)  # type: ignore[arg-type]


# Inputs of P1, P2, P3 and of the loop-back, by outputs 1 to 5; output 5 has the cable.
WIRED = np.array([[0.02, 0.03, 0.02, 0.03, 0.0]] * 3 + [[0.0, 0.0, 0.0, 0.0, 0.9]])


@pytest.mark.parametrize(
    ("at", "gains", "cause"),
    [
        (4, [0, 0, 0, 0, 0], r"output 5 alone, as the loop-back, got a gain of 0; connect them"),
        pytest.param(
            4,
            [0, 0.03, 0, 0, 0.9],
            "got 0.03 of output 2 of ERA SE, too; check mixers",
            id="another output in the loop-back",
        ),
        (4, [0, 0.01, 0, 0, 0.9], None),  # 1 % is what cables beside each other have
        (4, [0, 0.9, 0, 0, 0], "got 0.9 of output 2 of ERA SE: outputs are swapped"),
        pytest.param(
            2,
            [0, 0, 0, 0, 0.3],
            "input 2 must have sensor P2, got output 5 as through a cable",
            id="a cable at the input of a sensor",
        ),
        (3, [0, 0.8, 0, 0, 0], "input 3 must have sensor P3, got output 2 as through a cable"),
        (3, [0.02, 0.03, 0.02, 0.03, 0.3], None),  # monitoring beside a sensor takes nothing away
    ],
)
def test_wiring_is_judged_by_the_gains_from_outputs_to_inputs(
    rig: Rig, at: int, gains: list[float], cause: str | None
) -> None:
    """One input is changed; its gains say by hand what is connected to it."""
    came = WIRED.copy()
    came[at - 1] = gains
    each = np.broadcast_to(came, (len(PLAYED_HZ), *came.shape)).astype(complex)
    found = ResponseEstimate(each, abs(each), abs(each), np.zeros(4))
    with nullcontext() if cause is None else pytest.raises(InputError, match=cause):
        check_wiring(found, Desk(rig, SENSORS).wiring)


def test_amplifier_that_is_off_is_named(rig: Rig, truth: Truth) -> None:
    """An actuator without gain behind output 3, beside noise that any sensor has."""
    off = list(truth.actuators)
    off[2] = replace(off[2], gain=0.0)
    desk = Desk(rig, SENSORS)
    with pytest.raises(LinkError, match=r"output 3.*NE"):
        measure(desk, card(replace(truth, actuators=tuple(off)), noise=5e-3), sines(desk))


def test_levels_and_frequencies_that_cannot_be_played_are_refused(rig: Rig) -> None:
    """A level beyond the rig's limits; half a hertz, no line of a second; 4 kHz at 8 kHz."""
    for level in (0.0, 1.5):
        with pytest.raises(InputError, match="--level"):
            Desk(rig, SENSORS).check_level(level)
    for frequency in (61.5, 3999.0):
        with pytest.raises(InputError, match="frequencies"):
            Multisine(np.array([frequency]), 5, RATE, LEVEL)


FRAMES = 64
# paInputUnderflow, paInputOverflow, paOutputUnderflow, paOutputOverflow of portaudio.h
LOST = (0x1, 0x2, 0x4, 0x8)
PRIMING = 0x10  # paPrimingOutput: nothing is lost


class CallbackCard(SoundCard):
    """Calls the callback as PortAudio does, with a number of flags for each block."""

    def __init__(self, flags: list[int]) -> None:
        super().__init__(outputs=1, inputs=1, limit=1.0)
        self._flags = flags

    def call(self) -> tuple[int, bool]:
        """Three blocks; returns the gaps that were counted, and whether all was recorded."""
        heard = self.start(np.zeros((3 * FRAMES, 1)))
        kind = ctypes.CFUNCTYPE(
            ctypes.c_int,
            ctypes.c_void_p,
            ctypes.c_void_p,
            ctypes.c_ulong,
            ctypes.c_void_p,
            ctypes.c_ulong,
            ctypes.c_void_p,
        )
        callback = kind(callback_address("transfer_portaudio"))
        block = np.ones(FRAMES, dtype=np.float32)
        out = np.zeros(FRAMES, dtype=np.float32)
        recorded, played, given = block.ctypes.data, out.ctypes.data, self.transfer_address
        for flags in self._flags:
            assert callback(recorded, played, FRAMES, None, flags, given) == 0
        return self.transfer.gaps, bool(heard.all())


@pytest.mark.parametrize(
    ("flags", "gaps"),
    [
        *(([0, flag, 0], 1) for flag in LOST),
        ([0, LOST[0] | LOST[2], LOST[1]], 2),
        ([0, PRIMING, 0], 0),
        ([LOST[1], 0, 0], 0),  # before the first frame
        ([0, 0, 0, LOST[1]], 0),  # after the last one
    ],
)
def test_lost_blocks_are_gaps_while_something_plays(flags: list[int], gaps: int) -> None:
    """Each block with a flag of a loss, from the second to the last, is one gap."""
    assert CallbackCard(flags).call() == (gaps, True)


@pytest.mark.parametrize("sample", [1.01, np.nan])
def test_samples_beyond_the_limit_are_not_played(sample: float) -> None:
    """The last check before a device; a sample that is no number would pass for none."""
    card = CallbackCard([])
    with pytest.raises(ValueError, match="at most 1"):
        card.run(np.full((FRAMES, 1), sample))
