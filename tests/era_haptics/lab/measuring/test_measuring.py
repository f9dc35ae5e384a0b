"""Measurement of a plate through a sound card, of exciters by their impedance, what is refused.

The plate on the desk is in memory, simulated from a seed, and compared with the plate in time.
Parts of an exciter are compared with the equations of coil, magnet and circuit: `era measure
--impedance` runs through a sound card in memory and through a real audio server.
"""

import ctypes
import json
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.errors import LinkError
from era_haptics.command import run_era
from era_haptics.lab.measuring import other_sources
from era_haptics.lab.measuring.impedance import (
    ImpedanceSetup,
    exciter_values,
    fit_circuit,
    read_impedance,
)
from era_haptics.lab.measuring.measure import (
    MeasuredResponses,
    check_wiring,
    measure,
)
from era_haptics.lab.measuring.measure_cli import app
from era_haptics.lab.measuring.sound_card import (
    Desk,
    Multisine,
    ResponseEstimate,
    SoundCard,
    WiredSensor,
    multisine_frequencies,
)
from examples.make_measured import Accelerometer, record_responses
from kit.desk_plate import Converters, DeskModel, DeskPlate, Truth
from kit.plates import exciter_rig_text
from model.arrays import Float32Array, FloatArray
from model.errors import InputError
from model.estimate.measurement import measurement_of, read_measured
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import example_rig_path, load_rig, parse_rig
from model.structure.attachments import PointLoad
from processes.sound_cards import DeskCard, ExciterCircuit
from sim.soft_amp.engine import callback_address

PLACES = ((0.03, 0.05), (0.20, 0.11))
FIXED = tuple(WiredSensor(f"P{n}", x, y, n, 1e-3) for n, (x, y) in enumerate(PLACES, start=1))
MOVED = tuple(replace(each, input=1, mass=20e-3) for each in FIXED)
FREQUENCIES = np.array([61.0, 151.0, 311.0])


@pytest.mark.parametrize("sensors", [FIXED, MOVED], ids=["fixed", "moved"])
def test_responses_are_those_of_the_plate_in_time(sensors, monkeypatch, tmp_path) -> None:
    """Of a plate that is the rig's, without noise; a sensor of 20 g weighs where it is moved to."""
    monkeypatch.setattr(other_sources, "NOISE", 0.0)
    rig = replace(load_rig(example_rig_path()), uncertainty=Uncertainty.none())
    output = tmp_path / "measured.csv"
    other_sources.measured_by_simulation(
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
    return Multisine(frequencies, len(desk.eras) + 1, RATE, LEVEL)


@pytest.fixture(scope="module")
def undisturbed(rig: Rig, truth: Truth) -> MeasuredResponses:
    """The plate measured with nothing wrong."""
    desk = Desk(rig, SENSORS)
    return measure(desk, card(truth), sines(desk))


SQUARE = """
plate: {length: 400 mm, width: 400 mm, thickness: 3 mm, loss_factor: ETA,
        material: {name: square, E: 70 GPa, rho: 2700, nu: 0.3}}
eras:
  SW: {at: [0, 0], stiffness: 500, damping: 0, amplifier: main, channel: 0}
  SE: {at: [0.4, 0], stiffness: 500, damping: 0, amplifier: main, channel: 1}
  NE: {at: [0.4, 0.4], stiffness: 500, damping: 0, amplifier: main, channel: 2}
  NW: {at: [0, 0.4], stiffness: 500, damping: 0, amplifier: main, channel: 3}
amplifiers: {main: {url: "sim://"}}
"""


@pytest.mark.parametrize(("eta", "seconds"), [(0.05, 1), (0.01, 3), (0.001, 5)])
def test_a_plate_that_rings_long_is_given_the_time_to_settle(eta: float, seconds: int) -> None:
    """A free square plate's lowest mode is at 13.49 / (2 pi a²) sqrt(D / rho h) = 62 Hz (Leissa).

    It decays by pi f eta: to 1 % in 0.47, 2.4 and 24 s, of which at most 5 are given.
    """
    rig = parse_rig("square.yaml", SQUARE.replace("ETA", str(eta)))
    assert Desk(rig, SENSORS).settling == seconds


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
    assert (sound.runs, desk.output) == (4, 4)
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
            "input 2 must have sensor P2, got output 5 as by a cable",
            id="a cable at the input of a sensor",
        ),
        (3, [0, 0.8, 0, 0, 0], "input 3 must have sensor P3, got output 2 as by a cable"),
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
        check_wiring(found, Desk(rig, SENSORS))


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
            Desk(rig, SENSORS).check(level)
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
        recorded, played, given = block.ctypes.data, out.ctypes.data, self.given
        for flags in self._flags:
            assert callback(recorded, played, FRAMES, None, flags, given) == 0
        return self._transfer.gaps, bool(heard.all())


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


