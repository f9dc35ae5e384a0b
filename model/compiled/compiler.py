"""Compilation of C sources to a library, by the compiler of the machine."""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from model.errors import InputError

_COMPILERS = ("cc", "gcc", "clang")
_TIMEOUT = 120.0  # s


def compile_library(
    path: Path, sources: Iterable[Path], *, flags: Sequence[str], what: str
) -> None:
    """Compile C sources to a shared library; what: its name in messages. Raises InputError."""
    compiler = os.environ.get("CC") or next(filter(shutil.which, _COMPILERS), None)
    if compiler is None or not shutil.which(compiler.split()[0]):
        raise InputError(
            f"{what} is compiled at first use and there is no C compiler "
            f"({compiler or ', '.join(_COMPILERS)}); install one (Debian: apt install gcc "
            "libc6-dev; macOS: xcode-select --install)"
        )
    made = path.with_name(f".{path.name}.{os.getpid()}")
    done = subprocess.run(  # noqa: S603  the user's compiler
        [*compiler.split(), *flags, "-fPIC", "-shared", "-o", made, *sorted(sources), "-lm"],
        capture_output=True,
        text=True,
        timeout=_TIMEOUT,
        check=False,
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["no message"]
        first = next((line for line in lines if "error" in line), lines[0])
        raise InputError(
            f"{what} could not be compiled by {compiler}: {first}; install the C headers "
            "(Debian: apt install gcc libc6-dev)"
        )
    made.replace(path)


def kept_library(
    name: str,
    sources: Iterable[Path],
    headers: Iterable[Path] = (),
    *,
    flags: Sequence[str],
    what: str,
) -> Path:
    """The library of C sources in the user's cache, compiled if there is none.

    Raises InputError, and OSError where no cache can be written.
    """
    import platformdirs

    sources = list(sources)
    kept = platformdirs.user_cache_path("era-haptics", appauthor=False)
    path = kept / f"{name}-{_digest([*sources, *headers], flags)}.so"
    if not path.exists():
        kept.mkdir(parents=True, exist_ok=True)
        compile_library(path, sources, flags=flags, what=what)
    return path


def _digest(files: Iterable[Path], flags: Sequence[str]) -> str:
    """Sixteen digits that change with the files, the flags, the compiler and the machine."""
    made_of = hashlib.sha256(repr((*flags, os.environ.get("CC"), sys.platform)).encode())
    made_of.update(platform.machine().encode())
    for path in sorted(files):
        made_of.update(path.name.encode() + path.read_bytes())
    return made_of.hexdigest()[:16]
