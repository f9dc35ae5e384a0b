"""The engine as a library: of a wheel of this platform, or compiled at first use."""

import ctypes
from functools import cache
from pathlib import Path

from model.compiled.kernels import compile_library, kept_library
from model.errors import InputError

ENGINE = "engine.so"
"""The file of the library in a wheel of one platform."""

_HERE = Path(__file__).parent
_FOLDERS = (_HERE / "firmware", _HERE.parents[2] / "firmware")  # of a wheel, of a checkout
_PARTS = ("core", "wire", "ports/sound")
_CORE = ("channel", "layers", "set", "sine", "states", "voice")
_WIRE = ("crc", "mbap", "messages", "modbus", "serial")
_FLAGS = (
    "-std=c99",
    "-O2",
    "-fno-math-errno",
    "-pthread",
    '-DCONFIG_FILE="sound_config.h"',
)
_WHAT = "soft-amp: its engine"


@cache
def library() -> ctypes.CDLL:
    """Load the library, compiled if there is none; raises InputError."""
    own = _HERE / ENGINE
    if own.exists():
        try:
            return ctypes.CDLL(str(own))
        except OSError as problem:
            raise InputError(
                f"soft-amp: {own} cannot be loaded: {problem}; reinstall era-haptics"
            ) from None
    sources, headers, flags = _recipe()
    return kept_library("soft-amp", sources, headers, flags=flags, what=_WHAT)


def address_of(name: str) -> int:
    """Return the address of a function of the library, a callback."""
    found = ctypes.cast(getattr(library(), name), ctypes.c_void_p).value
    assert found is not None  # noqa: S101  of a function
    return found


def compile_engine(path: Path) -> None:
    """Compile the library to a file. Raises InputError."""
    sources, _, flags = _recipe()
    compile_library(path, sources, flags=flags, what=_WHAT)


def _recipe() -> tuple[list[Path], list[Path], list[str]]:
    """Sources, headers and flags of the compiler; raises InputError."""
    folder = next((each for each in _FOLDERS if (each / "ports" / "sound").is_dir()), None)
    if folder is None:
        raise InputError(
            f"soft-amp: its C sources are missing in {_FOLDERS[0]}; reinstall era-haptics"
        )
    sources = [
        *(folder / "core" / f"{name}.c" for name in _CORE),
        *(folder / "wire" / f"{name}.c" for name in _WIRE),
        *(folder / "ports" / "sound").glob("*.c"),
    ]
    headers = [path for part in _PARTS for path in (folder / part).glob("*.h")]
    return sources, headers, [*_FLAGS, *(f"-I{folder / part}" for part in _PARTS)]
