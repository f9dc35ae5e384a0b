"""Stable names of pseudo-terminals: symbolic links to them."""

import fcntl
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.parse import urlsplit

from model.errors import InputError

TERMINAL_SCHEMES = ("serial", "modbus+rtu", "can+slcan")


def links_by_amplifier(options: Sequence[str], *, amplifiers: Sequence[str]) -> dict[str, Path]:
    """The links of amplifiers by name; options: texts as `PATH` or `NAME=PATH`. Raises InputError.

    `PATH` alone is that of the first amplifier.
    """
    links: dict[str, Path] = {}
    for text in options:
        name, equals, path = text.partition("=")
        if not equals:
            name, path = amplifiers[0], text
        if name not in amplifiers:
            raise InputError(
                f"--link {text}: amplifier must be one of {', '.join(amplifiers)}, as in "
                f"--link {amplifiers[0]}=/tmp/{amplifiers[0]}"
            )
        if name in links or not path:
            raise InputError(f"--link {text}: must be NAME=PATH, once per amplifier")
        links[name] = Path(path)
    return links


@contextmanager
def linked_urls(urls: Mapping[str, str], links: Mapping[str, Path]) -> Iterator[dict[str, str]]:
    """URLs of amplifiers with their pseudo-terminals under other paths, both by name.

    Amplifiers of one line share its link. Raises InputError for a wire that is no pseudo-terminal.
    """
    with ExitStack() as stack:
        paths: dict[str, str] = {}
        for name, link in links.items():
            parts = urlsplit(urls[name])
            if parts.scheme not in TERMINAL_SCHEMES or parts.netloc:
                raise InputError(
                    f"--link {link}: amplifier {name} must be on a pseudo-terminal, got "
                    f"{urls[name]}"
                )
            if parts.path in paths:
                raise InputError(f"--link {link}: the line of {name} has one; give one per line")
            paths[parts.path] = stack.enter_context(linked(link, to=parts.path))
        yield {name: _moved(url, paths) for name, url in urls.items()}


def _moved(url: str, paths: Mapping[str, str]) -> str:
    before = urlsplit(url).path
    return url.replace(before, paths[before], 1) if before in paths else url


@contextmanager
def linked(link: Path, *, to: str) -> Iterator[str]:
    """A symbolic link to a path while this lasts; yields its absolute path. Raises InputError."""
    with _lock(link):
        _make(link, to=to)
        try:
            yield str(link.absolute())
        finally:
            _remove(link, to=to)


@contextmanager
def _lock(link: Path) -> Iterator[None]:
    """Keep others from a link; a lock ends with its process, even a killed one."""
    path = link.with_name(f".{link.name}.lock")
    try:
        file = path.open("wb")
    except OSError as problem:
        raise InputError(f"--link {link}: cannot be made: {problem.strerror}") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"--link {link}: in use by another amplifier; choose another path"
            ) from None
        yield


def _make(link: Path, *, to: str) -> None:
    if not link.is_symlink() and link.exists():
        raise InputError(f"--link {link}: exists and is no symbolic link; choose another path")
    made = link.with_name(f".{link.name}.{os.getpid()}")
    try:
        made.symlink_to(to)
        made.replace(link)
    except OSError as problem:
        raise InputError(f"--link {link}: cannot be made: {problem.strerror}") from None


def _remove(link: Path, *, to: str) -> None:
    if link.is_symlink() and str(link.readlink()) == to:  # not another's by now
        link.unlink()
