"""Parts of a table kept beside it while it is built, so that an interrupted build goes on."""

from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from model.files.array_file import Arrays
from model.files.kept_arrays import keep_arrays, kept_arrays
from model.table.table_parts import PART_TYPES, Part

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
        return kept_arrays(self._path(part), self._text(part), PART_TYPES[part.what])

    def store(self, part: Part, arrays: Arrays) -> None:
        """Keep a part; its file is whole or not there. Raises OSError if it cannot be written."""
        keep_arrays(self._path(part), self._text(part), arrays)

    def clear(self) -> None:
        """Take away all parts, those of other problems and half-written ones too."""
        for path in self.folder.glob(f"*{_SUFFIX}*"):
            path.unlink(missing_ok=True)
        with suppress(OSError):  # not there, or something of someone else's is in it
            self.folder.rmdir()

    def _path(self, part: Part) -> Path:
        name = sha256(self._text(part).encode()).hexdigest()[:32]
        return self.folder / f"{part.what}-{name}{_SUFFIX}"

    def _text(self, part: Part) -> str:
        """All that made a part."""
        return f"{self.problem_digest} {part}"
