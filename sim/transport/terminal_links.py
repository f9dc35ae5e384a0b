"""Symbolic links to the pseudo-terminals of simulated amplifiers: paths that do not change."""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.parse import urlsplit

from drivers.wires.wire import address_of
from model.errors import InputError
from registry import files


def links_by_amplifier(options: Sequence[str], *, amplifiers: Sequence[str]) -> dict[str, Path]:
    """The links of amplifiers by name; options: `NAME=PATH`, or `PATH` for the first amplifier.

    Raises InputError.
    """
    links: dict[str, Path] = {}
    for text in options:
        name, equals, path = text.partition("=")
        if not equals:
            name, path = amplifiers[0], text
        if name not in amplifiers:
            raise InputError(
                f"--link {text}: amplifier must be one of {', '.join(amplifiers)}, such as "
                f"--link {amplifiers[0]}=/tmp/{amplifiers[0]}"
            )
        if name in links or not path:
            raise InputError(f"--link {text}: must be NAME=PATH, once per amplifier")
        links[name] = Path(path)
    return links


@contextmanager
def linked_urls(urls: Mapping[str, str], links: Mapping[str, Path]) -> Iterator[dict[str, str]]:
    """URLs of amplifiers with their pseudo-terminals under other paths, both by name.

    Amplifiers on the same line share its link. Raises InputError for a wire without a
    pseudo-terminal.
    """
    with ExitStack() as stack:
        paths: dict[str, str] = {}
        for name, link in links.items():
            terminal = urlsplit(urls[name]).path
            if not address_of(urls[name]).place.device:
                raise InputError(
                    f"--link {link}: amplifier {name} must be on a pseudo-terminal, got "
                    f"{urls[name]}"
                )
            if terminal in paths:
                raise InputError(f"--link {link}: the line of {name} has one; give one per line")
            paths[terminal] = stack.enter_context(linked(link, to=terminal))
        yield {name: _moved(url, paths) for name, url in urls.items()}


def _moved(url: str, paths: Mapping[str, str]) -> str:
    """The URL with the link of its pseudo-terminal, if it has one."""
    terminal = urlsplit(url).path
    if terminal not in paths:
        return url
    return url.replace(terminal, paths[terminal], 1)


@contextmanager
def linked(link: Path, *, to: str) -> Iterator[str]:
    """A symbolic link to a path in this context; yields its absolute path. Raises InputError."""
    with _lock(link):
        if not link.is_symlink() and link.exists():
            raise InputError(f"--link {link}: exists and is no symbolic link; choose another path")
        temporary = link.with_name(f".{link.name}.{os.getpid()}")
        try:
            temporary.symlink_to(to)
            temporary.replace(link)
        except OSError as problem:
            raise InputError(f"--link {link}: cannot be made: {problem.strerror}") from None
        try:
            yield str(link.absolute())
        finally:
            # Another program may have replaced it meanwhile.
            if link.is_symlink() and str(link.readlink()) == to:
                link.unlink()


@contextmanager
def _lock(link: Path) -> Iterator[None]:
    """Lock a link against other programs; the lock ends with its process, even if killed."""
    path = link.with_name(f".{link.name}.lock")
    try:
        file = path.open("wb")
    except OSError as problem:
        raise InputError(f"--link {link}: cannot be made: {problem.strerror}") from None
    with file:
        try:
            files.lock(file)
        except BlockingIOError:
            raise InputError(
                f"--link {link}: in use by another amplifier; choose another path"
            ) from None
        yield