F = np.unique(np.geomspace(10, 1000, 100).round())
# A 25 mm exciter: coil, magnet [kg], k [N/m], c [N s/m], Bl [N/A], R [ohm], L [H].
COIL, MAGNET, STIFFNESS, DAMPING = 1.61e-3, 109.29e-3, 3189.2, 0.7553
FORCE_FACTOR, RESISTANCE, INDUCTANCE = 3.63, 4.3, 1e-4
WEIGHT = COIL + MAGNET
SCALE = 0.1e-3  # kg
SERIES = 10.0  # ohm
BASE = 0.3  # kg, not heavy


def impedance(f: float, *, is_glued: bool, base: float = np.inf, semi: float = 0.0) -> complex:
    """1 V by the current: the equations of current, coil and magnet, solved as they stand."""
    w = 2 * np.pi * f
    spring = STIFFNESS + 1j * w * DAMPING
    circuit = RESISTANCE + 1j * w * INDUCTANCE + semi * np.sqrt(1j * w)
    back = 1j * w * FORCE_FACTOR
    coil = COIL + base if is_glued and np.isfinite(base) else COIL
    equations = np.array(
        [
            [circuit, back, -back],
            [-FORCE_FACTOR, spring - w**2 * coil, -spring],
            [FORCE_FACTOR, -spring, spring - w**2 * MAGNET],
        ]
    )
    if is_glued and not np.isfinite(base):
        equations = equations[np.ix_([0, 2], [0, 2])]
    right = np.zeros(len(equations))
    right[0] = 1
    return complex(1 / np.linalg.solve(equations, right)[0])


def run(rng: np.random.Generator, *, is_glued: bool, noise: float, **parts: float) -> np.ndarray:
    """The impedance with noise, relative, of each part."""
    exact = np.array([impedance(f, is_glued=is_glued, **parts) for f in F])
    drawn = rng.normal(size=(2, len(F)))
    return exact + noise * np.abs(exact) * (drawn[0] + 1j * drawn[1])


TRUE = {
    "resonance": np.sqrt(STIFFNESS / MAGNET) / (2 * np.pi),
    "q": np.sqrt(STIFFNESS * MAGNET) / DAMPING,
    "q_es": np.sqrt(STIFFNESS * MAGNET) * RESISTANCE / FORCE_FACTOR**2,
    "resistance": RESISTANCE,
    "inductance": INDUCTANCE,
    "coil_mass": COIL,
    "weight": MAGNET,
    "stiffness": STIFFNESS,
    "force_factor": FORCE_FACTOR,
}


@pytest.mark.parametrize(
    ("series_error", "input_error", "draws", "within"),
    [
        pytest.param(0.0, 0.0, 50, (41, 49), id="few"),
        pytest.param(0.0, 0.0, 200, (172, 188), id="noise", marks=pytest.mark.long),
        pytest.param(0.05, 0.01, 200, (172, 196), id="bounds", marks=pytest.mark.long),
    ],
)
def test_parts_are_within_their_intervals_in_nine_of_ten_draws(
    series_error: float, input_error: float, draws: int, within: tuple[int, int]
) -> None:
    """Noise of 0.1 %, a scale of 0.1 g, glued to 300 g; resistor and inputs anywhere within bounds.

    Of 200 draws 180 ± 2 sigma are expected of noise, of 50 45 ± 2 sigma; 190 ± 2 sigma at most of
    a bound alone, of whose half width 1.645 / sqrt 3 = 0.95 are within.
    Inputs measure S (g V_1 / V_2 - 1) of the circuit's own voltages, V_1 / V_2 = Z / (s S) + 1.
    """
    exact = [
        np.array([impedance(f, is_glued=is_glued, base=BASE) for f in F])
        for is_glued in (False, True)
    ]
    inside = dict.fromkeys(TRUE, 0)
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        resistor = SERIES * (1 + series_error * rng.uniform(-1, 1))
        gain = 1 + input_error * rng.uniform(-1, 1)
        runs = []
        for each in exact:
            drawn = rng.normal(size=(2, len(F)))
            noisy = each + 1e-3 * np.abs(each) * (drawn[0] + 1j * drawn[1])
            runs.append(fit_circuit(F, SERIES * (gain * (noisy / resistor + 1) - 1), what="run"))
        weight, base = np.array([WEIGHT, BASE]) + SCALE * rng.normal(size=2)
        bench = ImpedanceSetup(weight, None, base, SCALE, SERIES, series_error, input_error)
        for name, (value, width) in exciter_values(*runs, bench).items():
            inside[name] += abs(value - TRUE[name]) <= width
    assert all(within[0] <= count <= within[1] for count in inside.values()), inside


