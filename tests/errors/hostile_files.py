"""Hostile files, each fed to a reader in a process of its own, with what came of it.

The process is forked off one that has loaded every reader. It reads one variant after another of
a reader's valid file, and reports the outcome, the memory above that before, and the time of the
processor. A variant that waits for ever is reported as such.
"""

import contextlib
import ctypes
import gc
import gzip
import io
import json
import os
import pickle
import random
import re
import resource
import select
import signal
import socket
import struct
import subprocess
import sys
import time
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

MIB = 1 << 20
LONG = 8 * MIB  # bytes of long lines and of many short ones
_BOMB = 1 << 27  # bytes of zeros, deflated to 570 kB; twice what a reader can use
_MAX_DATA = 2 << 30  # bytes; a reader that wants more fails, and the machine goes on
_SILENCE = 120.0  # s until a variant counts as one that waits for ever
_DIGITS = b"9" * 100_000

Content = Callable[[bytes], bytes]


def _in_npz(change: Callable[[dict[str, bytes]], bytes]) -> Content:
    """Make content of the members of a valid archive, or of some arrays."""

    @cache
    def changed(archive: bytes) -> bytes:
        with zipfile.ZipFile(io.BytesIO(archive)) as opened:
            members = {name: opened.read(name) for name in opened.namelist()}
        return change(members)

    return lambda sample: changed(sample if sample.startswith(b"PK") else _some_arrays())


@cache
def _some_arrays() -> bytes:
    content = io.BytesIO()
    np.savez(content, nodes=np.zeros((4, 3)), frequencies=np.ones(2), shapes=np.ones((2, 4, 3)))
    return content.getvalue()


def _archive(members: Mapping[str, bytes], *, compression: int = zipfile.ZIP_STORED) -> bytes:
    content = io.BytesIO()
    with (
        warnings.catch_warnings(),
        zipfile.ZipFile(content, "w", compression, compresslevel=1) as archive,
    ):
        warnings.simplefilter("ignore")  # of names that stand twice
        for name, data in members.items():
            archive.writestr(name, data)
    return content.getvalue()


def _with_first(make: Callable[[bytes], bytes]) -> Content:
    """Replace the first member, an .npy file."""

    def change(members: dict[str, bytes]) -> bytes:
        first = next(iter(members))
        return _archive(members | {first: make(members[first])})

    return _in_npz(change)


def _npy(header: bytes, data: bytes = b"") -> bytes:
    padded = header + b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(padded)) + padded + data


def _of_shape(shape: bytes, data: bytes = bytes(32)) -> Content:
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': %s}" % shape
    return _with_first(lambda _: _npy(header, data))


def _values(value: float) -> Content:
    """Set every value of every array of floats."""

    def change(members: dict[str, bytes]) -> bytes:
        changed = {}
        for name, data in members.items():
            array = np.load(io.BytesIO(data))
            if array.dtype.kind == "f":
                array = np.full_like(array, value)
            stream = io.BytesIO()
            np.save(stream, array)
            changed[name] = stream.getvalue()
        return _archive(changed)

    return _in_npz(change)


def _patched(members: dict[str, bytes], *, flags: int = 0, method: int | None = None) -> bytes:
    """An archive whose members have these flags and this method, in both places that state them."""
    content = bytearray(_archive(members))
    for mark, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        for found in re.finditer(re.escape(mark), bytes(content)):
            place = found.start() + at
            (old_flags, old_method) = struct.unpack_from("<HH", content, place)
            new_method = old_method if method is None else method
            struct.pack_into("<HH", content, place, old_flags | flags, new_method)
    return bytes(content)


@cache
def _bomb() -> bytes:
    return _npy(
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d,)}" % (_BOMB // 8), bytes(_BOMB)
    )


def _broken_deflate(members: dict[str, bytes]) -> bytes:
    content = bytearray(_archive(members, compression=zipfile.ZIP_DEFLATED))
    content[60:120] = b"\xff" * 60
    return bytes(content)


