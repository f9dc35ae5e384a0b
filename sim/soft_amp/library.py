"""The engine as a library: of a wheel of this platform, or compiled at first use."""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from model.errors import InputError

ENGINE = "engine.so"
"""The file of the library in a wheel of one platform."""

_HERE = Path(__file__).parent
_FOLDERS = (_HERE / "firmware", _HERE.parents[1] / "firmware")  # of a wheel, of a checkout
_CORE = ("capabilities", "channel", "envelope", "sets", "sine", "states", "voice")
_WIRE = ("crc", "modbus", "modbus_registers", "serial", "serial_messages")
_FLAGS = (
    "-std=c99",
    "-O2",
    "-fno-math-errno",
    "-fPIC",
    "-shared",
    "-pthread",
    '-DCONFIG_FILE="sound_config.h"',
)
_COMPILERS = ("cc", "gcc", "clang")
_TIMEOUT = 120.0  # s


def library() -> Path:
    """The file of the library, compiled if there is none; raises InputError."""
    if (_HERE / ENGINE).exists():
        return _HERE / ENGINE
    import platformdirs

    folder = _sources()
    try:
        kept = platformdirs.user_cache_path("era-haptics", appauthor=False)
        path = kept / f"soft-amp-{_digest(folder)}.so"
        if not path.exists():
            kept.mkdir(parents=True, exist_ok=True)
            compile_engine(path, folder=folder)
    except OSError:  # no cache can be written
        path = Path(tempfile.mkdtemp(prefix="era-soft-amp-")) / "engine.so"
        compile_engine(path, folder=folder)
    return path


def compile_engine(path: Path, *, folder: Path | None = None) -> None:
    """Compile the library to a file; folder: of the firmware's sources. Raises InputError."""
    folder = folder or _sources()
    compiler = os.environ.get("CC") or next(filter(shutil.which, _COMPILERS), None)
    if compiler is None or not shutil.which(compiler.split()[0]):
        raise InputError(
            f"soft-amp: its engine is compiled at first use and there is no C compiler "
            f"({compiler or ', '.join(_COMPILERS)}); install one (Debian: apt install gcc "
            "libc6-dev; macOS: xcode-select --install)"
        )
    made = path.with_name(f".{path.name}.{os.getpid()}")
    includes = [f"-I{folder / part}" for part in ("core", "wire", "ports/sound")]
    files = sorted(_files(folder, suffix=".c"))
    done = subprocess.run(  # noqa: S603  the user's compiler
        [*compiler.split(), *_FLAGS, *includes, "-o", made, *files, "-lm"],
        capture_output=True,
        text=True,
        timeout=_TIMEOUT,
        check=False,
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["no message"]
        first = next((line for line in lines if "error" in line), lines[0])
        raise InputError(
            f"soft-amp: {compiler} could not compile the engine: {first}; install the C headers "
            "(Debian: apt install gcc libc6-dev)"
        )
    made.replace(path)


def _sources() -> Path:
    """The folder of the firmware's sources."""
    for folder in _FOLDERS:
        if (folder / "ports" / "sound").is_dir():
            return folder
    raise InputError(f"soft-amp: its C sources are missing in {_FOLDERS[0]}; reinstall era-haptics")


def _files(folder: Path, *, suffix: str) -> Iterable[Path]:
    yield from (folder / "core" / f"{name}{suffix}" for name in _CORE)
    yield from (folder / "wire" / f"{name}{suffix}" for name in _WIRE)
    yield from (folder / "ports" / "sound").glob(f"*{suffix}")


@cache
def _digest(folder: Path) -> str:
    """Of everything that the library is made of."""
    made_of = hashlib.sha256(repr((_FLAGS, os.environ.get("CC"), sys.platform)).encode())
    made_of.update(os.uname().machine.encode())
    for part in ("core", "wire", "ports/sound"):
        for path in sorted((folder / part).glob("*.[ch]")):
            made_of.update(path.name.encode() + path.read_bytes())
    return made_of.hexdigest()[:16]
