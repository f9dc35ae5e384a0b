"""Compile the C libraries: the kernels of `model`, and the engine of `era soft-amp`.

    python build_libraries.py     # or: make kernels

compiles the libraries for this processor into the tree, if they are missing or their sources have
changed. The build hook (`hatch_build.py`) does the same for an editable installation, and compiles
the libraries for all processors into a wheel. Needs only the standard library and a C compiler.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from model.compiled.versions import Version, versions

ROOT = Path(__file__).parent

_COMPILERS = ("cc", "gcc", "clang")
_KERNEL_FLAGS = ("-std=gnu99", "-O2", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")
_ENGINE_FLAGS = (
    "-std=c99",
    "-O2",
    "-fno-math-errno",
    "-pthread",
    '-DCONFIG_FILE="sound_config.h"',
)
_ENGINE_SOURCES = (
    *("core/channel.c", "core/layers.c", "core/set.c"),
    *("core/sine.c", "core/states.c", "core/voice.c"),
    *("wire/crc.c", "wire/mbap.c", "wire/messages.c", "wire/modbus.c", "wire/serial.c"),
)
_ENGINE_FOLDERS = ("core", "wire", "ports/sound")
_BUILD_FILES = (Path(__file__), ROOT / "model/compiled/versions.py")


class BuildError(Exception):
    """A library cannot be compiled. The package works without it, slower or without sound."""


@dataclass(frozen=True)
class Library:
    """A shared library: its file relative to the project's folder, and how it is compiled."""

    file: str
    sources: tuple[Path, ...]
    headers: tuple[Path, ...]
    flags: tuple[str, ...]


def wheel_libraries() -> list[Library]:
    """Return the libraries of a wheel, with the kernels for all processors of this platform."""
    return [*map(kernel_library, versions()), *_posix_libraries()]


def tree_libraries() -> list[Library]:
    """Return the libraries of an editable installation, with the kernels for this processor."""
    return [kernel_library(_native_version()), *_posix_libraries()]


def kernel_library(version: Version) -> Library:
    """Return a version of the kernels."""
    folder = ROOT / "model" / "compiled"
    return Library(
        file=f"model/compiled/{version.file}",
        sources=tuple(sorted(folder.glob("*.c"))),
        headers=tuple(sorted(folder.glob("*.h"))),
        flags=(*_KERNEL_FLAGS, f"-DLANES={version.lanes}", *version.features.values()),
    )


def _posix_libraries() -> list[Library]:
    """Return the engine of the software amplifier where there are POSIX threads."""
    if os.name != "posix":
        return []
    return [engine_library()]


def engine_library() -> Library:
    """Return the engine of the software amplifier."""
    firmware = ROOT / "firmware"
    sources = [firmware / name for name in _ENGINE_SOURCES]
    sources += (firmware / "ports" / "sound").glob("*.c")
    headers: list[Path] = []
    flags = list(_ENGINE_FLAGS)
    for name in _ENGINE_FOLDERS:
        headers += (firmware / name).glob("*.h")
        flags.append(f"-I{firmware / name}")
    return Library(
        file="sim/soft_amp/sound-engine.so",
        sources=tuple(sorted(sources)),
        headers=tuple(sorted(headers)),
        flags=tuple(flags),
    )


def _native_version() -> Version:
    """Return the fastest version for the processor of this machine; raises BuildError."""
    command = [*_compiler(), "-march=native", "-dM", "-E", "-x", "c", os.devnull]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    macros = set(done.stdout.split())  # empty if the compiler does not know the processor
    for version in versions():
        flags = version.features.values()
        if all(f"__{flag.removeprefix('-m').upper()}__" in macros for flag in flags):
            return version
    raise AssertionError("the plain version is for every processor")


def _compiler() -> list[str]:
    """Return the command of the C compiler; raises BuildError if there is none."""
    command = os.environ.get("CC", "").split()
    names = command[:1] or _COMPILERS
    program = next(filter(shutil.which, names), None)
    if program is None:
        raise BuildError(
            f"no C compiler ({', '.join(names)}); install one (Debian: apt install gcc libc6-dev; "
            "macOS: xcode-select --install)"
        )
    return command or [program]


def compile_library(library: Library, path: Path) -> None:
    """Compile a library to a file; raises BuildError."""
    command = [*_compiler(), *library.flags, "-fPIC", "-shared", "-o", str(path)]
    command += map(str, library.sources)
    command.append("-lm")
    done = subprocess.run(  # noqa: S603  the user's compiler
        command, capture_output=True, encoding="utf-8", errors="replace", check=False
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["no message"]
        first_error = next((line for line in lines if "error" in line), lines[0])
        raise BuildError(f"{library.file} could not be compiled by {command[0]}: {first_error}")


def update(libraries: Iterable[Library], folder: Path = ROOT) -> None:
    """Compile those libraries of a tree that are not those of their sources; raises BuildError.

    A library has the time of its newest source file.
    """
    for library in libraries:
        path = folder / library.file
        inputs = (*library.sources, *library.headers, *_BUILD_FILES)
        source_time = max(file.stat().st_mtime_ns for file in inputs)
        if path.exists() and path.stat().st_mtime_ns == source_time:
            continue
        # Programs that use the old library keep it, and no program loads a half-written one.
        with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as own_folder:
            compiled = Path(own_folder) / path.name
            compile_library(library, compiled)
            os.utime(compiled, ns=(source_time, source_time))
            compiled.replace(path)


def main() -> None:
    """Compile the libraries of this tree, or print why that is not possible."""
    try:
        update(tree_libraries())
    except BuildError as error:
        sys.stdout.write(f"Without C kernels, answers are computed by numpy: {error}\n")


if __name__ == "__main__":
    main()
