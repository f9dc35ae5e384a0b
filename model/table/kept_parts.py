"""Parts of a table kept beside it while it is built, so that an interrupted build goes on."""

import logging
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np

from model.files.array_file import UNREADABLE, Arrays, digest_of, read_arrays, write_arrays
from model.table.parts import PART_TYPES, Part

_logger = logging.getLogger(__name__)

MAX_BYTES = 1 << 30

_SUFFIX = ".part.npz"


@dataclass(frozen=True)
class KeptParts:
    """A folder of solved parts; each file's name is a digest of all that made it.

    problem_digest: see `TableProblem.digest`.
    """

    folder: Path
    problem_digest: str

    @classmethod
    def beside(cls, table: Path, problem_digest: str) -> "KeptParts":
        """Where the parts of a table file are kept."""
        return cls(table.with_name(f"{table.name}.parts"), problem_digest)

    def load(self, part: Part) -> Arrays | None:
        """A part's arrays, or None; a damaged file is told of and taken for none."""
        path = self._path(part)
        types = {**PART_TYPES[part.what], "sha256": "|u1"}
        try:
            arrays = read_arrays(path, types, max_bytes=MAX_BYTES)
        except FileNotFoundError:
            return None
        except UNREADABLE as error:
            _logger.warning("%s cannot be read and is computed again: %s", path, error)
            return None
        digest = arrays.pop("sha256").tobytes()
        if digest != self._digest(part, arrays):
            _logger.warning("%s is damaged and is computed again", path)
            return None
        return arrays

    def store(self, part: Part, arrays: Arrays) -> None:
        """Keep a part; its file is whole or not there. Raises OSError if it cannot be written."""
        self.folder.mkdir(exist_ok=True)
        digest = np.frombuffer(self._digest(part, arrays), dtype=np.uint8)
        write_arrays(self._path(part), {**arrays, "sha256": digest})

    def clear(self) -> None:
        """Take away all parts, those of other problems and half-written ones too."""
        for path in self.folder.glob(f"*{_SUFFIX}*"):
            path.unlink(missing_ok=True)
        with suppress(OSError):  # not there, or something of someone else's is in it
            self.folder.rmdir()

    def _path(self, part: Part) -> Path:
        name = sha256(f"{self.problem_digest} {part}".encode()).hexdigest()[:32]
        return self.folder / f"{part.what}-{name}{_SUFFIX}"

    def _digest(self, part: Part, arrays: Arrays) -> bytes:
        return digest_of(f"{self.problem_digest} {part}", arrays).encode()
