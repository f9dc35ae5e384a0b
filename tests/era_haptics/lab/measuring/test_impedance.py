"""Parts of an exciter from its impedance, against the equations of coil, magnet and circuit.

`era measure --impedance` runs through a sound card in memory and through a real audio server.
"""

import json
import os
import subprocess
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.desk.session import open_client
from benchmarks.desk_plate.desk_plate import JackPlate
from era_haptics.lab.measuring.impedance import (
    ImpedanceSetup,
    exciter_values,
    fitted,
    read_impedance,
)
from era_haptics.lab.measuring.measure_cli import app
from era_haptics.lab.measuring.sound_card import SoundCard
from model.arrays import Float32Array, FloatArray
from model.errors import InputError
from model.rig.rig_file import parse_rig
from plates import exciter_rig_text
from sound_cards import ExciterCircuit, jack_server
from typed_page import ERA

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
            runs.append(fitted(F, SERIES * (gain * (noisy / resistor + 1) - 1), what="run"))
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
        fitted(F, run(rng, is_glued=is_glued, base=base, noise=1e-9), what="run")
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
    glued = fitted(F, run(rng, is_glued=True, noise=1e-4, semi=0.01), what="run")
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
            fitted(F, values, what="run")
    free, glued = (
        fitted(F, run(rng, is_glued=is_glued, noise=1e-4), what="run") for is_glued in (False, True)
    )
    with pytest.raises(InputError, match="exchanged"):
        exciter_values(glued, free, ImpedanceSetup(WEIGHT))
    other = fitted(
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


RATE = 48_000
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
        self.circuit, self.name, self.rate, self.gaps = circuit, "memory", float(RATE), 0
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
    circuit = ExciterCircuit(is_glued=False, rate=RATE)
    status, told = measured(monkeypatch, MemoryCard(circuit), "-o", free)
    assert status == 0
    width = json.loads(told)["values"]["resistance"]["half_width_90"]
    assert width == pytest.approx(0.245, abs=0.001)
    circuit = ExciterCircuit(is_glued=True, rate=RATE)
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
    card = MemoryCard(ExciterCircuit(is_glued=True, rate=RATE))
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
        card = MemoryCard(ExciterCircuit(is_glued=True, rate=RATE), inputs)
        status, message = measured(monkeypatch, card, "-o", output)
        assert status == 1  # of the runner; the program makes 2 of it
        assert cause in message
    assert not output.exists()


def _check(told: dict[str, dict[str, dict[str, float]]]) -> None:
    values = told["values"]
    for name, true in PARTS.items():
        assert values[name]["value"] == pytest.approx(true, rel=0.01), name
        assert values[name]["half_width_90"] < 0.01 * true


@pytest.mark.real_time
@pytest.mark.needs("jackd", "cc")
def test_parts_are_found_through_a_real_server(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two commands of the installed program, a simulated exciter as a client of the server."""
    name = f"coil{os.getpid()}"
    monkeypatch.setenv("JACK_DEFAULT_SERVER", name)
    with jack_server(name) as server:
        for is_glued in (False, True):
            with closing(open_client("desk")) as client:
                plate = JackPlate(client, ExciterCircuit(is_glued=is_glued, rate=RATE))  # type: ignore[arg-type]  # called by JACK
                plate.start()
                more = ("--free", "0.csv", "--weight", str(EXCITER_GRAMS)) if is_glued else ()
                done = subprocess.run(
                    [ERA, "measure", "--impedance", "--device", "jack:desk", "--json", "-o",
                     f"{is_glued:d}.csv", "--series-error", "0.1", "--input-error", "0.1", *more],
                    cwd=tmp_path, env=server.environment, capture_output=True, check=True,
                )  # fmt: skip
                plate.wait(0)
    _check(json.loads(done.stdout))


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
)  # fmt: skip
def test_impedance_of_other_programs_is_read_by_its_meaning(tmp_path: Path, text: str) -> None:
    """Remarks, separators, decimal commas, units and parts as they have them: the coil's values."""
    path = tmp_path / "coil.zma"
    path.write_text(text, encoding="utf-8")
    frequencies, impedance = read_impedance(path)
    assert frequencies == pytest.approx([f for f, _ in ROWS], rel=1e-4)
    assert impedance == pytest.approx(np.array([z for _, z in ROWS]), rel=1e-4)
