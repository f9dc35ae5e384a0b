"""Measurement of a plate through a sound card, and desks that are rejected.

The plate on the desk is in memory, simulated from a seed, and compared with the plate in time.
"""

import ctypes
from collections.abc import Sequence
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
    multisine_frequencies,
)
from era_haptics.lab.measuring.runs import play_and_record
from era_haptics.lab.measuring.sensor_file import WiredSensor
from era_haptics.lab.measuring.sound_card import SoundCard
from examples.make_measured import Accelerometer, record_responses
from kit.desk_plate import Converters, DeskModel, DeskPlate, Truth
from model.arrays import FloatArray
from model.errors import InputError
from model.response_files import measurement_of, read_measured
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import example_rig_path, load_rig
from model.structure.attachments import PointLoad
from sim.soft_amp.engine import callback_address
from tests.era_haptics.lab.measuring.card_in_memory import DeskCard

PLACES = ((0.03, 0.05), (0.20, 0.11), (0.29, 0.20))
SENSORS = tuple(
    WiredSensor(f"P{number}", *place, number, 2e-3) for number, place in enumerate(PLACES, start=1)
)
FREQUENCIES = np.array([61.0, 151.0, 233.0, 311.0])
RATE = 8_000.0
DELAY = 73  # samples
LEVEL = 0.3

# Simulated measurements


