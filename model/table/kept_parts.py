"""Finished parts of a table, kept beside it so that an interrupted build can be resumed."""

from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from model.files.array_file import Arrays, keep_arrays, kept_arrays
from model.table.table_parts import PART_TYPES, Part

_SUFFIX = ".part.npz"


@dataclass(frozen=True)
class KeptParts:
    """A folder of solved parts; the name of each file is a digest of its inputs.

    problem_digest: see `TableProblem.digest`.
    """

    folder: Path
    problem_digest: str

    @classmethod
    def beside(cls, table: Path, problem_digest: str) -> "KeptParts":
        """Parts of a table file."""
        return cls(table.with_name(f"{table.name}.parts"), problem_digest)

    def load(self, part: Part) -> Arrays | None:
        """Load a part's arrays; None if there are none, or, with a warning, if they are damaged."""
        return kept_arrays(self._path(part), self._text(part), PART_TYPES[part.kind])

    def store(self, part: Part, arrays: Arrays) -> None:
        """Keep a part in a file that is complete or absent; raises OSError."""
        keep_arrays(self._path(part), self._text(part), arrays)

    def clear(self) -> None:
        """Remove all parts, incomplete ones and those of other problems included."""
        for path in self.folder.glob(f"*{_SUFFIX}*"):
            path.unlink(missing_ok=True)
        with suppress(OSError):  # missing, or other files are in it
            self.folder.rmdir()

    def _path(self, part: Part) -> Path:
        name = sha256(self._text(part).encode()).hexdigest()[:32]
        return self.folder / f"{part.kind}-{name}{_SUFFIX}"

    def _text(self, part: Part) -> str:
        """Inputs of a part."""
        return f"{self.problem_digest} {part}"
