"""Finished cases of a study in one file, so that an interrupted study resumes."""

import hashlib
import time
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.files.kept_arrays import keep_arrays, kept_arrays
from model.studies.cases import Cases
from model.studies.solve import CaseResults, empty_results

SAVE_INTERVAL = 5.0  # s; a kill loses no more, and large studies are not held up by writing

_DIGEST_SIZE = 16
_TYPES = {"cases": "|u1", "expected_db": "<f8", "statistics": "<f8", "active": "<u8"}
_Row: TypeAlias = tuple[float, NDArray[np.float64], NDArray[np.uint64]]


class FinishedCases:
    """Results of one problem by case, in a file of a folder.

    A case is identified by where its ERAs are and how stiff, so that a study with more layouts
    takes over those of a smaller one. A damaged file is logged and ignored.
    """

    def __init__(self, folder: Path, problem_digest: str) -> None:
        """problem_digest: of `StudyProblem.digest`; the file's name has its beginning."""
        self.path = folder / f"finished-{problem_digest[:16]}.npz"
        self._problem_digest = problem_digest
        self._rows: dict[bytes, _Row] = {}
        self._saved_at = -np.inf
        arrays = kept_arrays(self.path, problem_digest, _TYPES)
        if arrays is not None:
            keys = [row.tobytes() for row in arrays["cases"]]
            rows = zip(
                arrays["expected_db"].tolist(), arrays["statistics"], arrays["active"], strict=True
            )
            self._rows = dict(zip(keys, rows, strict=True))

    def find(self, cases: Cases) -> tuple[NDArray[np.bool_], CaseResults]:
        """Return which cases (n,) are finished, and results with their rows filled in."""
        results = empty_results(len(cases))
        done = np.zeros(len(cases), dtype=bool)
        for case in range(len(cases)):
            row = self._rows.get(_digest(cases, case))
            if row is not None:
                done[case] = True
                results.expected_db[case] = row[0]
                results.statistics[case], results.active[case] = row[1:]
        return done, results

    def add(self, cases: Cases, results: CaseResults) -> None:
        """Add results, and save them unless that was done within the last SAVE_INTERVAL."""
        for case in range(len(cases)):
            row = (
                float(results.expected_db[case]),
                results.statistics[case],
                results.active[case],
            )
            self._rows[_digest(cases, case)] = row
        if time.monotonic() >= self._saved_at + SAVE_INTERVAL:
            self.save()

    def save(self) -> None:
        """Write the file; it is whole or not there. Raises OSError if it cannot be written."""
        if not self._rows:
            return
        expected, statistics, active = zip(*self._rows.values(), strict=True)
        keys = np.frombuffer(b"".join(self._rows), dtype=np.uint8).reshape(-1, _DIGEST_SIZE)
        arrays = {
            "cases": keys,
            "expected_db": np.array(expected),
            "statistics": np.array(statistics),
            "active": np.array(active),
        }
        keep_arrays(self.path, self._problem_digest, arrays)
        self._saved_at = time.monotonic()


def _digest(cases: Cases, case: int) -> bytes:
    """SHA-256 over the positions and the stiffness of a case, its beginning."""
    digest = hashlib.sha256(cases.positions_of(case).tobytes())
    digest.update(cases.stiffness_factors[case].tobytes())
    return digest.digest()[:_DIGEST_SIZE]
