"""Contrast of any method on the project's data set: scores of patterns.

    python -m benchmarks.contrast score FILE
    python -m benchmarks.contrast export -o DIR

Prints a row of the table in the section Contrast of other methods of docs/measured/figures.md. The
data set is `localization-1.json`: plates with their rigs, and sets of fingers on them. A change is
a new version in a new file. An entry is a JSON file of patterns for these sets:

    {"benchmark": "era-localization", "version": 1, "name": "time reversal",
     "patterns": {"paper_plate/1-00": {"SW": [250, 0.8, -90.0], ...}, ...}}

A pattern has for each driven ERA the frequency [Hz], the level 0..1 of its stroke, and the phase
[degrees]: the base moves by level * stroke * sin(2 pi frequency t + phase).

The score of a set is the 10th percentile of the contrast, over plates drawn within the rig's
uncertainty and solved exactly. A set without a pattern counts 0 dB, and so does a pattern whose
target is more than 0.5 dB below the level on more than 10 % of the plates. The optimum in hindsight
maximizes this percentile (Adam, from several starts at the best frequencies), independently of the
model's search.
"""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import numpy as np
import typer
from pydantic import BaseModel, ConfigDict, ValidationError

from model.answer.answer import Layer
from model.answer.stimulus import Placement, Stimulus, together
from model.arrays import ComplexArray, FloatArray, Point
from model.commands.options import JsonOption, progress_bar
from model.config.document import parse_document
from model.errors import InputError
from model.finger import decibels
from model.processes import Progress, unseen
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Rig
from model.rig.rig_file import rig_of
from model.structure.attachments import footprints_of
from model.study.exact_plates import draw_plates, felt_on
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from model.vibration import Excitation, Tone
from registry.wording import first_problem
from sim.plant.excited_plate import play
from sim.plant.imperfections import draw_imperfections

app = typer.Typer(help="Score patterns on the contrast benchmark.")


