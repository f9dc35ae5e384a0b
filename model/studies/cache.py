"""Results kept by content, so that a study that was interrupted goes on where it stopped."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from model.files.kept_arrays import keep_arrays, kept_arrays
from model.studies.cases import Cases
from model.studies.solve import CaseResults

_TYPES = {"statistics": "<f8", "active": "<u8"}


@dataclass(frozen=True)
class ResultCache:
    """A folder of chunks of results; each file's name is a digest of all that made it.

    problem_digest: of the study's problem, see `StudyProblem.digest`.
    """

    folder: Path
    problem_digest: str

    def load(self, cases: Cases) -> CaseResults | None:
        """Results kept for these cases, or None; a damaged file is told of and taken for none."""
        digest = self._digest(cases)
        arrays = kept_arrays(self._path(digest), digest, _TYPES)
        return None if arrays is None else CaseResults(**arrays)

    def store(self, cases: Cases, results: CaseResults) -> None:
        """Keep results; the file is whole or not there. Raises OSError if it cannot be written."""
        digest = self._digest(cases)
        arrays = {"statistics": results.statistics, "active": results.active}
        keep_arrays(self._path(digest), digest, arrays)

    def _path(self, digest: str) -> Path:
        return self.folder / f"{digest[:32]}.npz"

    def _digest(self, cases: Cases) -> str:
        """SHA-256 over all that made the results of these cases."""
        digest = hashlib.sha256(self.problem_digest.encode())
        for case in range(len(cases)):
            digest.update(cases.positions_of(case).tobytes() + b"|")
        digest.update(cases.stiffness_factors.tobytes())
        return digest.hexdigest()