def test_parts_are_those_of_the_circuit() -> None:
    """Without noise, each to 0.01 %: glued to something heavy or light, and of either run alone.

    Of the free run alone a rig's stiffness is the true one, by its resonance and the coil's mass.
    """
    rng = np.random.default_rng(0)
    free, glued, light = (
        fit_circuit(F, run(rng, is_glued=is_glued, base=base, noise=1e-9), what="run")
        for is_glued, base in ((False, np.inf), (True, np.inf), (True, BASE))
    )
    for circuit, base in ((glued, np.inf), (light, BASE)):
        both = exciter_values(free, circuit, ImpedanceSetup(WEIGHT, base=base))
        assert {name: value for name, (value, _) in both.items()} == pytest.approx(TRUE, rel=1e-4)
    alone = exciter_values(None, glued, ImpedanceSetup(MAGNET))
    assert alone["force_factor"][0] == pytest.approx(FORCE_FACTOR, rel=1e-4)
    assert "coil_mass" not in alone
    hanging = exciter_values(free, None, ImpedanceSetup(WEIGHT, COIL))
    of_coil = {
        "resonance": np.sqrt(STIFFNESS / COIL) / (2 * np.pi),
        "q": np.sqrt(STIFFNESS * COIL) / DAMPING,
        "q_es": np.sqrt(STIFFNESS * COIL) * RESISTANCE / FORCE_FACTOR**2,
    }
    assert {name: value for name, (value, _) in hanging.items()} == pytest.approx(
        TRUE | of_coil, rel=1e-4
    )
    assert "weight" not in exciter_values(free, None, ImpedanceSetup())


def test_eddy_currents_are_no_error_of_the_parts() -> None:
    """A semi-inductance of 0.01 ohm s^0.5, 0.8 ohm at 1 kHz: what moves is found as without it."""
    rng = np.random.default_rng(1)
    glued = fit_circuit(F, run(rng, is_glued=True, noise=1e-4, semi=0.01), what="run")
    found = exciter_values(None, glued, ImpedanceSetup(MAGNET))
    assert glued["semi_inductance"] == pytest.approx(0.01, rel=0.01)
    for name in ("resonance", "q", "resistance", "force_factor"):
        assert found[name][0] == pytest.approx(TRUE[name], rel=2e-3)
    at_300 = INDUCTANCE + 0.01 * np.sin(np.pi / 4) / np.sqrt(2 * np.pi * 300)
    assert found["inductance"][0] == pytest.approx(at_300, rel=5e-3)


def test_what_is_no_exciter_is_refused() -> None:
    """Open, short, a resistor, runs exchanged, runs of two exciters, masses: each by its cause."""
    rng = np.random.default_rng(2)
    for values, cause in (
        (np.full(len(F), 1e5 + 0j), "open or short"),
        (np.full(len(F), 0.01 + 0j), "open or short"),
        (8 * (1 + 1e-3 * rng.normal(size=len(F))) + 0j, "resonance"),
    ):
        with pytest.raises(InputError, match=cause):
            fit_circuit(F, values, what="run")
    free, glued = (
        fit_circuit(F, run(rng, is_glued=is_glued, noise=1e-4), what="run")
        for is_glued in (False, True)
    )
    with pytest.raises(InputError, match="exchanged"):
        exciter_values(glued, free, ImpedanceSetup(WEIGHT))
    other = fit_circuit(
        F, RESISTANCE + 2 * (run(rng, is_glued=True, noise=1e-4) - RESISTANCE), what="run"
    )
    with pytest.raises(InputError, match="one exciter"):
        exciter_values(free, other, ImpedanceSetup(WEIGHT))
    with pytest.raises(InputError, match="--coil-mass follows"):
        exciter_values(free, glued, ImpedanceSetup(WEIGHT, COIL))
    with pytest.raises(InputError, match="--weight is missing"):
        ImpedanceSetup(base=BASE)
    with pytest.raises(InputError, match="must be below --weight"):
        ImpedanceSetup(COIL, WEIGHT)


IMPEDANCE_RATE = 48_000
EXCITER_GRAMS = 1e3 * (ExciterCircuit.COIL + ExciterCircuit.MAGNET)  # g
PARTS = {
    "resistance": ExciterCircuit.RESISTANCE,
    "force_factor": ExciterCircuit.FORCE_FACTOR,
    "coil_mass": ExciterCircuit.COIL,
    "weight": ExciterCircuit.MAGNET,
    "resonance": np.sqrt(ExciterCircuit.STIFFNESS / ExciterCircuit.MAGNET) / (2 * np.pi),
    "q": np.sqrt(ExciterCircuit.STIFFNESS * ExciterCircuit.MAGNET) / ExciterCircuit.DAMPING,
}


