"""A desk of real processes: jackd, a plate, and the commands that a user types.

One plate goes from the first measurement to touches: what a user types, and what came of it.
Touches are felt while daemon and software amplifier play and accelerometers record, by a JACK
client that keeps every sample it gets, with a callback in C. A rig that `era rig identify` wrote is
held against the truth of the plate on the desk.
"""

import contextlib
import csv
import itertools
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from benchmarks.desk_plate.desk_plate import Actuator
from controller.api.client import Client
from controller.api.jsonrpc import RpcError
from controller.api.link import Unreachable
from controller.api.methods import StatusResult
from drivers.errors import LinkError
from era_haptics.lab.measuring.sound_card import SoundCard, open_card
from model.arrays import Float32Array, FloatArray
from model.finger import detection_threshold
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from sim.soft_amp.jack import JackClient

ERA = Path(sys.executable).with_name("era")
PLATE = (sys.executable, "-m", "benchmarks.desk_plate", "rig.yaml", "--sensors", "sensors.csv")
EXAMPLES = Path(__file__).parents[2] / "examples" / "desk"
RATE, BLOCK = 48_000, 512
"""Hz, and frames: the most that an amplifier may take, for a machine without real-time priority."""

_START = 60.0  # s; on a busy machine
_END = 20.0  # s
_COMMAND = 900.0  # s
_TRIES = 2  # of a place

Place = tuple[float, float]

_numbers = itertools.count()


class Desk:
    """A running JACK server and its plate, in a folder with the example's rig and sensors."""

    def __init__(
        self, folder: Path, environment: Mapping[str, str], plate: "subprocess.Popen[str]"
    ) -> None:
        self.folder, self.environment = folder, dict(environment)
        self._plate = plate
        self._said = self._answered = 0

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
        found: dict[str, Any] = json.loads(done.stdout)
        return found

    def touch_plate(self, fingers: Sequence[Sequence[float]]) -> None:
        """Put fingers on the plate: x and y of each [m], and the factor of its load if any."""
        self._change({"fingers": list(fingers)})

    def begin_feeling(self, seconds: float) -> None:
        """Keep for some time what the fingers feel; nothing else may change meanwhile."""
        self._say({"feel": seconds, "file": str(self.folder / "felt.npy")})

    def felt(self) -> FloatArray:
        """What they felt (n, k, p) [m/s²], as `DeskPlate.felt`."""
        self._answer()
        return np.asarray(np.load(self.folder / "felt.npy"))

    def log_count(self, word: str) -> int:
        """How many lines of the server and the plate have a word."""
        return (self.folder / "desk.log").read_text("utf-8", "replace").count(word)

    def measure_by_moving(self, *arguments: object) -> int:
        """Run `era measure` with one sensor, which is moved as it says; raises RuntimeError.

        Return how often a place was not kept: it is measured again once, and then skipped.
        """
        with subprocess.Popen(
            [str(ERA), "measure", *map(str, arguments)],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            bufsize=1,
            cwd=self.folder,
            env=self.environment,
        ) as process:
            assert process.stdin is not None
            assert process.stderr is not None
            said = ""
            while letter := process.stderr.read(1):
                said += letter
                if said.endswith("then Enter: "):
                    place = said.rpartition("sensor at ")[2].split(",")[0]
                    self._change({"sensor": place})
                    is_refused = said.count(f"{place} is not kept") >= _TRIES
                    process.stdin.write("s\n" if is_refused else "\n")
                    process.stdin.flush()
        if process.returncode:
            raise RuntimeError(f"era measure: status {process.returncode}: {said}")
        return said.count(" is not kept: ")

    def _change(self, what: Mapping[str, object]) -> None:
        self._say(what)
        self._answer()

    def _say(self, what: Mapping[str, object]) -> None:
        assert self._plate.stdin is not None
        self._plate.stdin.write(json.dumps(what) + "\n")
        self._plate.stdin.flush()
        self._said += 1

    def _answer(self) -> None:
        """Wait until the plate has done all that was said; raises RuntimeError if it has ended."""
        assert self._plate.stdout is not None
        while self._answered < self._said:
            if not self._plate.stdout.readline():
                log = (self.folder / "desk.log").read_text("utf-8", "replace")
                raise RuntimeError(f"the plate ended: {log}")
            self._answered += 1

    @property
    def truth(self) -> dict[str, Any]:
        """What the plate really is."""
        found: dict[str, Any] = json.loads((self.folder / "truth.json").read_text("utf-8"))
        return found


