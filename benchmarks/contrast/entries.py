"""Entries of the contrast benchmark: other methods, this program's, and an optimum in hindsight.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.contrast.entries -o DIR [--methods random,paper]

Writes a file for each method, for `python -m benchmarks.contrast score`, which prints the rows in
docs/measured/figures.md. All methods except paper drive every ERA at one of the table's 47
frequencies, the best one on the nominal plate:

- random: any frequency, levels and phases
- time-reversal: each ERA by the conjugate of its field at the target
- paper: one or two ERAs at full stroke, each at any frequency, with the best nominal contrast
- era-haptics: `era.query`, mode phased
- hindsight: optimized on the scoring plates, at the four frequencies with the best promise

`examples/sound_zones.py` writes entries of acoustic contrast control and pressure matching.
"""

import argparse
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from benchmarks.contrast.__main__ import VERSION, ContactSet, DataSet, data_set, optimum
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import ComplexArray, FloatArray, IntArray
from model.errors import InputError
from model.rig.rig import Uncertainty
from model.study.exact_plates import Plates, accelerations_on, draw_plates, touched
from model.table.fingertip_shapes import read_fingertips
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from model.vibration import Excitation, Tone

FREQUENCIES_IN_HINDSIGHT = 4


@dataclass(frozen=True, eq=False)
class _Case:
    """A contact set on its plate, and the fields (f, points, eras) on the nominal plate."""

    found: DataSet
    table: LocalizationTable
    contacts: ContactSet
    placed: Placement
    rng: np.random.Generator

    @property
    def fields(self) -> ComplexArray:
        """Fields of each ERA alone at full stroke, (f, points, eras)."""
        k, none = len(self.contacts.contacts), Uncertainty.none()
        one = draw_plates(self.rng, none, of=self.table, count=1, contact_count=k)
        (found,) = self.fields_on(np.arange(len(self.table.frequencies)), one)
        return np.asarray(found)

    def fields_on(self, rows: IntArray, plates: Plates) -> ComplexArray:
        """Fields on plates at rows (f,) of the table's frequencies, (d, f, points, eras)."""
        strokes = np.diag([complex(era.full_level) for era in self.table.eras])
        bases = np.repeat(strokes[None], len(rows), axis=0)
        at = touched(self.table, self.placed, plates)
        return accelerations_on(self.table, *at, self.table.attached, rows, bases, plates).swapaxes(
            2, 3
        )

    @property
    def weights(self) -> FloatArray:
        """Weights (points,) in the mean over the target, 0 at other points."""
        weights = read_fingertips(self.table, self.placed.contacts).fine_weights.astype(float)
        weights[1:] = 0
        return weights.ravel()

    @property
    def is_target(self) -> NDArray[np.bool_]:
        """Whether a point is under the target, (points,)."""
        tips = read_fingertips(self.table, self.placed.contacts).fine_weights
        return np.repeat(np.arange(len(tips)) == 0, tips.shape[1])

    def excitation(self, frequency: float, weights: ComplexArray) -> Excitation:
        """Return the excitation for weights (eras,), the largest at full stroke."""
        weights = weights / np.abs(weights).max()
        return {
            era.name: Tone.from_phasor(frequency, complex(era.full_level * weight))
            for era, weight in zip(self.table.eras, weights, strict=True)
        }

    def best(self, weights: ComplexArray) -> Excitation:
        """Return the excitation with the best nominal contrast, for weights (f, eras)."""
        size = np.abs(np.einsum("fpe,fe->fp", self.fields, weights))
        contrast = (size @ self.weights) / size[:, ~self.is_target].max(axis=1)
        row = int(contrast.argmax())
        return self.excitation(float(self.table.frequencies[row]), weights[row])


def _random(case: _Case) -> Excitation:
    n = len(case.table.eras)
    weights = case.rng.uniform(0, 1, n) * np.exp(2j * np.pi * case.rng.uniform(0, 1, n))
    return case.excitation(float(case.rng.choice(case.table.frequencies)), weights)


