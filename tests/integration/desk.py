"""A desk of real processes: jackd, a plate, and the commands that a user types.

One plate goes from the first measurement to touches. While daemon and software amplifier play,
a JACK client records every sample of the accelerometers. Fitted values are
compared with the truth of the plate on the desk.
"""

import contextlib
import csv
import itertools
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from controller.api.client import Client
from controller.api.jsonrpc import RpcError
from controller.api.link import Unreachable
from controller.api.methods import StatusResult
from kit.desk_plate import Actuator
from model.arrays import ComplexArray, FloatArray
from model.finger import detection_threshold
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from processes.jack_recorder import Capture
from processes.sound_cards import JACK_PRIORITY, soft_amp_program

ERA = Path(sys.executable).with_name("era")
_ROOT = Path(__file__).parents[2]
_PROGRAM = _ROOT / "tests" / "programs" / "desk_plate.py"
PLATE = (sys.executable, str(_PROGRAM), "rig.yaml", "--sensors", "sensors.csv")
EXAMPLES = _ROOT / "examples" / "desk"
RATE, BLOCK = 48_000, 512
"""Hz, and frames: the most that an amplifier may take, for a machine without real-time priority."""

DEVICE = "desk, JACK"
"""The plate, for PortAudio."""

_START = 60.0  # s; on a busy machine
_END = 20.0  # s
_COMMAND = 900.0  # s
Place = tuple[float, float]

_numbers = itertools.count()


class Desk:
    """A running JACK server and its plate, in a folder with the example's rig and sensors."""

    def __init__(
        self, folder: Path, environment: Mapping[str, str], plate: "subprocess.Popen[str]"
    ) -> None:
        self.folder, self.environment = folder, dict(environment)
        self._plate = plate

    def run(self, *arguments: object, status: int | None = 0) -> dict[str, Any]:
        """Run an `era` command with --json; None: any exit status. Raises RuntimeError."""
        done = subprocess.run(
            [str(ERA), *map(str, arguments), "--json"],
            capture_output=True,
            text=True,
            cwd=self.folder,
            env=self.environment,
            timeout=_COMMAND,
            check=False,
        )
        if status is not None and done.returncode != status:
            raise RuntimeError(
                f"era {' '.join(map(str, arguments))}: status {done.returncode}: {done.stderr}"
            )
        printed: dict[str, Any] = json.loads(done.stdout)
        return printed

    def touch_plate(self, fingers: Sequence[Place]) -> None:
        """Put fingers on the plate at positions [m]."""
        self._change({"fingers": list(fingers)})

    def _change(self, request: Mapping[str, object]) -> None:
        """Change the plate, and wait for its reply; raises RuntimeError if it has ended."""
        assert self._plate.stdin is not None
        assert self._plate.stdout is not None
        self._plate.stdin.write(json.dumps(request) + "\n")
        self._plate.stdin.flush()
        if not self._plate.stdout.readline():
            log = (self.folder / "desk.log").read_text("utf-8", "replace")
            raise RuntimeError(f"the plate ended: {log}")

    @property
    def truth(self) -> dict[str, Any]:
        """What the plate really is."""
        truth: dict[str, Any] = json.loads((self.folder / "truth.json").read_text("utf-8"))
        return truth