@pytest.mark.parametrize("mass", [0.0, 20e-3], ids=["fixed", "moved"])
def test_simulated_responses_are_those_of_the_plate_in_time(
    mass: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """For a plate without tolerances; a sensor of 20 g has its weight wherever it is moved to."""
    monkeypatch.setattr(simulated_measurement, "NOISE", 0.0)
    rig = replace(load_rig(example_rig_path()), uncertainty=Uncertainty.none())
    sensors = SENSORS[:2]
    if mass:
        sensors = tuple(replace(sensor, input=1, mass=mass) for sensor in sensors)
    output = tmp_path / "measured.csv"

    simulated_measurement.measured_by_simulation(
        Desk(rig, sensors), output, frequencies=FREQUENCIES, seed=0
    )

    measurement = measurement_of(read_measured(output), rig)
    for number, sensor in enumerate(sensors):
        loaded = rig
        if mass:
            load = PointLoad(sensor.x, sensor.y, mass=mass)
            loaded = replace(rig, masses=(*rig.masses, load))
        sensor_in_time = Accelerometer("", sensor.x, sensor.y)
        expected = record_responses(loaded, [sensor_in_time], FREQUENCIES).values[:, 0]
        tolerance = 0.03 * np.abs(expected).max()
        np.testing.assert_allclose(
            measurement.values[:, number], expected, rtol=0, atol=tolerance, err_msg=sensor.name
        )


def test_simulated_plate_depends_on_the_seed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same for the same seed; the output names the file of the next command."""
    sensors = tmp_path / "sensors.csv"
    sensors.write_text("sensor,x_m,y_m,input,mv_per_m_s2\nP1,0.03,0.05,1,10\nP2,0.2,0.11,2,10\n")
    rig_path = example_rig_path()
    command = ["measure", str(rig_path), "--simulated", "--sensors", str(sensors)]
    values = []

    for number, seed in enumerate(("0", "0", "1")):
        output = tmp_path / f"{number}.csv"
        options = ["-o", str(output), "--seed", seed, "--frequencies", "61:301:40"]
        assert run_era([*command, *options]) == 0
        assert f"-o {tmp_path / 'calibrated.yaml'}" in capsys.readouterr().out
        values.append(measurement_of(read_measured(output), load_rig(rig_path)).values)

    np.testing.assert_array_equal(values[0], values[1])
    assert np.abs(values[2] / values[0] - 1).max() > 0.05


# Signals


def test_multisine_has_its_level_and_orthogonal_runs() -> None:
    """No sample above the level in any run; at each line the runs form a unitary matrix."""
    multisine = Multisine(multisine_frequencies(40, 500), 5, RATE, LEVEL)

    runs = np.array([multisine.signal(run, periods=2) for run in range(5)])

    assert 0.9 * LEVEL < np.abs(runs).max() <= LEVEL * (1 + 1e-9)
    assert set(multisine.frequencies % 2) == {1}
    spectra = np.fft.rfft(runs[:, 4000:12000], axis=1)
    for line in (41, 251, 499):
        matrix = spectra[:, line] / np.abs(spectra[:, line])
        np.testing.assert_allclose(matrix @ matrix.conj().T, 5 * np.eye(5), atol=1e-6)


def test_recording_needs_the_whole_signal() -> None:
    """A signal that ends early is refused."""
    card = SoundCard(outputs=3, inputs=2, limit=1.0)
    card.rate = 1000.0

    with pytest.raises(InputError, match=r"at least 3 s, .* got 2 s"):
        play_and_record(card, np.zeros((2000, 3)), settling=1.0, seconds=2.0, is_whole=np.any)


@pytest.mark.parametrize("level", [0.0, 1.5])
def test_level_beyond_the_limits_is_refused(rig: Rig, level: float) -> None:
    """Those of the rig."""
    with pytest.raises(InputError, match="--level"):
        Desk(rig, SENSORS).check_level(level)


@pytest.mark.parametrize("frequency", [61.5, 3999.0])
def test_frequency_that_cannot_be_played_is_refused(frequency: float) -> None:
    """Half a hertz is no line of a second; 4 kHz at 8 kHz."""
    with pytest.raises(InputError, match="frequencies"):
        Multisine(np.array([frequency]), 5, RATE, LEVEL)


# Responses


def card_of(
    truth: Truth, *, noise: float = 0.0, is_shared: bool = False, **wires: object
) -> DeskCard:
    """Return a sound card in front of the plate at rest."""
    converters = Converters(delay=DELAY, noise=noise)
    plate = DeskPlate(truth, SENSORS, rate=RATE, converters=converters, seed=1, is_shared=is_shared)
    return DeskCard(plate, rate=RATE, **wires)  # type: ignore[arg-type]


MULTISINE = Multisine(FREQUENCIES, 5, RATE, LEVEL)
"""Of four ERAs and the loop-back."""


@pytest.fixture(scope="module")
def undisturbed(rig: Rig, truth: Truth) -> MeasuredResponses:
    """The plate measured with nothing wrong."""
    return measure(Desk(rig, SENSORS), card_of(truth), MULTISINE)


def distance(measured: MeasuredResponses, undisturbed: MeasuredResponses) -> float:
    """Return the difference of measured responses, relative to undisturbed ones."""
    expected = undisturbed.responses.values
    difference = measured.responses.values - expected
    return float(np.linalg.norm(difference) / np.linalg.norm(expected))


def test_measured_responses_are_those_of_the_plate(
    rig: Rig, truth: Truth, undisturbed: MeasuredResponses
) -> None:
    """Against its closed form, without the hidden delay and filter; the delay is reported.

    The ringing of the start, 1 s earlier, remains. The filter of inputs at 8 kHz has a ripple over
    this band, which the loop-back takes out too.
    """
    responses = undisturbed.responses
    strokes = np.array([corner.stroke for corner in rig.eras])
    exact = DeskModel(truth, np.array(PLACES)).under().response(FREQUENCIES) / strokes

    sizes = np.abs(exact)
    is_loud = sizes > 0.05 * sizes.max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(responses.values[is_loud], exact[is_loud], rtol=0.02)
    assert responses.names == ("P1", "P2", "P3")
    assert undisturbed.latency * RATE == pytest.approx(DELAY, abs=1)
    assert undisturbed.repeated == 0
    assert undisturbed.coherence.min() > 0.999


def test_card_without_a_spare_output_measures_by_a_y_cable(
    rig: Rig, truth: Truth, undisturbed: MeasuredResponses
) -> None:
    """The last ERA's output is also the loop-back's: four runs, the same responses and delay."""
    desk = Desk(rig, SENSORS, is_shared=True)
    card = card_of(truth, is_shared=True)

    measured = measure(desk, card, replace(MULTISINE, sources=4))

    assert distance(measured, undisturbed) < 0.01
    assert card.runs == desk.wiring.loopback_output == 4
    assert measured.latency * RATE == pytest.approx(DELAY, abs=1)


@pytest.mark.parametrize(
    ("wires", "cause"),
    [
        ({"on_inputs": [0, 3, 2, 1], "on_outputs": [0, 1, 2, 3, 3]}, "at input 2.*P2"),
        ({"on_outputs": [0, 1, 2, 3, 1]}, "output 2 of ERA SE"),
    ],
    ids=["inputs", "outputs"],
)
def test_wrong_wires_with_a_y_cable_are_reported(
    rig: Rig, truth: Truth, wires: dict[str, list[int]], cause: str
) -> None:
    """Inputs exchanged, and another ERA's output in the cable."""
    desk = Desk(rig, SENSORS, is_shared=True)

    with pytest.raises(InputError, match=cause):
        measure(desk, card_of(truth, **wires), replace(MULTISINE, sources=4))


@pytest.mark.parametrize(
    ("wires", "repeated"),
    [({"lost": [1]}, 1), ({"late": [2]}, 1), ({"reported": 1}, 0)],
    ids=["lost", "late", "reported"],
)
def test_run_that_lost_a_block_is_played_again(
    rig: Rig, truth: Truth, undisturbed: MeasuredResponses, wires: dict[str, object], repeated: int
) -> None:
    """128 samples are missing in a run, or before it, which no flag reports.

    Losses that only a driver reports, as PortAudio does over a synchronous server, repeat nothing.
    """
    card = card_of(truth, **wires)

    measured = measure(Desk(rig, SENSORS), card, MULTISINE)

    assert measured.repeated == repeated
    assert card.runs == 5 + repeated
    assert distance(measured, undisturbed) < 0.01


# Wrong desks

WRONG_DESKS: dict[str, tuple[dict[str, object], type[Exception], str]] = {
    "swapped inputs": ({"on_inputs": [0, 3, 2, 1]}, InputError, "at input 2.*P2"),
    "lost blocks": ({"lost": range(99)}, LinkError, "lost in 3 attempts"),
    "swapped outputs": (
        {"on_outputs": [0, 4, 2, 3, 1]},
        InputError,
        "0.9 of output 2 of ERA SE: outputs are swap",
    ),
    "cable also at a sensor": (
        {"on_inputs": [0, 1, 3, 3]},
        InputError,
        "input 3 must have sensor P3, got output 5",
    ),
    "clipping": ({"gain": 50.0}, InputError, "clipping"),
    "no supply": ({"gain": 0.0}, LinkError, "all inputs are silent"),
    "no cable": (
        {"on_inputs": [0, 1, 2, 2]},
        InputError,
        "input 4 must bring back .* by a cable",
    ),
    "clock of the loop-back": (
        {"drifts": {4: 50e-6}},
        InputError,
        r"clock.* 50 ppm at the loop-back",
    ),
    "clock of all inputs": (
        {"drifts": dict.fromkeys((1, 2, 3, 4), -9e-6)},
        InputError,
        r"clock.* -9 .*loop-back",
    ),
    "clock of a sensor": (
        {"drifts": {2: 20e-6}},
        InputError,
        r"clock.* 20 ppm at sensor P2 \(input 2\)",
    ),
}
"""Wires, and the error with the cause that it names."""


@pytest.mark.parametrize("name", WRONG_DESKS)
def test_wrong_desk_is_refused_with_its_cause(rig: Rig, truth: Truth, name: str) -> None:
    """Inputs or outputs swapped, blocks lost, clipped, off, no cable, two clocks."""
    wires, error, cause = WRONG_DESKS[name]

    with pytest.raises(error, match=cause):
        measure(Desk(rig, SENSORS), card_of(truth, **wires), MULTISINE)  # type: ignore[arg-type]


# The device

FRAMES = 64
# paInputUnderflow, paInputOverflow, paOutputUnderflow, paOutputOverflow of portaudio.h
LOST = (0x1, 0x2, 0x4, 0x8)
PRIMING = 0x10  # paPrimingOutput: nothing is lost


class CallbackCard(SoundCard):
    """A card whose callback is called as PortAudio does."""

    def __init__(self) -> None:
        super().__init__(outputs=1, inputs=1, limit=1.0)

    def play(self, flags: Sequence[int]) -> FloatArray:
        """Play and record three blocks; each call has the flags of a block."""
        recording = self.start(np.zeros((3 * FRAMES, 1)))
        pointer = ctypes.c_void_p
        prototype = ctypes.CFUNCTYPE(
            ctypes.c_int, pointer, pointer, ctypes.c_ulong, pointer, ctypes.c_ulong, pointer
        )
        callback = prototype(callback_address("transfer_portaudio"))
        block = np.ones(FRAMES, dtype=np.float32)
        output = np.zeros(FRAMES, dtype=np.float32)
        buffers = (block.ctypes.data, output.ctypes.data)
        for flag in flags:
            assert callback(*buffers, FRAMES, None, flag, self.transfer_address) == 0
        return recording


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
    """Each block with a flag of a loss, from the second to the last, is a gap."""
    card = CallbackCard()

    recording = card.play(flags)

    assert card.transfer.gaps == gaps
    np.testing.assert_array_equal(recording, 1)


@pytest.mark.parametrize("sample", [1.01, np.nan])
def test_samples_beyond_the_limit_are_not_played(sample: float) -> None:
    """The last check before a device; a sample that is not a number would pass a comparison."""
    with pytest.raises(ValueError, match="at most 1"):
        CallbackCard().run(np.full((FRAMES, 1), sample))