def _object_array() -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.array([{"a": 1}, None], dtype=object), allow_pickle=True)
    return stream.getvalue()


@cache
def _many_members() -> bytes:
    """An archive of 60 000 empty members: 3 MB, of which 40 MB of objects are made."""
    entry = b"PK\x01\x02" + struct.pack(
        "<6H3I5H2I", *[20, 20, 0, 0, 0, 0x21], *[0] * 3, 1, *[0] * 6
    )
    directory = (entry + b"x") * 60_000
    return directory + struct.pack(
        "<4s4H2IH", b"PK\x05\x06", 0, 0, 60_000, 60_000, len(directory), 0, 0
    )


@cache
def _png_bomb() -> bytes:
    """A picture of 40000 x 30000 pixels of one colour: 1.2 GB of grey, 0.15 MB of PNG."""

    def chunk(name: bytes, data: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(name + data))
        return struct.pack(">I", len(data)) + name + data + check

    packer = zlib.compressobj(1)
    row = bytes(1 + 40_000 // 8)
    rows = b"".join(packer.compress(row) for _ in range(30_000)) + packer.flush()
    header = struct.pack(">IIBBBBB", 40_000, 30_000, 1, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    )


def _wav(sample: bytes, **form: int) -> bytes:
    from kit.outside_files import wav

    return wav(sample, **{"code": 1, "channels": 1, "rate": 8000, "bits": 16} | form)


def _always(make: Callable[[], bytes]) -> Content:
    """Content that does not depend on a valid file."""
    return lambda _: make()


def _in_text(change: Content) -> Content:
    """Change text, and leave other files as they are."""
    return lambda sample: sample if b"\0" in sample else change(sample)


_NUMBER = re.compile(rb"(?<![\w.])-?\d+\.\d+(?:[eE][-+]?\d+)?(?![\w.])")


def _numbers(word: bytes) -> Content:
    """Replace every number with a decimal point in text; `_values` does it in arrays."""
    return _in_text(lambda sample: _NUMBER.sub(word, sample))


def _packed(sample: bytes) -> bytes:
    return _archive({"inner": sample}, compression=zipfile.ZIP_DEFLATED)


_NOISE = random.Random(1).randbytes(1 << 16)

CONTENTS: Mapping[str, Content] = {
    "empty": lambda _: b"",
    "zeros": lambda _: bytes(1 << 16),
    "noise": lambda _: _NOISE,
    "noise behind a valid start": lambda sample: sample[:20] + _NOISE,
    "cut in half": lambda sample: sample[: len(sample) // 2],
    "zero bytes inside": _in_text(lambda sample: sample[:50] + bytes(9) + sample[50:]),
    "no UTF-8": lambda _: b'{"a": "\xfc\xff\xfe"}\n1,\xe9,3\n',
    "UTF-16": lambda sample: sample.decode("latin-1").encode("utf-16"),
    "UTF-32": lambda sample: sample.decode("latin-1").encode("utf-32"),
    "surrogates as UTF-8": _in_text(lambda sample: b"a\xed\xa0\x80: 1\n" + sample),
    "surrogates in JSON": lambda _: b'{"a\\ud800": "\\udfff"}',
    "control characters": lambda _: b"\x1b[2J\x1b]0;title\x07: \x1b[31m\n",
    "a long line": lambda _: b"a" * LONG,
    "a long key": lambda _: b"a" * 500_000 + b": 1\n",
    "many empty lines": lambda _: b"\n\r\n" * (LONG // 3),
    "many commas": lambda _: b"," * LONG,
    "digits": lambda _: _DIGITS,
    "digits in JSON": lambda _: b'{"a": %s}' % _DIGITS,
    "digits of a dataset": lambda _: b"    -1\n%s\n 1\n    -1\n" % _DIGITS,
    "digits of a binary dataset": lambda _: (
        b"    -1\n    58b 1 2 11 %s 0 0\n 1\n    -1\n" % _DIGITS
    ),
    "many datasets": lambda _: b"    -1\n    58\n    -1\n" * 200_000,
    "deep brackets": lambda _: b"[" * MIB,
    "deep objects": lambda _: b'{"a":' * (MIB // 5),
    "deep lists": lambda _: b"- " * (MIB // 2),
    "deep mappings": lambda _: b"? " * (MIB // 2),
    "aliases that multiply": lambda _: (
        b"a: &a [1, 1]\n"
        + b"".join(b"%c: &%c [*%c, *%c]\n" % (n + 1, n + 1, n, n) for n in range(97, 121))
    ),
    "a tag that runs code": lambda _: b"a: !!python/object/apply:os.system [ls]\n",
    "keys given twice": lambda _: b'{"a": 1, "a": 2}\n',
    "NaN in JSON": lambda _: b'{"a": NaN, "b": -Infinity, "c": 1e999}',
    "NaN for every number": _numbers(b"nan"),
    "1e999 for every number": _numbers(b"1e999"),
    "digits for every number": _numbers(b"9" * 5000),
    "NaN in every array": _values(float("nan")),
    "gzip": gzip.compress,
    "zip": _packed,
    "zip whose end lies": lambda _: b"PK\x05\x06" + b"\xff" * 18,
    "zip of 60 000 members": _always(_many_members),
    "archive that is deflated": _in_npz(partial(_archive, compression=zipfile.ZIP_DEFLATED)),
    "archive that is encrypted": _in_npz(partial(_patched, flags=1)),
    "archive of an unknown method": _in_npz(partial(_patched, method=99)),
    "archive with a broken stream": _in_npz(_broken_deflate),
    "archive that is cut": _in_npz(lambda members: _archive(members)[:-30]),
    "archive with another member": _in_npz(lambda members: _archive(members | {"x.npy": b""})),
    "bomb of zeros": _in_npz(
        lambda members: _archive(
            members | {next(iter(members)): _bomb()}, compression=zipfile.ZIP_DEFLATED
        )
    ),
    "array of a terabyte": _of_shape(b"(137438953472,)"),
    "array of many empty rows": _of_shape(b"(1099511627776, 0)", b""),
    "array of negative shape": _of_shape(b"(-1, -4)"),
    "array of a shape of digits": _of_shape(b"(%s,)" % (b"9" * 5000)),
    "array without a tuple": _of_shape(b"4"),
    "array of brackets": _with_first(lambda _: _npy(b"(((")),
    "array of deep brackets": _with_first(lambda _: _npy(b"(" * 9000)),
    "array of records": _with_first(
        lambda _: _npy(
            b"{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,)}", bytes(8)
        )
    ),
    "array of objects": _with_first(lambda _: _object_array()),
    "array that is a pickle": _with_first(lambda _: pickle.dumps({"a": 1})),
    "pickle": lambda _: pickle.dumps({"nodes": [1, 2, 3]}),
    ".npy": lambda _: _npy(b"{'descr': '<f8', 'fortran_order': False, 'shape': (1,)}", bytes(8)),
    "picture of 1.2 gigapixels": _always(_png_bomb),
    "picture that is cut": lambda _: _png_bomb()[:60],
    "sound without a format": lambda _: b"RIFF\0\0\0\0WAVEdata\0\0\0\0" + bytes(999),
    "sound of 65535 channels": lambda _: _wav(bytes(4 * 65535), channels=65535, bits=8),
    "sound without channels": lambda _: _wav(bytes(999), channels=0),
    "sound of NaN": lambda _: _wav(np.full(9999, np.nan, "<f4").tobytes(), code=3, bits=32),
    "sound of 4 GHz": lambda _: _wav(bytes(999), rate=4_000_000_000),
}
"""By what a variant is, its content, made of that of a valid file; an equal one is left out."""


def _socket(path: Path) -> None:
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))


PLACES: Mapping[str, Callable[[Path], object]] = {
    "missing": lambda path: None,
    "folder": Path.mkdir,
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "socket": _socket,
    "link to itself": lambda path: path.symlink_to(path.name),
    "sparse file of a terabyte": lambda path: [path.touch(), os.truncate(path, 1 << 40)],
}
"""By what a path is, how it is made."""

VARIANTS = (*PLACES, *CONTENTS)


@dataclass(frozen=True)
class Report:
    """What came of reading a variant."""

    variant: str
    outcome: Literal["read", "refused", "bug"]
    text: str
    """The message, or what was read."""

    size: int
    """Size of the file [bytes], 0 of what is no file."""

    memory: int
    """Most memory of the process above that before [bytes]."""

    seconds: float
    """Time of the processor."""


class HostileReading:
    """A process that has loaded all readers; use as a context manager."""

    def __enter__(self) -> "HostileReading":
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def reports(self, name: str, folder: Path) -> Iterator[Report]:
        """What the reader of a name makes of each variant, in a new folder."""
        reading, writing = self._process.stdout, self._process.stdin
        assert reading is not None
        assert writing is not None
        writing.write(f"{json.dumps([name, str(folder)])}\n".encode())
        writing.flush()
        (child,) = json.loads(reading.readline())
        while True:
            if not select.select([reading], [], [], _SILENCE)[0]:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(child, signal.SIGKILL)
            answer = json.loads(reading.readline())
            if answer is None:
                return
            yield Report(**answer)


def main() -> None:
    """Fork off a process for each reader that standard input names."""
    from kit.outside_files import READERS, SAMPLES

    warnings.simplefilter("error")
    for content in CONTENTS.values():
        content(b"")  # what is slow is made once
    gc.freeze()  # and never visited
    for line in sys.stdin:
        name, folder = json.loads(line)
        sample = SAMPLES[name]()
        with contextlib.suppress(Exception):  # loads the modules that it needs
            READERS[name](_written(Path(folder) / "valid" / name, sample))
        child = os.fork()
        if child == 0:
            limit = resource.getrlimit(resource.RLIMIT_DATA)[1]
            resource.setrlimit(resource.RLIMIT_DATA, (_MAX_DATA, limit))
            _print([os.getpid()])
            for variant in VARIANTS:
                if variant in PLACES or CONTENTS[variant](sample) != sample:
                    _print(vars(_read(READERS[name], variant, Path(folder), name, sample)))
            os._exit(0)
        if status := os.waitpid(child, 0)[1]:
            _print(vars(Report("the next", "bug", f"ended, or waits: {status}", 0, 0, 0.0)))
        _print(None)


def _print(answer: Any) -> None:
    sys.stdout.write(f"{json.dumps(answer)}\n")
    sys.stdout.flush()


def _written(path: Path, content: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    path.chmod(0o600)
    return path


def _read(
    read: Callable[[Path], object], variant: str, folder: Path, name: str, sample: bytes
) -> Report:
    from drivers.errors import CommandError
    from model.errors import InputError

    path = folder / str(VARIANTS.index(variant)) / name
    size = 0
    if variant in PLACES:
        path.parent.mkdir(parents=True)
        PLACES[variant](path)
    else:
        content = CONTENTS[variant](sample)
        size = len(content)
        _written(path, content)
        del content
    with contextlib.suppress(Exception):  # again, so that its code is in memory
        read(_written(folder / "small" / name, b"x"))
    outcome: Literal["read", "refused", "bug"]
    before = _start_measuring()
    started = time.process_time()
    try:
        text, outcome = repr(read(path))[:200], "read"
    except (InputError, CommandError) as error:
        text, outcome = str(error), "refused"
    except BaseException as error:
        text, outcome = f"{type(error).__name__}: {error}", "bug"
    seconds = time.process_time() - started
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    if path.is_file() and not path.is_symlink():
        path.unlink()
    return Report(variant, outcome, text, size, memory, seconds)


def _start_measuring() -> int:
    """Forget the most memory so far; return that of now [bytes]."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # what was freed is not used again without being counted
    Path("/proc/self/clear_refs").write_text("5", "ascii")
    pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
    return pages * resource.getpagesize()


if __name__ == "__main__":
    main()