@contextlib.contextmanager
def desk(
    folder: Path,
    *,
    seed: int,
    mesh: str = "8x6 Q3",
    rig: str | None = None,
    sensors: str | None = None,
    options: Sequence[str] = (),
) -> Iterator[Desk]:
    """A desk with a plate of its own; seed: of its deviations.

    rig, sensors: content of other files than the example's; options: further ones of the plate.
    """
    name = f"desk{os.getpid()}-{next(_numbers)}"  # several plates may be on desks at once
    environment = os.environ | {
        "JACK_DEFAULT_SERVER": name,
        "JACK_NO_START_SERVER": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    link = folder / "amp"
    text = (EXAMPLES / "rig.yaml").read_text("utf-8") if rig is None else rig
    (folder / "rig.yaml").write_text(text.replace("/tmp/plate", str(link)), "utf-8")
    given = (EXAMPLES / "sensors.csv").read_text("utf-8") if sensors is None else sensors
    (folder / "sensors.csv").write_text(given, "utf-8")
    server = ["jackd", "-n", name, "-S", "-r", "-d", "dummy", "-p", str(BLOCK), "-r", str(RATE)]
    plate = [*PLATE, "--seed", seed, "--mesh", mesh, "--truth", "truth.json", "--until-eof"]
    plate += options
    with contextlib.ExitStack() as stack:
        stack.enter_context(_own_server(name))
        log = stack.enter_context((folder / "desk.log").open("w"))
        running(stack, server, folder, environment, log)
        process = _plate(stack, plate, folder, environment, log)
        yield Desk(folder, environment, process)


@contextlib.contextmanager
def _own_server(name: str) -> Iterator[None]:
    """Let clients in this process use a server."""
    before = os.environ.get("JACK_DEFAULT_SERVER")
    os.environ["JACK_DEFAULT_SERVER"] = name
    try:
        yield
    finally:
        del os.environ["JACK_DEFAULT_SERVER"]
        if before is not None:
            os.environ["JACK_DEFAULT_SERVER"] = before


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


AUDIBLE = 1e-6
_CAPTURE_START = 20.0  # s


class Capture(SoundCard):
    """So many inputs in_1, ... of a client of JACK_DEFAULT_SERVER; longest [s] that it captures.

    It waits until the server is up. While that lives no other server can be used in this process.
    """

    def __init__(self, name: str, channels: int, *, longest: float = 600.0) -> None:
        super().__init__(outputs=0, inputs=channels, limit=0)
        self._client = open_client(name)
        self.block = self._client.block
        self._client.wire(None, inputs=channels)
        self.play_through(self._client)
        frames = round(longest * self.rate)
        self._times = np.zeros(frames // self.block + 1, dtype=np.int64)  # us
        self._transfer.arrivals = self._times.ctypes.data
        self._samples = self.start(np.zeros((frames, 0)))

    def samples(self, count: int) -> Float32Array:
        """The last samples (count, channels)."""
        return self._samples[self.position - count : self.position]

    def is_sounding(self) -> bool:
        """Whether the last block had sound."""
        return self.position > 0 and bool(np.abs(self.samples(self.block)).max() > AUDIBLE)

    def last_sound(self) -> float:
        """When the last block with sound came (monotonic, s)."""
        return 1e-6 * float(self._times[(self.end_of_sound() - 1) // self.block])

    def end_of_sound(self) -> int:
        """The position after the last sample with sound."""
        return int(self._loud(0)[-1]) + 1

    def first_sound(self, since: int) -> float:
        """When the first sample with sound from a position on was played (monotonic, s)."""
        first = int(self._loud(since)[0])
        return 1e-6 * float(self._times[first // self.block]) + first % self.block / self.rate

    def is_played_to(self, port: str) -> bool:
        """Whether a program plays to a port of the server."""
        return bool(self._client.connected_to(port))

    def _loud(self, since: int) -> "np.ndarray[tuple[int], np.dtype[np.intp]]":
        loud = np.abs(self._samples[since : self.position]).max(axis=1) > AUDIBLE
        return np.flatnonzero(loud) + since


def open_client(name: str) -> JackClient:
    """A client, as soon as the server is up."""
    end = time.monotonic() + _CAPTURE_START
    while True:
        try:
            return JackClient(name)
        except LinkError:
            if time.monotonic() > end:
                raise
            time.sleep(0.02)


_PERCENT = (100.0, " %")
_UNITS = {"place": (1e3, " mm"), "phase": (math.degrees(1), "°")}


@dataclass(frozen=True)
class Error:
    """A found value relative to the truth, bolts to the plate's share; in standard errors too.

    Per mass of the plate, which no response shows; of a place [m] and of a phase [rad] the
    difference; in_standard_errors: None where none is stated.
    """

    kind: str
    relative: float
    in_standard_errors: float | None


def errors_table(errors: Sequence[Error]) -> str:
    """Lines of a table with a row for each kind of value, in their order."""
    rows = [
        "| value | error, median | largest | intervals of 95 % that hold the truth | values |",
        "|---|---|---|---|---|",
    ]
    for kind in dict.fromkeys(one.kind for one in errors):
        some = [one for one in errors if one.kind == kind]
        scale, unit = _UNITS.get(kind, _PERCENT)
        sizes = scale * np.abs([one.relative for one in some])
        stated = [one.in_standard_errors for one in some if one.in_standard_errors is not None]
        held = f"{100 * np.mean(np.abs(stated) < 1.96):.0f} %" if stated else "–"
        rows.append(
            f"| {kind} | {np.median(sizes):.2f}{unit} | {sizes.max():.2f}{unit} | {held} "
            f"| {len(some)} |"
        )
    return "\n".join(rows)


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
    found = []
    with playing(desk, level_db_sl=30) as era, era.armed("desk", lease_s=60):
        card = open_card("jack:desk", outputs=0, inputs=max(inputs.values()) + 1, limit=0)
        for names in sets:
            target, *quiet = (places[name] for name in names)
            desk.touch_plate([target, *quiet])
            status = hold(era, [*quiet, target], _SETTLING)
            recorded = card.start(np.zeros((round(_WINDOW * card.rate), 0)))
            while card.position < len(recorded):
                era.touch([*quiet, target])
                time.sleep(0.02)
            heard = recorded.astype(float)
            era.touch([])
            assert status.promised_contrast_db is not None
            assert status.predicted_contrast_db is not None
            samples = heard[:, [inputs[name] for name in names]]
            target_size, *quiet_sizes = sizes(samples, status, card.rate)
            found.append(
                Touch(
                    len(names),
                    status.promised_contrast_db,
                    status.predicted_contrast_db,
                    float(20 * np.log10(target_size / max(quiet_sizes))),
                )
            )
        card.close()
    return found


@contextlib.contextmanager
def playing(desk: Desk, *, level_db_sl: float) -> Iterator[Client]:
    """Software amplifier and daemon, which play what is calibrated and in the table once armed."""
    socket = desk.folder / "era.sock"
    config = (
        f"rig: calibrated.yaml\ntable: table.npz\nsocket: era.sock\nlevel_db_sl: {level_db_sl}\n"
    )
    (desk.folder / "daemon.yaml").write_text(config, "utf-8")
    amplifier = [ERA, "soft-amp", "--device", "jack:desk", "--channels", 4]
    amplifier += ["--link", desk.folder / "amp", "--until-eof"]
    daemon = [ERA, "daemon", "daemon.yaml"]
    with contextlib.ExitStack() as stack:
        log = stack.enter_context((desk.folder / "touches.log").open("w"))
        started = running(stack, amplifier, desk.folder, desk.environment, log)
        assert started.stdout is not None
        started.stdout.readline()
        running(stack, daemon, desk.folder, desk.environment, log)
        era = stack.enter_context(connected(socket))
        until_ready(era)
        yield era


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


_AT_BOLT = 5e-3  # m; an additional mass nearer than that cannot be distinguished from the bolt


@dataclass(frozen=True)
class Identified:
    """What came of an identification; contrasts: one for each number of quiet fingers."""

    seed: int
    measure_s: float
    solve_s: float
    chi2: float
    held_out_error: float
    contrasts: tuple[dict[str, Any], ...]
    errors: tuple[Error, ...]


def identify(plate: Desk, *, seed: int) -> Identified:
    """Identify the plate on a desk through its sound card; raises RuntimeError."""
    told = plate.run(
        "rig", "identify", "rig.yaml", "--device", "jack:desk", "--sensors", "sensors.csv",
        "-o", "identified.yaml", "--yes",
    )  # fmt: skip
    return Identified(
        seed=seed,
        measure_s=told["measure_time_s"],
        solve_s=told["solve_time_s"],
        chi2=told["chi2"],
        held_out_error=told["held_out_error"],
        contrasts=tuple(told["expected_contrast"]),
        errors=tuple(identified_errors(load_rig(plate.folder / "identified.yaml"), plate.truth)),
    )


def identified_errors(rig: Rig, truth: dict[str, Any]) -> list[Error]:
    """Errors of all values, relative, of places [m] and of phases [rad].

    Per mass of the plate, as those of `era calibrate`; rigidity and loss with what was found of
    single modes, in their geometric mean; gains relative to the mean of all drives, at the worst
    frequency. Standard errors are those of the rig's `uncertainty`, where that states one.
    """
    plate, std = rig.plate, rig.uncertainty
    mass = truth["thickness_m"] / plate.thickness  # of the true plate relative to the identified
    eigenvalues, losses = np.exp(np.mean(np.log(np.reshape(_modes(rig), (-1, 2))), axis=0))
    scatter = math.log(std.damping)
    rigidity = mass * plate.flexural_rigidity * eigenvalues / truth["flexural_rigidity_n_m"]
    loss = plate.loss_factor * losses / truth["loss_factor"]
    found = [
        _error("rigidity", rigidity - 1, 2 * std.thickness),
        _error("loss_factor", loss - 1, scatter),
    ]
    share = plate.mass / 4
    drives = _drives(rig, truth)
    for era, drive in zip(rig.eras, drives, strict=True):
        own = truth["eras"][era.name]
        bolt = era.in_time.mass + sum(
            each.mass
            for each in rig.masses
            if math.hypot(each.x - era.x, each.y - era.y) < _AT_BOLT
        )
        worst = int(np.abs(np.log(np.abs(drive))).argmax())
        found += [
            _error("stiffness", mass * era.stiffness / own["stiffness"] - 1, std.stiffness),
            _error("damping", mass * era.damping / own["damping"] - 1, scatter),
            _error("bolt_mass", (mass * bolt - own["bolt_mass"]) / (mass * share)),
            _error("place", math.dist((era.x, era.y), own["at_m"])),
            _error("gain", float(np.abs(drive)[worst] - 1), std.gain),
            _error("phase", float(np.abs(np.angle(drive)).max()), math.radians(std.phase_deg)),
        ]
    return found


def _modes(rig: Rig) -> list[tuple[float, float]]:
    """Factors of eigenvalues and loss factors of the lowest modes."""
    return [(math.exp(a), math.exp(b)) for a, b in rig.plate.mode_deviations]


def _drives(rig: Rig, truth: dict[str, Any]) -> list[np.ndarray]:
    """Identified over true gain of each drive at frequencies, relative to the mean of all."""
    frequencies = np.arange(rig.limits.frequency_min, rig.limits.frequency_max + 1, 10.0)
    ratios = []
    for era in rig.eras:
        own = truth["eras"][era.name]
        actuator = Actuator(own["resonance_hz"], own["damping_ratio"], own["gain"])
        ratios.append(era.gain(frequencies) / actuator.response(frequencies))
    logarithms = np.log(ratios)
    return list(np.exp(logarithms - logarithms.mean()))


def _error(kind: str, size: float, std: float | None = None) -> Error:
    return Error(kind, size, None if std is None else size / std)


@dataclass(frozen=True)
class Outcome:
    """Of one plate: times [s], coherence, errors of values, promises and touches.

    errors: of what was calibrated; identified: by `era rig identify`.
    """

    seed: int
    measure_s: float
    latency_samples: float
    repeated: int
    coherence_min: float
    held_out_error: float
    errors: tuple[Error, ...]
    promises: tuple[dict[str, Any], ...]
    touches: tuple[Touch, ...]
    identified: Identified

    def as_json(self) -> dict[str, Any]:
        """For a file of results."""
        return asdict(self)


def chain(
    *, seed: int, promises: int, touched: int, frequencies: str | None = None, mode: str = "phased"
) -> Outcome:
    """Measure, calibrate, build a table, verify promises, identify, touch; raises RuntimeError."""
    with tempfile.TemporaryDirectory(prefix="desk") as name, desk(Path(name), seed=seed) as plate:
        more = [] if frequencies is None else ["--frequencies", frequencies]
        measured = plate.run(
            "measure", "rig.yaml", "--device", "jack:desk", "--sensors", "sensors.csv",
            "-o", "measured.uff", *more,
        )  # fmt: skip
        fitted = plate.run("calibrate", "rig.yaml", "measured.uff", "-o", "calibrated.yaml")
        lines = measured["frequencies_hz"]
        band = [] if frequencies is None else ["--frequencies", f"{lines[0]:g}:{lines[-1]:g}:10"]
        plate.run("table", "build", "calibrated.yaml", "-o", "table.npz", "--mode", mode, *band)
        verified = plate.run(
            "table", "verify", "table.npz", "calibrated.yaml", "--device", "jack:desk",
            "--sensors", "sensors.csv", "--samples", promises, "--seed", seed, status=None,
        )  # fmt: skip
        found = identify(plate, seed=seed)  # before fingers weigh on the plate
        felt = touches(plate, _sets(touched, seed)) if touched else []
        sensors = measured["sensors"].values()
        return Outcome(
            seed=seed,
            measure_s=measured["measure_time_s"],
            latency_samples=48_000 * measured["latency_s"],
            repeated=measured["repeated_runs"],
            coherence_min=min(each["coherence_min"] for each in sensors),
            held_out_error=fitted["held_out"]["error_after"],
            errors=tuple(_errors(plate, fitted)),
            promises=tuple(verified["promises"]),
            touches=tuple(felt),
            identified=found,
        )


def _errors(plate: Desk, fitted: dict[str, Any]) -> list[Error]:
    """All fitted values against the truth, both per mass of the plate."""
    truth = plate.truth
    mass = truth["thickness_m"] / 1.5e-3  # of the true plate relative to the rig's
    share = 0.3048 * 0.2286 * 1.5e-3 * 2700 / 4  # kg of the plate on each ERA
    found = []
    for row in fitted["parameters"]:
        if row["standard_error"] is None:
            continue
        kind, size = row["kind"], math.nan
        if kind == "modulus":
            exact, kind = truth["flexural_rigidity_n_m"] / mass, "rigidity"
            rigidity = 1.5e-3**3 / (12 * (1 - 0.33**2))
            after, error = row["after"] * rigidity, row["standard_error"] * rigidity
        elif kind == "loss_factor":
            exact, after, error = truth[kind], row["after"], row["standard_error"]
        else:
            exact = truth["eras"][row["era"]][kind] / mass
            after, error = row["after"], row["standard_error"]
            size = share if kind == "bolt_mass" else math.nan
        scale = exact if math.isnan(size) else size
        found.append(Error(kind, (after - exact) / scale, (after - exact) / error))
    return found


def _sets(count: int, seed: int) -> list[list[str]]:
    """Sets of two and three sensors, the target first."""
    rng = np.random.default_rng([seed, 2])
    names = [f"P{number}" for number in range(1, 13)]
    return [list(map(str, rng.choice(names, 2 + k % 2, replace=False))) for k in range(count)]
