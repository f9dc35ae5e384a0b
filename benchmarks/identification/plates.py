"""What is found of one hidden plate, and what answers then give on it."""

import time
from dataclasses import dataclass, field

import numpy as np

from benchmarks.identification.answers import Answer, answer, known_table, table_of
from benchmarks.identification.coverage import fields_held, parameters_held
from benchmarks.identification.hidden import FAMILY, INSIDE, LOAD_STD, Hidden
from benchmarks.identification.thin_plate import Complexes, Reals
from benchmarks.setting import random_contacts
from model.errors import InputError
from model.estimate.forward import Sensor
from model.estimate.identify import Identification, identify
from model.estimate.measurement import Measurement
from model.finger import fingertip_points, fingertip_weights
from model.rig.rig import Rig
from model.table.table import LocalizationTable

FREQUENCIES = np.linspace(40.0, 500.0, 27)
QUIET = (1, 2, 3)
WAYS = ("written", "identified", "known")
GAIN, PHASE_DEG = 0.01, 1.0
_MARGIN = 0.013


@dataclass
class Outcome:
    """Of one plate: contrasts [dB] by way, load and number of quiet fingers, and its fit.

    kept: by what is promised and load, whether the plate as identified gives it; is_explained:
    whether anything is promised of it; seconds: of
    processor time of the identification; errors, fields: see `coverage`.
    """

    kind: str
    contrasts: dict[tuple[str, bool, int], list[float]]
    kept: dict[tuple[str, bool], list[bool]] = field(default_factory=dict)
    chi2: float = np.nan
    mode_shift: float = np.nan
    held_out: float = np.nan
    unexplained: float = np.nan
    seconds: float = np.nan
    errors: dict[str, Reals] = field(default_factory=dict)
    fields: Reals = field(default_factory=lambda: np.zeros(0))
    refusal: str = ""
    is_explained: bool = False
    sensors: int = 4


def outcome(
    hidden: Hidden,
    rig: Rig,
    written: dict[bool, LocalizationTable],
    kind: str,
    seed: int,
    *,
    sets: int,
    rounds: int = 4,
    sensors: int = 4,
) -> Outcome:
    """Identify a hidden plate and judge answers on it.

    written: tables of the rig as it is written, by whether fingers load it; rounds: of interleaved
    tones, four for every ERA at each tone; sensors: at the first ERAs, then INSIDE.
    """
    found = Outcome(kind, {}, sensors=sensors)
    started = time.process_time()
    try:
        measured = _measurement(hidden, rig, seed, rounds, sensors)
        identified = identify(rig, measured)
    except InputError as refusal:
        found.refusal = str(refusal)
        return found
    found.seconds = time.process_time() - started
    found.chi2, found.mode_shift = identified.chi2, identified.mode_shift
    found.is_explained = identified.is_explained
    if identified.held_out:
        found.held_out = identified.held_out.total
        found.unexplained = identified.held_out.unexplained
    own = hidden.mounted
    shapes = own.plate.shapes(written[False].raster.points)
    found.errors = parameters_held(identified, own)
    found.fields = fields_held(identified, hidden, FREQUENCIES)
    is_judged = identified.is_explained or kind in FAMILY
    for loaded in (False, True) if sets and is_judged else ():
        tables = {"written": written[loaded], "identified": _table(identified, loaded)}
        for quiet in QUIET:
            rng = np.random.default_rng([seed, quiet])
            for _ in range(sets):
                size = (rig.plate.length, rig.plate.width)
                places = random_contacts(rng, quiet + 1, size, margin=_MARGIN)
                factors = np.exp(LOAD_STD * rng.standard_normal((quiet + 1, 4)))
                if not loaded:
                    factors = factors[:0]
                known = known_table(written[loaded], own, shapes, factors)
                error = 1 + GAIN * rng.standard_normal(len(rig.eras))
                turn = np.radians(PHASE_DEG) * rng.standard_normal(len(rig.eras))
                drives = error * np.exp(1j * turn)
                for way, table in {**tables, "known": known}.items():
                    tone = answer(table, places)
                    contrast, level = _felt(hidden, rig, places, factors, tone, drives)
                    found.contrasts.setdefault((way, loaded, quiet), []).append(contrast)
                    if way == "identified":
                        for what, reached in (
                            ("contrast", contrast >= tone.contrast),
                            ("level", level >= tone.level),
                        ):
                            found.kept.setdefault((what, loaded), []).append(reached)
    return found


def _table(identified: Identification, loaded: bool) -> LocalizationTable:
    return table_of(identified.rig, FREQUENCIES, loaded=loaded)


def _measurement(hidden: Hidden, rig: Rig, seed: int, rounds: int, count: int) -> Measurement:
    values = hidden.measured(FREQUENCIES, np.random.default_rng([seed, 1]), count)
    played = (np.arange(len(FREQUENCIES))[:, None] + np.arange(len(rig.eras))) % 4 < rounds
    sensors = [Sensor(era.name, era.name) for era in rig.eras]
    sensors += [Sensor(f"inside {n}", x=x, y=y) for n, (x, y) in enumerate(INSIDE.tolist())]
    return Measurement(sensors[:count], FREQUENCIES, np.where(played[:, None], values, np.nan))


def _felt(
    hidden: Hidden,
    rig: Rig,
    places: Reals,
    factors: Reals,
    tone: Answer,
    drives: Complexes,
) -> tuple[float, float]:
    """Contrast [dB] and level [dB SL] on the hidden plate, by the mean under the target.

    drives (n,): factors on its ERAs; contrast: to the loudest point under a quiet finger.
    """
    discs = [fingertip_points(float(x), float(y), rig.plate) for x, y in places]
    points = np.concatenate(discs)
    unit = hidden.felt(tone.frequency, points, places, factors)
    fields = np.abs(unit @ (tone.bases * drives))
    weights = fingertip_weights(float(places[0, 0]), float(places[0, 1]), rig.plate)
    own = len(discs[0])
    mean = weights @ fields[:own]
    ratios = np.array([mean / fields[own:].max(), mean / tone.threshold])
    contrast, level = (20 * np.log10(ratios)).tolist()
    return contrast, level