class MemoryCard(SoundCard):
    """The circuit as a sound card; inputs: which of its two voltages each has, run by run."""

    def __init__(self, circuit: ExciterCircuit, *inputs: Sequence[int]) -> None:
        self.circuit, self.name, self.rate, self.gaps = circuit, "memory", float(IMPEDANCE_RATE), 0
        self.inputs = iter(inputs or [(0, 1)])

    def run(self, played: FloatArray) -> Float32Array:
        """Advance the circuit."""
        return self.circuit.advance(played)[:, list(next(self.inputs))].astype(np.float32)

    def close(self) -> None:
        """Nothing is open."""


def measured(
    monkeypatch: pytest.MonkeyPatch, card: SoundCard, *arguments: object, typed: str = ""
) -> tuple[int, str]:
    """Exit status of the command with a card in memory, and its last line."""
    monkeypatch.setattr("era_haptics.lab.measuring.sound_card.open_card", lambda *_, **__: card)
    words = ["--impedance", "--device", "x", "--json", *map(str, arguments)]
    done = CliRunner().invoke(app, words, input=typed)
    return done.exit_code, done.stdout.splitlines()[-1] if done.stdout else str(done.exception)


def test_parts_come_from_two_runs_and_a_scale(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Free with two inputs, glued with one that is moved: each part to 1 %, of the true circuit.

    A resistor within 5 % and inputs within 1 % leave the 4.3 ohm of the free run within
    1.645 / sqrt 3 times the root of (0.05 x 4.3)² + (0.01 x 14.3)²: 0.245 ohm.
    """
    free, glued = tmp_path / "free.csv", tmp_path / "glued.csv"
    circuit = ExciterCircuit(is_glued=False, rate=IMPEDANCE_RATE)
    status, told = measured(monkeypatch, MemoryCard(circuit), "-o", free)
    assert status == 0
    width = json.loads(told)["values"]["resistance"]["half_width_90"]
    assert width == pytest.approx(0.245, abs=0.001)
    circuit = ExciterCircuit(is_glued=True, rate=IMPEDANCE_RATE)
    status, told = measured(
        monkeypatch, MemoryCard(circuit, [0], [1]), "-o", glued, "--free", free, "--weight",
        EXCITER_GRAMS, "--inputs", "1", "--series-error", "0.1", typed="\n\n",
    )  # fmt: skip
    assert status == 0
    _check(json.loads(told))
    for more in (("--glued", str(glued)), ("--coil-mass", str(1e3 * ExciterCircuit.COIL))):
        done = CliRunner().invoke(
            app, ["--impedance", "--free", str(free), "--weight", "110.9", *more]
        )
        assert done.exit_code == 0
        # The printed keys, pasted into a rig.
        keys = [
            line.partition("#")[0].strip()
            for line in done.stdout.splitlines()
            if line[:4] == "    "
        ]
        rig = parse_rig("pasted.yaml", exciter_rig_text(", ".join([*keys, "power: 1 W"])))
        exciter = {
            "stiffness": ExciterCircuit.STIFFNESS,
            "damping": ExciterCircuit.DAMPING,
            "force_factor": ExciterCircuit.FORCE_FACTOR,
            "coil_mass": ExciterCircuit.COIL,
            "magnet_mass": ExciterCircuit.MAGNET,
            "inductance": ExciterCircuit.INDUCTANCE,
            "resistance": ExciterCircuit.RESISTANCE,
        }
        found = {name: getattr(rig.eras[0], name) for name in exciter}
        assert found == pytest.approx(exciter, rel=0.01)


def test_a_light_base_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By 300 g the stiffness is 1 / (1 + 110.9 / 300) of that by a stone, and f the root of it."""
    card = MemoryCard(ExciterCircuit(is_glued=True, rate=IMPEDANCE_RATE))
    measured(monkeypatch, card, "-o", tmp_path / "z.csv")
    arguments = ["--impedance", "--glued", str(tmp_path / "z.csv"), "--weight", "110.9"]
    told = CliRunner().invoke(app, arguments).stdout
    assert "by --base 300 grams: resonance -15 %, stiffness -27 %" in told
    values = []
    for more in ((), ("--base", "300")):
        found = json.loads(CliRunner().invoke(app, [*arguments, "--json", *more]).stdout)
        values.append(found["values"]["stiffness"]["value"])
    assert values[1] / values[0] == pytest.approx(1 / (1 + 110.9 / 300), rel=1e-3)
    assert not found["change_by_light_base"]


def test_wrong_circuits_write_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Inputs exchanged; an input without a cable; both by their cause."""
    output = tmp_path / "z.csv"
    for inputs, cause in (((1, 0), "first input is before"), ((0, 0), "open or short circuit")):
        card = MemoryCard(ExciterCircuit(is_glued=True, rate=IMPEDANCE_RATE), inputs)
        status, message = measured(monkeypatch, card, "-o", output)
        assert status == 1  # of the runner; the program makes 2 of it
        assert cause in message
    assert not output.exists()


def _check(told: dict[str, dict[str, dict[str, float]]]) -> None:
    values = told["values"]
    for name, true in PARTS.items():
        assert values[name]["value"] == pytest.approx(true, rel=0.01), name
        assert values[name]["half_width_90"] < 0.01 * true


def _impedance(frequency: float) -> complex:
    """A voice coil at a resonance of 80 Hz [ohm]."""
    return 4 + 2j * np.pi * frequency * 1e-4 + 12 / (1 + 3j * (frequency / 80 - 80 / frequency))


ROWS = [(f, _impedance(f)) for f in np.geomspace(10, 1000, 60).tolist()]


def _written(form: str, above: str = "", *, comma: bool = False, unit: float = 1.0) -> str:
    """A file of lines of a form, below others; comma: with decimal commas; unit: of ohms."""
    lines = [
        form.format(
            f=f"{f:.4f}",
            k=f"{1e-3 * f:.7f}",
            z=f"{abs(z) / unit:.7f}",
            d=f"{np.degrees(np.angle(z)):.5f}",
            a=f"{np.angle(z):.7f}",
            r=f"{z.real / unit:.7f}",
            x=f"{z.imag / unit:.7f}",
        )
        for f, z in ROWS
    ]
    text = "\n".join(lines)
    return above + (text.replace(".", ",") if comma else text) + "\n"


@pytest.mark.parametrize(
    "text",
    [
        _written("{f} {z} {d}"),
        _written("{f}\t{z}\t{d}", "* Freq(Hz)\tZ(Ohm)\tPhase(deg)\n"),
        _written("{f}, {z}, {d}", "* Saved at 28.11.\n* Freq(Hz), Z(Ohms), Phase(degrees)\n"),
        _written("{f} {z} {d}", "* Freq(Hz), Z(Ohms), Phase(degrees)\n"),
        _written("{f} {z} {d}", "* Freq(Hz), Z(Ohms), Phase(degrees)\n", comma=True),
        _written(" {f}   {z}  {d} ", "Freq [Hz]   Magn [Ohm]   Phase [deg]\n"),
        _written("{f};{z};{d}", "Frequenz;Betrag (Ohm);Phase (\N{DEGREE SIGN})\n", comma=True),
        _written("{k};{z};{a}", "Freq (kHz);|Z| (kOhm);Phase (rad)\n", unit=1e3),
        _written("{f},{z},{d}", "Frequency,Impedance\n\nHz,m\N{OHM SIGN},deg\n", unit=1e-3),
        _written("{f},{r},{x}", "Frequency (Hz),R (ohm),X (ohm)\n"),
        _written("{f},{x},{r}", "frequency_hz,imag_ohm,real_ohm\n"),
        _written("{f}\t{r}\t{x}", "\N{BYTE ORDER MARK}! VNA\r\nfreq[Hz]\tre:Z\tim:Z\r\n"),
        _written("{f},{z},{d},{r},{x}", "f,|Z|,Phase(deg),Real,Imag\n"),
        _written('"{f}";"{z}";"{d}"', "sep=;\nf/Hz;Z/Ohm;phi/deg\n", comma=True),
    ],
    ids=[
        "no header", "tabs", "REW", "REW with spaces", "REW with decimal commas", "LIMP", "German",
        "kHz and rad", "milliohms", "parts", "parts in reverse", "VNA", "all", "quoted",
    ],
)  # fmt: skip
def test_impedance_of_other_programs_is_read_by_its_meaning(tmp_path: Path, text: str) -> None:
    """Remarks, separators, decimal commas, units and parts as they have them: the coil's values."""
    path = tmp_path / "coil.zma"
    path.write_text(text, encoding="utf-8")
    frequencies, impedance = read_impedance(path)
    assert frequencies == pytest.approx([f for f, _ in ROWS], rel=1e-4)
    assert impedance == pytest.approx(np.array([z for _, z in ROWS]), rel=1e-4)