@contextlib.contextmanager
def desk(folder: Path, *, seed: int, mesh: str = "8x6 Q3") -> Iterator[Desk]:
    """A desk with a plate of its own; seed: of its deviations."""
    name = f"desk{os.getpid()}-{next(_numbers)}"  # several plates may be on desks at once
    environment = os.environ | {
        "JACK_DEFAULT_SERVER": name,
        "JACK_NO_START_SERVER": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    link = folder / "amp"
    rig = (EXAMPLES / "rig.yaml").read_text("utf-8")
    (folder / "rig.yaml").write_text(rig.replace("/tmp/plate", str(link)), "utf-8")
    shutil.copy(EXAMPLES / "sensors.csv", folder)
    server = ["jackd", "-n", name, "-S", *JACK_PRIORITY]
    server += ["-d", "dummy", "-p", str(BLOCK), "-r", str(RATE)]
    plate = [*PLATE, "--seed", seed, "--mesh", mesh, "--truth", "truth.json", "--until-eof"]
    with contextlib.ExitStack() as stack:
        log = stack.enter_context((folder / "desk.log").open("w"))
        running(stack, server, folder, environment, log)
        process = _plate(stack, plate, folder, environment, log)
        yield Desk(folder, environment, process)


def _plate(
    stack: contextlib.ExitStack,
    command: Sequence[object],
    folder: Path,
    environment: Mapping[str, str],
    log: IO[str],
) -> "subprocess.Popen[str]":
    """Start the plate as soon as the server is up."""
    end = time.monotonic() + _START
    while True:
        process = running(stack, command, folder, environment, log)
        assert process.stdout is not None
        if process.stdout.readline():
            return process
        if time.monotonic() > end:
            raise RuntimeError(f"no JACK server: {(folder / 'desk.log').read_text('utf-8')}")
        time.sleep(0.2)


def running(
    stack: contextlib.ExitStack,
    command: Sequence[object],
    folder: Path,
    environment: Mapping[str, str],
    log: IO[str],
) -> "subprocess.Popen[str]":
    """A process that ends with the stack: at the end of its input, or terminated."""
    process = stack.enter_context(
        subprocess.Popen(
            list(map(str, command)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            cwd=folder,
            env=environment,
        )
    )

    def end() -> None:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        if "--until-eof" not in command:
            process.terminate()
        try:
            process.wait(_END)
        except subprocess.TimeoutExpired:
            process.kill()

    stack.callback(end)
    return process


@dataclass(frozen=True)
class Error:
    """Difference of a fitted value from the truth.

    Relative to the truth, of a bolt to the plate's mass on each ERA; of a position in m, of a phase
    in radians. All are per mass of the plate, which no response shows.
    """

    kind: str
    size: float


_TOUCHES_START = 180.0  # s; on a busy machine
REPEAT = 0.05  # s; a contact that is not confirmed is lifted
_SETTLING, _WINDOW = 1.5, 1.0  # s


@dataclass(frozen=True)
class Touch:
    """A touch among quiet fingers: felt contrast [dB] that the daemon promised, and measured."""

    fingers: int
    promised_db: float
    predicted_db: float
    measured_db: float


def touches(desk: Desk, sets: list[list[str]]) -> list[Touch]:
    """Touch sets of sensors' places, the target first, with fingers that weigh on the plate."""
    with (desk.folder / "sensors.csv").open() as lines:
        rows = list(csv.DictReader(lines))
    places = {row["sensor"]: (float(row["x_m"]), float(row["y_m"])) for row in rows}
    inputs = {row["sensor"]: int(row["input"]) - 1 for row in rows}
    drawn = []
    with playing(desk, level_db_sl=30) as era, era.armed("desk", lease_s=60):
        server = desk.environment["JACK_DEFAULT_SERVER"]
        capture = Capture(server, "touches", max(inputs.values()) + 1)
        capture.connect("desk")
        for names in sets:
            target, *quiet = (places[name] for name in names)
            desk.touch_plate([target, *quiet])
            status = hold(era, [*quiet, target], _SETTLING)
            count = round(_WINDOW * capture.rate)
            end = capture.position + count
            while capture.position < end:
                era.touch([*quiet, target])
                time.sleep(0.02)
            heard = capture.samples(count).astype(float)
            era.touch([])
            assert status.promised_contrast_db is not None
            assert status.predicted_contrast_db is not None
            samples = heard[:, [inputs[name] for name in names]]
            target_size, *quiet_sizes = sizes(samples, status, capture.rate)
            drawn.append(
                Touch(
                    len(names),
                    status.promised_contrast_db,
                    status.predicted_contrast_db,
                    float(20 * np.log10(target_size / max(quiet_sizes))),
                )
            )
        capture.close()
    return drawn


@contextlib.contextmanager
def playing(desk: Desk, *, level_db_sl: float) -> Iterator[Client]:
    """Software amplifier and daemon, which play what is calibrated and in the table once armed."""
    socket = desk.folder / "era.sock"
    config = (
        f"rig: calibrated.yaml\ntable: table.npz\nsocket: era.sock\nlevel_db_sl: {level_db_sl}\n"
    )
    (desk.folder / "daemon.yaml").write_text(config, "utf-8")
    options = ["--device", DEVICE, "--channels", 4, "--link", desk.folder / "amp", "--until-eof"]
    amplifier = [*soft_amp_program(is_watched=False), *options]
    daemon = [ERA, "daemon", "daemon.yaml"]
    with contextlib.ExitStack() as stack:
        log = stack.enter_context((desk.folder / "touches.log").open("w"))
        started = running(stack, amplifier, desk.folder, desk.environment, log)
        assert started.stdout is not None
        started.stdout.readline()
        running(stack, daemon, desk.folder, desk.environment, log)
        era = stack.enter_context(connected(socket))
        try:
            until_ready(era)
            yield era
        except BaseException:
            sys.stderr.write((desk.folder / "touches.log").read_text("utf-8"))
            raise


def connected(socket: Path) -> Client:
    """A client of the daemon, as soon as it serves."""
    end = time.monotonic() + _TOUCHES_START
    while True:
        try:
            return Client.connect(socket)
        except (Unreachable, OSError):
            if time.monotonic() > end:
                raise
            time.sleep(0.1)


def until_ready(era: Client) -> None:
    """Acknowledge what is left of before, until it can be armed."""
    end = time.monotonic() + _TOUCHES_START
    while era.status().state != "READY_TO_SWITCH_ON":
        if time.monotonic() > end:
            raise RuntimeError(f"the daemon is not ready: {era.status().state}")
        with contextlib.suppress(RpcError):
            era.clear()
        time.sleep(0.1)


def hold(era: Client, places: list[Place], seconds: float) -> StatusResult:
    """Hold fingers for some time, and until something plays; return what does."""
    begin = time.monotonic()
    while True:
        era.touch(places)
        held = time.monotonic() - begin
        if held > seconds and (status := era.status()).drive:
            return status
        if held > seconds + _TOUCHES_START:
            raise RuntimeError(f"nothing plays for fingers at {places}: {status.silence_reason}")
        time.sleep(REPEAT)


def sizes(samples: FloatArray, status: StatusResult, rate: float) -> FloatArray:
    """What is felt in samples (n, points) [m/s²] of what plays, relative to the threshold."""
    frequencies = np.unique([tone.frequency_hz for tone in status.drive.values()])
    angles = 2 * np.pi * np.outer(np.arange(len(samples)) / rate, frequencies)
    basis = np.hstack([np.sin(angles), np.cos(angles)])
    fitted = np.linalg.lstsq(basis, samples)[0]
    felt = np.hypot(*np.split(fitted, 2)) / detection_threshold(frequencies)[:, None]
    return np.asarray(np.linalg.norm(felt, axis=0))


def identified_errors(rig: Rig, truth: dict[str, Any]) -> list[Error]:
    """Return the errors of each ERA of an identified rig.

    Gain and phase are relative to the mean of all drives, at the worst frequency.
    """
    mass = truth["thickness_m"] / rig.plate.thickness  # of the true plate by the identified
    errors = []
    for era, drive in zip(rig.eras, _drives(rig, truth), strict=True):
        true = truth["eras"][era.name]
        worst = int(np.abs(np.log(np.abs(drive))).argmax())
        errors += [
            Error("stiffness", mass * era.stiffness / true["stiffness"] - 1),
            Error("damping", mass * era.damping / true["damping"] - 1),
            Error("place", math.dist((era.x, era.y), true["at_m"])),
            Error("gain", float(np.abs(drive)[worst] - 1)),
            Error("phase", float(np.abs(np.angle(drive)).max())),
        ]
    return errors


def _drives(rig: Rig, truth: dict[str, Any]) -> list[ComplexArray]:
    """Identified over true gain of each drive at frequencies, relative to the mean of all."""
    frequencies = np.arange(rig.limits.frequency_min, rig.limits.frequency_max + 1, 10.0)
    ratios = []
    for era in rig.eras:
        true = truth["eras"][era.name]
        actuator = Actuator(true["resonance_hz"], true["damping_ratio"], true["gain"])
        ratios.append(era.gain(frequencies) / actuator.response(frequencies))
    logarithms = np.log(ratios)
    return list(np.exp(logarithms - logarithms.mean()))


@dataclass(frozen=True)
class Session:
    """Results of one plate, from its measurement to touches."""

    held_out_error: float
    calibrated: tuple[Error, ...]
    identified: tuple[Error, ...]
    touches: tuple[Touch, ...]


def session(*, seed: int, touched: int) -> Session:
    """Measure, calibrate, build a table, identify, touch; raises RuntimeError."""
    with tempfile.TemporaryDirectory(prefix="desk") as name, desk(Path(name), seed=seed) as plate:
        device = ["--device", DEVICE, "--sensors", "sensors.csv"]
        plate.run("measure", "rig.yaml", *device, "-o", "measured.uff")
        fitted = plate.run("calibrate", "rig.yaml", "measured.uff", "-o", "calibrated.yaml")
        plate.run("table", "build", "calibrated.yaml", "-o", "table.npz", "--mode", "phased")
        # Identified before fingers weigh on the plate.
        plate.run("rig", "identify", "rig.yaml", *device, "-o", "identified.yaml", "--yes")
        identified = load_rig(plate.folder / "identified.yaml")
        return Session(
            held_out_error=fitted["held_out"]["error_after"],
            calibrated=tuple(_calibrated_errors(plate.truth, fitted)),
            identified=tuple(identified_errors(identified, plate.truth)),
            touches=tuple(touches(plate, _random_sets(touched, seed))),
        )


def _calibrated_errors(truth: dict[str, Any], fitted: dict[str, Any]) -> Iterator[Error]:
    """Yield the errors of the fitted values."""
    mass = truth["thickness_m"] / 1.5e-3  # of the true plate by the rig's
    share = 0.3048 * 0.2286 * 1.5e-3 * 2700 / 4  # kg of the plate on each ERA
    for row in fitted["parameters"]:
        kind, value = row["kind"], row["after"]
        if row["standard_error"] is None:
            continue
        if kind == "modulus":
            rigidity = value * 1.5e-3**3 / (12 * (1 - 0.33**2))
            true_rigidity = truth["flexural_rigidity_n_m"] / mass
            yield Error("rigidity", rigidity / true_rigidity - 1)
        elif kind == "loss_factor":
            yield Error(kind, value / truth[kind] - 1)
        else:
            true_value = truth["eras"][row["era"]][kind] / mass
            scale = share if kind == "bolt_mass" else true_value
            yield Error(kind, (value - true_value) / scale)


def _random_sets(count: int, seed: int) -> list[list[str]]:
    """Sets of two and three sensors, the target first."""
    rng = np.random.default_rng([seed, 2])
    names = [f"P{number}" for number in range(1, 13)]
    return [list(map(str, rng.choice(names, 2 + k % 2, replace=False))) for k in range(count)]
