"""Results kept by content, so that a study that was interrupted goes on where it stopped."""

import hashlib
import logging
import os
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model.studies.cases import Cases
from model.studies.solve import DRIVES, CaseResults
from model.vibration.activation import STATISTICS

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ResultCache:
    """A folder of chunks of results; each file's name is a digest of all that made it.

    problem_digest: of the study's problem, see `StudyProblem.digest`.
    """

    folder: Path
    problem_digest: str

    def load(self, cases: Cases) -> CaseResults | None:
        """Results kept for these cases, or None; a damaged file is told of and taken for none."""
        path = self._path(cases)
        try:
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as content:
                results = CaseResults(content["statistics"], content["active"])
                digest = str(content["sha256"])
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            _logger.warning("%s cannot be read and is computed again: %s", path, error)
            return None
        fits = results.statistics.shape == (len(cases), len(DRIVES), len(STATISTICS))
        if not fits or digest != _digest(results):
            _logger.warning("%s is damaged and is computed again", path)
            return None
        return results

    def store(self, cases: Cases, results: CaseResults) -> None:
        """Keep results; the file is whole or not there. Raises OSError if it cannot be written."""
        self.folder.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=self.folder, prefix=".", suffix=".npz")
        try:
            with os.fdopen(handle, "wb") as stream:
                np.savez(
                    stream,
                    statistics=results.statistics,
                    active=results.active,
                    sha256=np.array(_digest(results)),
                )
            Path(temporary).replace(self._path(cases))
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise

    def _path(self, cases: Cases) -> Path:
        digest = hashlib.sha256(self.problem_digest.encode())
        for case in range(len(cases)):
            digest.update(cases.positions_of(case).tobytes() + b"|")
        digest.update(cases.stiffness_factors.tobytes())
        return self.folder / f"{digest.hexdigest()[:32]}.npz"


def _digest(results: CaseResults) -> str:
    """SHA-256 over the arrays, so that not even a flipped bit passes."""
    digest = hashlib.sha256()
    for array in (results.statistics, results.active):
        digest.update(f"{array.dtype.str}{array.shape}".encode() + array.tobytes())
    return digest.hexdigest()