def _time_reversal(case: _Case) -> Excitation:
    conjugate: ComplexArray = case.fields.conj()
    return case.best(case.weights @ conjugate)


def _paper(case: _Case) -> Excitation:
    known = replace(case.table, uncertainty=Uncertainty.none())
    level = case.found.level_db_sl
    found = query(known, case.placed, level, drive_mode="switched").layers[0].excitation
    strokes = case.table.full_levels
    return {name: replace(tone, amplitude=strokes[name]) for name, tone in found.items()}


def _ours(case: _Case) -> Excitation:
    level = case.found.level_db_sl
    return query(case.table, case.placed, level, drive_mode="phased").layers[0].excitation


@dataclass(frozen=True, eq=False)
class _HeldOut:
    """Objective of `optimum`: the fingers of a set on the scoring plates."""

    case: _Case
    finger: FloatArray
    weights: FloatArray
    finger_count: int

    def accelerations(self, frequency: float, plates: "_Drawn") -> ComplexArray:
        """Fields (m, points, eras)."""
        rows = self.case.table.rows_of(np.array([frequency]))
        return self.case.fields_on(rows, plates.plates)[:, 0]


@dataclass(frozen=True, eq=False)
class _Drawn:
    plates: Plates

    def first(self, count: int) -> "_Drawn":
        """Return the first plates."""
        return _Drawn(Plates(**{key: value[:count] for key, value in vars(self.plates).items()}))


def _hindsight(case: _Case) -> Excitation:
    table, k = case.table, len(case.contacts.contacts)
    promised = []
    for frequency in table.frequencies.tolist():
        band = frequency, frequency
        level = case.found.level_db_sl
        found = query(table, case.placed, level, drive_mode="phased", band_hz=band)
        contrast = found.fingers[0].promised_contrast_db if found.is_reached else None
        promised.append(-math.inf if contrast is None else contrast)
    rows = np.sort(np.argsort(promised)[-FREQUENCIES_IN_HINDSIGHT:])
    plates = draw_plates(
        np.random.default_rng([case.found.seed, case.contacts.number]),
        table.uncertainty,
        count=case.found.draws,
        of=table,
        contact_count=k,
    )
    points = len(case.weights) // k
    fingers = _HeldOut(case, np.repeat(np.arange(k), points), case.weights, k)
    least = 10 ** (case.found.level_db_sl / 20) * table.thresholds[rows]
    drive = optimum(
        cast("Any", fingers),  # the methods that it uses
        table.frequencies[rows],
        cast("Any", _Drawn(plates)),
        percentile=10,
        least=np.asarray(least, dtype=float),
    )
    return case.excitation(drive.frequency, drive.weights)


METHODS: Mapping[str, Callable[[_Case], Excitation]] = {
    "random": _random,
    "time-reversal": _time_reversal,
    "paper": _paper,
    "era-haptics": _ours,
    "hindsight": _hindsight,
}


def entry(name: str, plates: list[str]) -> dict[str, object]:
    """Return the entry of a method on plates of the data set."""
    found, patterns = data_set(), {}
    for plate in plates:
        table = build_table(found.plates[plate].rig, drive_mode="phased")
        strokes = table.full_levels
        for contacts in found.plates[plate].sets:
            rng = np.random.default_rng([5, contacts.number])
            try:
                tones = METHODS[name](_Case(found, table, contacts, contacts.placement, rng))
            except InputError:
                continue
            patterns[contacts.name] = {
                era: [
                    tone.frequency,
                    round(min(1.0, tone.amplitude / strokes[era]), 6),
                    round(math.degrees(tone.phase), 3),
                ]
                for era, tone in tones.items()
            }
    return {
        "benchmark": "era-localization",
        "version": VERSION,
        "name": name,
        "patterns": patterns,
    }


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.contrast.entries")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--plates", default=",".join(data_set().plates))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.methods.split(","):
        file = options.output / f"{name}.json"
        document = entry(name, options.plates.split(","))
        file.write_text(json.dumps(document) + "\n", encoding="utf-8")
        print(f"wrote {file}", flush=True)


if __name__ == "__main__":
    main()
