"""The compiled library: built, cached, refused if damaged; its memory under sanitizers."""

import ctypes
import hashlib
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import model.compiled
from model.compiled import kernels as library_cache
from model.compiled.kernels import (
    Version,
    compile_library,
    kernels,
    processor_features,
    versions,
    why_slow,
)
from model.errors import InputError

HERE = Path(__file__).parent
RUNNABLE = [each for each in versions() if each.features.keys() <= processor_features()]
SANITIZERS = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@pytest.mark.long
@pytest.mark.parametrize("version", RUNNABLE, ids=lambda each: each.name)
def test_knots_are_within_the_stroke_and_their_memory(version: Version, tmp_path: Path) -> None:
    """Of 28 random tones, huge, silent and undefined ones too, and without memory for one.

    Some reach the bound of full stroke, and none is beyond it.
    """
    program = tmp_path / "harness"
    folder = Path(*model.compiled.__path__)
    files = (f"-I{folder}", "-o", str(program), str(HERE / "knots_harness.c"), "-lm")
    subprocess.run(["cc", *version.flags, *SANITIZERS, *files], check=True)
    done = subprocess.run([program], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "1.000"
    assert not done.stderr


_PROGRAM = """
import sys
from pathlib import Path
from model.compiled.kernels import kept_library
found = kept_library("seven", [Path(sys.argv[1])], flags=(), what="seven")
print(found.seven())
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The cache folder of these tests."""
    return tmp_path / "cache" / "era-haptics"


def seven(folder: Path) -> int:
    """What a function that returns seven gives, compiled or kept, in a process of its own."""
    source = folder.parents[1] / "seven.c"
    source.write_text("int seven(void) { return 7; }")
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, str(source)],
        env=os.environ | {"XDG_CACHE_HOME": str(folder.parent)},
        capture_output=True,
        text=True,
        check=True,
    )
    return int(done.stdout)


def forge(path: Path, *, mode: int = 0o755, checksum_mode: int = 0o644) -> None:
    """Put a library there that returns eight, with its checksum, of these rights."""
    source = path.with_suffix(".c")
    source.write_text("int seven(void) { return 8; }")
    compile_library(path, [source], flags=(), what="eight")
    source.unlink()
    path.chmod(mode)
    checksum = path.with_name(f"{path.name}.sha256")
    checksum.write_text(hashlib.sha256(path.read_bytes()).hexdigest())
    checksum.chmod(checksum_mode)


def exchange(path: Path) -> None:
    """Put another library there, without its checksum."""
    forge(path)
    path.with_name(f"{path.name}.sha256").unlink()


def test_library_unsafe_or_not_whole_is_compiled_again(folder: Path) -> None:
    """It is not loaded, and the next process finds a good one.

    The first page alone is left after a power failure: what is mapped beyond it is SIGBUS. Every
    user may have written a library or its checksum.
    """
    assert seven(folder) == 7
    (path,) = folder.glob("*.so")
    good = path.read_bytes()
    for damage in (
        lambda: os.truncate(path, 4096),
        lambda: forge(path, mode=0o777),
        lambda: forge(path, checksum_mode=0o666),
        lambda: exchange(path),
    ):
        damage()
        assert seven(folder) == 7
        assert path.read_bytes() == good
    forge(path)  # safe and whole: what is kept is loaded
    assert seven(folder) == 8


@pytest.mark.long
def test_folder_in_which_others_write_is_not_used(folder: Path) -> None:
    """Neither the folder nor one above it, unless it is sticky as /tmp; no library is left."""
    assert seven(folder) == 7
    (path,) = folder.glob("*.so")
    forge(path)
    for each in (folder, folder.parent):
        each.chmod(0o777)
        assert seven(folder) == 7
        each.chmod(0o700)
    assert seven(folder) == 8
    folder.parent.chmod(0o1777)
    assert seven(folder) == 8


@pytest.mark.long
def test_link_in_a_folder_of_others_is_not_followed(folder: Path) -> None:
    """They could lead it to any library that the user keeps; one of the user's own is followed."""
    kept = folder.parents[1] / "kept"
    kept.mkdir(mode=0o700)
    folder.parent.symlink_to(kept)
    assert seven(folder) == 7
    (path,) = folder.glob("*.so")
    forge(path)
    assert seven(folder) == 8
    shared = folder.parents[1] / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    folder.parent.rename(shared / "link")
    folder.parent.symlink_to(shared / "link")
    assert seven(folder) == 7


def test_files_of_another_user_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Root's are not: who could write them need not."""
    path = tmp_path / "library.so"
    path.touch(0o755)
    library_cache.check_own(path)
    owner = os.geteuid()
    if owner:
        monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    else:
        os.chown(path, 1, -1)
    with pytest.raises(PermissionError):
        library_cache.check_own(path)
    library_cache.check_own(Path("/"))


def test_least_recently_used_libraries_are_removed(folder: Path) -> None:
    """With their checksums; names hold the C library, so that another one compiles its own."""
    folder.mkdir(parents=True, mode=0o700)
    for number in range(library_cache.MAX_KEPT_LIBRARIES + 1):
        for name in (f"old{number}.so", f"old{number}.so.sha256"):
            (folder / name).touch()
            os.utime(folder / name, (number, number))
    assert seven(folder) == 7
    (path,) = folder.glob("seven-*.so")
    kept = {f"old{number}.so" for number in range(2, library_cache.MAX_KEPT_LIBRARIES + 1)}
    kept |= {path.name}
    assert {each.name for each in folder.iterdir()} == kept | {f"{name}.sha256" for name in kept}
    assert os.confstr("CS_GNU_LIBC_VERSION").replace(" ", "") in path.name


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Of a function that returns seven."""
    path = tmp_path / "seven.c"
    path.write_text("int seven(void) { return 7; }")
    return path


@pytest.mark.parametrize("cc", ["/nowhere/cc", "false", "sleep 60 #"])
def test_compiler_that_gives_no_library_is_bad_input(
    cc: str,
    source: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    without_kernels: Callable[[], None],
) -> None:
    """Neither is there a file then, nor a part of one.

    Without a compiler there is no library, no error, and words that say how much slower it is.
    """
    assert kernels() is not None
    assert why_slow() is None
    with monkeypatch.context() as patch:
        patch.setenv("CC", cc)
        patch.setattr(library_cache, "_TIMEOUT", 0.01)
        with pytest.raises(InputError):
            compile_library(tmp_path / "seven.so", [source], flags=(), what="seven")
    assert [path.name for path in tmp_path.iterdir()] == ["seven.c"]
    without_kernels()
    assert kernels() is None
    assert why_slow()


def test_threads_compile_the_same_at_once(source: Path, tmp_path: Path) -> None:
    """Each in a folder of its own, so that no thread loads a part of the library."""
    path = tmp_path / "seven.so"

    def load(_: int) -> int:
        compile_library(path, [source], flags=(), what="seven")
        return int(ctypes.CDLL(str(path)).seven())

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(load, range(4))) == [7] * 4
    assert {each.name for each in tmp_path.iterdir()} == {"seven.c", "seven.so"}