@app.command("score")
def score_entry(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Patterns by contact set, JSON.")],
    in_time: Annotated[
        bool,
        typer.Option("--in-time", help="Also play each pattern on a plate that vibrates in time."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Score the patterns of a file on held-out plates.

    The score is the felt contrast that 90 % of the plates reach.
    """
    name, excitations = read_entry(file)
    with progress_bar("contact sets") as progress:
        scores = score(excitations, in_time=in_time, progress=progress)
    rows = summary(scores)
    if as_json:
        print(
            json.dumps(
                {
                    "name": name,
                    "version": VERSION,
                    "checksum": checksum(),
                    "rows": rows,
                    "sets": {
                        key: {
                            "contrast_db": each.contrast_db,
                            "level_db_sl": each.level_db_sl,
                            "in_time_db": each.in_time_db,
                        }
                        for key, each in scores.items()
                    },
                }
            )
        )
        return
    print(f"{name}: data set {VERSION}, sha256 {checksum()[:16]}")
    print("plate         quiet  sets  missed  nine of ten / dB  worst tenth / dB  in time / dB")
    for row in rows:
        timed = "-" if row["in_time_db"] is None else f"{row['in_time_db']:.1f}"
        print(
            f"{row['plate']:13} {row['quiet']:5d} {row['sets']:5d} {row['missed']:7d} "
            f"{row['contrast_db']:17.1f} {row['tenth_percentile_db']:17.1f} {timed:>13}"
        )


@app.command("export")
def export_data_set(
    folder: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder to write into.")
    ],
) -> None:
    """Write the data set and the rig of each plate."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in (
        (FILE.name, FILE.read_text(encoding="utf-8")),
        *((f"{each.name}.yaml", each.rig_text) for each in data_set().plates.values()),
    ):
        (folder / name).write_text(content, encoding="utf-8")
        print(f"wrote {folder / name}")


VERSION = 1
CHECKSUM = "ba4469e87f93685903c0d2095d9dc62f2ae3a56c617015744030eaefa7fc4ada"
"""SHA-256 of the data set's file."""

FILE = Path(__file__).with_name(f"localization-{VERSION}.json")


@dataclass(frozen=True)
class ContactSet:
    """Fingers [m] on a plate, the target first; number: index in the file, from 0."""

    name: str
    number: int
    contacts: tuple[Point, ...]

    @property
    def quiet_count(self) -> int:
        """Number of fingers that must feel nothing."""
        return len(self.contacts) - 1

    @property
    def placement(self) -> Placement:
        """The target and the quiet fingers."""
        return Placement(self.contacts[:1], self.contacts[1:])


@dataclass(frozen=True, eq=False)
class BenchmarkPlate:
    """A plate of the data set, its rig, and sets of fingers on it."""

    name: str
    rig: Rig
    rig_text: str
    sets: Sequence[ContactSet]


@dataclass(frozen=True, eq=False)
class DataSet:
    """The data set.

    level_db_sl: level that 90 % of plates must reach at the target; draws, seed: of held-out plates
    for each set; in_time: seeds of plates in time, used in turn.
    """

    level_db_sl: float
    draws: int
    seed: int
    in_time: Sequence[int]
    plates: Mapping[str, BenchmarkPlate]


@cache
def data_set() -> DataSet:
    """Read the data set of this version."""
    document = json.loads(FILE.read_text(encoding="utf-8"))
    plates = {}
    number = 0
    for name, plate in document["plates"].items():
        sets = []
        for key, contacts in plate["sets"].items():
            sets.append(ContactSet(key, number, tuple((x, y) for x, y in contacts)))
            number += 1
        rig = rig_of(parse_document(f"{name}.yaml", plate["rig"]))
        plates[name] = BenchmarkPlate(name, rig, plate["rig"], sets)
    held_out = document["held_out"]
    return DataSet(
        document["level_db_sl"],
        held_out["draws"],
        held_out["seed"],
        held_out["seeds_in_time"],
        plates,
    )


def checksum() -> str:
    """Return the SHA-256 of the file that `data_set` reads."""
    return hashlib.sha256(FILE.read_bytes()).hexdigest()


MAX_BYTES = 16 << 20


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    benchmark: Literal["era-localization"]
    version: int
    name: str
    patterns: dict[str, dict[str, tuple[float, float, float]]]


def read_entry(path: Path) -> tuple[str, Mapping[str, Excitation]]:
    """Read the name and the excitations by set of a file; raises InputError naming set and ERA."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: entry must have at most {MAX_BYTES >> 20} MiB")
        entry = _Entry.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except ValidationError as error:
        key, rule = first_problem(error)
        raise InputError(f"{path}: {key or 'entry'}: {rule}") from None
    if entry.version != VERSION:
        raise InputError(f"{path}: version must be {VERSION}, got {entry.version}")
    rigs = _rigs(data_set())
    excitations = {}
    for name, drives in entry.patterns.items():
        if name not in rigs:
            raise InputError(f"{path}: patterns: the data set has no contact set {name!r}")
        try:
            excitations[name] = _excitation(rigs[name], drives)
        except InputError as error:
            raise InputError(f"{path}: patterns.{name}: {error}") from None
    return entry.name, excitations


def _rigs(found: DataSet) -> dict[str, Rig]:
    return {each.name: plate.rig for plate in found.plates.values() for each in plate.sets}


def _excitation(rig: Rig, drives: Mapping[str, tuple[float, float, float]]) -> Excitation:
    """Return tones by ERA, without tones of level 0."""
    strokes = rig.full_levels
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    tones = {}
    for name, (frequency, level, phase) in drives.items():
        if name not in strokes:
            raise InputError(f"the rig has no ERA {name!r}; it has {', '.join(strokes)}")
        if not low <= frequency <= high:
            raise InputError(
                f"frequency of {name} must be {low:g} to {high:g} Hz, got {frequency:g}"
            )
        if not 0 <= level <= 1:
            raise InputError(f"level of {name} must be 0 to 1, got {level:g}")
        if level > 0:
            tones[name] = Tone(frequency, level * strokes[name], math.radians(phase))
    if not tones:
        raise InputError("must drive at least one ERA")
    return tones


STARTS, STEPS, RATE = 8, 120, 0.05
NEAR = 0.05
"""Maximum distance of a plate's rank from the percentile, as a share, to affect its gradient."""


class Fingers(Protocol):
    """Fingers on plates; the first finger is the target.

    finger (p,): finger of each point; weights (p,): of the point in the mean over the fingertip.
    """

    finger: FloatArray
    weights: FloatArray
    finger_count: int

    def accelerations(self, frequency: float, plates: Any) -> ComplexArray:
        """Return accelerations (m, p, eras) [m/s²] at the points due to ERAs at full stroke."""
        ...


class Plates(Protocol):
    """Plates within the tolerances."""

    def first(self, count: int) -> "Plates":
        """Return the first plates."""
        ...


@dataclass(frozen=True, eq=False)
class Drive:
    """Complex weights of the ERAs (eras,), at most 1, at a frequency [Hz]."""

    frequency: float
    weights: ComplexArray


def contrasts_db(
    fingers: Fingers, fields: ComplexArray, weights: ComplexArray
) -> tuple[FloatArray, FloatArray]:
    """Return contrast [dB] and acceleration of the target [m/s²] on each plate, both (m,).

    fields (..., m, p, eras), weights (..., eras).
    """
    size = np.abs(fields @ weights[..., None, :, None])[..., 0]
    target = size @ np.where(fingers.finger == 0, fingers.weights, 0)
    loudest = size[..., fingers.finger > 0].max(axis=-1)
    return 20 * np.log10(target / loudest), target


def optimum(
    fingers: Fingers,
    frequencies: FloatArray,
    plates: Plates,
    *,
    percentile: float,
    least: FloatArray,
) -> Drive:
    """Find the drive with the highest percentile of contrast over plates.

    least (f,) [m/s²]: acceleration that the target must have at full stroke, in the tenth
    percentile of the plates; 0 for none.
    """
    few = plates.first(60)
    ranked: list[tuple[float, int, ComplexArray]] = []
    for number, frequency in enumerate(frequencies):
        fields = fingers.accelerations(float(frequency), few)
        for start in _starts(fingers, fields):
            worth = _worth(fingers, fields, start, percentile, float(least[number]))
            ranked.append((worth, number, start))
    ranked.sort(key=lambda each: -each[0])
    chosen = list(dict.fromkeys(number for _, number, _ in ranked))[:STARTS]
    best, answer = -np.inf, None
    for number in chosen:
        fields = fingers.accelerations(float(frequencies[number]), plates)
        for start in [weights for _, at, weights in ranked if at == number][:2]:
            weights = _climb(fingers, fields, start, percentile, float(least[number]))
            worth = _worth(fingers, fields, weights, percentile, float(least[number]))
            if worth > best:
                best, answer = worth, Drive(float(frequencies[number]), weights)
    assert answer is not None
    return answer


def _worth(
    fingers: Fingers, fields: ComplexArray, weights: ComplexArray, percentile: float, least: float
) -> float:
    """Return the percentile minus two decibels for each decibel of missing level."""
    contrast, target = contrasts_db(fingers, fields, weights / np.abs(weights).max())
    worth = float(np.percentile(contrast, percentile))
    if least > 0:
        level = float(np.percentile(target, 10))
        worth -= 2 * max(0.0, 20 * np.log10(least / level))
    return worth


def _starts(fingers: Fingers, fields: ComplexArray) -> list[ComplexArray]:
    """Return weights that minimize mean power at the quiet fingers, for several weightings."""
    target = fields[:, fingers.finger == 0].mean(axis=(0, 1))
    forms = []
    for finger in range(1, fingers.finger_count):
        rows = fields[:, fingers.finger == finger].reshape(-1, fields.shape[-1])
        forms.append(rows.conj().T @ rows / len(rows))
    share, starts = np.ones(len(forms)), []
    # Loaded diagonals raise the level for less contrast.
    for load in (1e-6, 1e-6, 1e-6, 1e-3, 1e-2, 1e-1):
        form = np.tensordot(share / share.sum(), np.array(forms), axes=1)
        form += load * np.trace(form).real / len(form) * np.eye(len(form))
        weights = np.linalg.solve(form, target.conj())
        weights /= np.abs(weights).max()
        starts.append(weights)
        share = share * np.sqrt([(weights.conj() @ each @ weights).real for each in forms])
    return starts


def _climb(
    fingers: Fingers, fields: ComplexArray, weights: ComplexArray, percentile: float, least: float
) -> ComplexArray:
    """Maximize the mean of the contrasts with a rank near the percentile by Adam."""
    is_target = fingers.finger == 0
    over = fingers.weights[is_target]
    target_fields, quiet_fields = fields[:, is_target], fields[:, ~is_target]
    first, second = np.zeros(len(weights), complex), 0.0
    best, best_weights = -np.inf, weights
    around = percentile / 100 + np.array([-NEAR, NEAR])
    low, high = (np.clip(around, 0, 1) * len(fields)).astype(int)
    for step in range(1, STEPS + 1):
        at_target = target_fields @ weights
        size = np.abs(at_target)
        mean = size @ over
        at_quiet = quiet_fields @ weights
        loudest = np.abs(at_quiet).argmax(axis=1)
        rows = np.arange(len(fields))
        quiet = at_quiet[rows, loudest]
        contrast = np.log(mean / np.abs(quiet))
        worth = float(np.percentile(contrast, percentile)) * 20 / np.log(10)
        short = 0.0
        if least > 0:
            full = mean / np.abs(weights).max()
            short = 20 * np.log10(least / float(np.percentile(full, 10)))
            worth -= 2 * max(0.0, short)
        if worth > best:
            best, best_weights = worth, weights.copy()
        near = np.argsort(contrast)[low : max(high, low + 1)]
        unit = at_target[near] / size[near]
        gain = np.einsum("mp,p,mpe->me", unit, over, target_fields[near].conj())
        gain /= mean[near, None]
        loss = quiet[near, None] * quiet_fields[near, loudest[near]].conj()
        loss /= np.abs(quiet[near, None]) ** 2
        gradient = (gain - loss).mean(axis=0)
        if short > 0:
            # Toward the level: more amplitude at the target for the strongest weight.
            strongest = np.abs(weights).argmax()
            towards = gain.mean(axis=0)
            towards[strongest] -= weights[strongest] / np.abs(weights[strongest]) ** 2
            gradient = gradient + 2 * towards
        first = 0.9 * first + 0.1 * gradient
        second = 0.99 * second + 0.01 * float(np.vdot(gradient, gradient).real)
        rate = RATE * np.linalg.norm(weights) * min(1.0, 2 * (1 - step / STEPS) + 0.02)
        weights = weights + rate * (first / (1 - 0.9**step)) / np.sqrt(second / (1 - 0.99**step))
    return np.asarray(best_weights / np.abs(best_weights).max())


LEVEL_TOLERANCE_DB = 0.5
DURATION = 1.5  # s; the slowest mode has settled then


@dataclass(frozen=True)
class SetScore:
    """Contrast [dB] and level [dB SL] that 90 % of plates reach; in time: of a plate, or None.

    contrast_db is 0 for a pattern below the level, or none.
    """

    plate: str
    quiet_count: int
    contrast_db: float
    level_db_sl: float | None
    in_time_db: float | None = None

    @property
    def is_missed(self) -> bool:
        """Whether there was no pattern that reached the level."""
        return self.contrast_db == 0.0


def score(
    excitations: Mapping[str, Excitation],
    *,
    in_time: bool = False,
    progress: Progress = unseen,
) -> dict[str, SetScore]:
    """Score the excitations by contact set; in_time: whether to also play each in time.

    progress: called with the number of finished sets and the total. Raises InputError.
    """
    found = data_set()
    plates = [
        plate for plate in found.plates.values() if any(s.name in excitations for s in plate.sets)
    ]
    total = sum(len(plate.sets) for plate in plates)
    scores: dict[str, SetScore] = {}
    for plate in plates:
        for name, each in _of_plate(found, plate, excitations, in_time=in_time):
            scores[name] = each
            progress(len(scores), total)
    return scores


def summary(scores: Mapping[str, SetScore]) -> list[dict[str, Any]]:
    """Return rows by plate and number of quiet fingers: median and tenth percentile over sets."""
    rows = []
    for plate, quiet in dict.fromkeys((s.plate, s.quiet_count) for s in scores.values()):
        some = [s for s in scores.values() if (s.plate, s.quiet_count) == (plate, quiet)]
        contrasts = [each.contrast_db for each in some]
        timed = [each.in_time_db for each in some if each.in_time_db is not None]
        rows.append(
            {
                "plate": plate,
                "quiet": quiet,
                "sets": len(some),
                "missed": sum(each.is_missed for each in some),
                "contrast_db": float(np.median(contrasts)),
                "tenth_percentile_db": float(np.percentile(contrasts, 10)),
                "in_time_db": float(np.median(timed)) if timed else None,
            }
        )
    return rows


def _of_plate(
    found: DataSet,
    plate: BenchmarkPlate,
    excitations: Mapping[str, Excitation],
    *,
    in_time: bool,
) -> Iterator[tuple[str, SetScore]]:
    rig = plate.rig
    played = [excitations[each.name] for each in plate.sets if each.name in excitations]
    frequencies = sorted({tone.frequency for each in played for tone in each.values()})
    table = build_table(rig, frequencies=np.array(frequencies))
    players = {seed: _InTime(rig, seed) for seed in found.in_time} if in_time else {}
    for number, each in enumerate(plate.sets):
        excitation = excitations.get(each.name)
        if excitation is None:
            yield each.name, SetScore(plate.name, each.quiet_count, 0.0, None)
            continue
        contrast, level = on_held_out(found, table, each, excitation)
        if level < found.level_db_sl - LEVEL_TOLERANCE_DB:
            contrast = 0.0
        timed = None
        if players:
            player = players[found.in_time[number % len(found.in_time)]]
            timed = player.felt_contrast_db(found, each, excitation)
        yield each.name, SetScore(plate.name, each.quiet_count, contrast, level, timed)


def on_held_out(
    found: DataSet, table: LocalizationTable, contacts: ContactSet, excitation: Excitation
) -> tuple[float, float]:
    """Return felt contrast [dB] and level [dB SL] that 90 % of held-out plates reach."""
    plates = draw_plates(
        np.random.default_rng([found.seed, contacts.number]),
        table.uncertainty,
        count=found.draws,
        of=table,
        contact_count=len(contacts.contacts),
    )
    level, contrast = felt_on(table, contacts.placement, excitation, plates)
    assert contrast is not None
    return (
        float(np.percentile(decibels(contrast), 10)),
        float(np.percentile(decibels(level), 10)),
    )


class _InTime:
    """A plate within the rig's uncertainty, on another mesh, that vibrates in time."""

    def __init__(self, rig: Rig, seed: int) -> None:
        self._rig = rig
        self._drawn = draw_imperfections(rig, seed=seed)
        real = self._drawn.plate.realised(rig)
        self._reduced = reduce_plate(
            real.plate,
            real.mesh,
            footprints_of(real.eras, real.masses),
            frequency_max=rig.limits.frequency_max,
        )

    def felt_contrast_db(
        self, found: DataSet, contacts: ContactSet, excitation: Excitation
    ) -> float | None:
        """Felt contrast [dB] of a steady excitation that starts along a ramp from rest."""
        return play(
            self._rig,
            self._reduced,
            [Layer(excitation)],
            together(contacts.placement, Stimulus()),
            duration=DURATION,
            imperfections=self._drawn,
        ).contrast_db


if __name__ == "__main__":
    try:
        app()
    except InputError as error:
        raise SystemExit(f"error: {error}") from None
