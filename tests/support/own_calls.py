"""Calls of the project's own functions, but those of far ends and judges."""

import sys
import types
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]
_COUNTED = tuple(f"{ROOT / name}/" for name in ("controller", "drivers", "model", "registry"))
_CALLBACK = str(Path("asyncio", "events.py"))  # what calls what the event loop runs
_BESIDE = tuple(f"{ROOT / name}/" for name in ("sim", "era_haptics/lab"))


@dataclass
class Way:
    """Own functions in the order of their first calls, as (file, name), and the calls of files."""

    functions: dict[tuple[str, str], None] = field(default_factory=dict)
    calls: Counter[str] = field(default_factory=Counter)

    def called(self, code: types.CodeType) -> None:
        """Note a call."""
        file = Path(code.co_filename).relative_to(ROOT).as_posix()
        self.functions[file, code.co_qualname.partition(".<locals>")[0]] = None
        self.calls[file] += 1

    @property
    def files(self) -> list[str]:
        """The files on the way, in the order of their first calls."""
        return list(dict.fromkeys(file for file, _ in self.functions))


class Recorder:
    """Notes own calls while it is entered, anew each time, but those of far ends and judges."""

    def __init__(self) -> None:
        self._codes: list[types.CodeType] = []
        self._written = 0

    def __enter__(self) -> "Recorder":
        self._codes, self._written = [], 0
        sys.setprofile(self._called)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)

    def written(self) -> None:
        """Mark what was called until now."""
        self._written = len(self._codes)

    def way(self, *, is_until_written: bool = False) -> Way:
        """What was called, or what until the last mark."""
        way = Way()
        for code in self._codes[: self._written if is_until_written else None]:
            way.called(code)
        return way

    def _called(self, frame: types.FrameType, event: str, _: object) -> None:
        if event != "call" or not frame.f_code.co_filename.startswith(_COUNTED):
            return
        outer: types.FrameType | None = frame
        while outer is not None and not outer.f_code.co_filename.endswith(_CALLBACK):
            if outer.f_code.co_filename.startswith(_BESIDE):
                return
            outer = outer.f_back
        self._codes.append(frame.f_code)
