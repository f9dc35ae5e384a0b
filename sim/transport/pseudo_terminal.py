"""Pseudo-terminals: the host opens one side, the far end the other; symbolic links name them."""

import asyncio
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from urllib.parse import urlsplit

from drivers.errors import LinkError
from model.errors import InputError
from registry import files

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
            files.lock(file)
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


_READ_MAX = 4096


class PseudoTerminal:
    """The far end's side of a serial line: a pseudo-terminal of the system. Raises LinkError.

    on_data: called with bytes from the host; unpluggable: the port is a symbolic link, which
    outlives each pseudo-terminal. What a host does not read is lost.
    """

    def __init__(self, on_data: Callable[[bytes], None], *, unpluggable: bool = False) -> None:
        self._on_data = on_data
        self._master = self._slave = -1
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.plug_in()
        if unpluggable:
            self._folder = tempfile.TemporaryDirectory(prefix="era-line-")
            self._link()

    @property
    def port(self) -> str:
        """The path of the host's side."""
        if self._folder is not None:
            return str(Path(self._folder.name) / "port")
        return os.ttyname(self._slave)

    def plug_in(self) -> None:
        """Create the line if it is unplugged; raises LinkError."""
        if self._master >= 0:
            return
        try:
            import tty  # not on Windows

            self._master, self._slave = os.openpty()
        except OSError as error:
            raise LinkError(
                f"cannot create a pseudo-terminal: {error.strerror}; close programs that use some, "
                "or raise kernel.pty.max"
            ) from error
        # Kept open, so that hosts may disconnect without a hang-up.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        if self._folder is not None:
            self._link()

    def listen(self) -> None:
        """Read from now on, in the running event loop."""
        asyncio.get_running_loop().add_reader(self._master, self._readable)

    def unplug(self) -> None:
        """Remove the line."""
        if self._master < 0:
            return
        asyncio.get_running_loop().remove_reader(self._master)
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1
        if self._folder is not None:
            Path(self.port).unlink(missing_ok=True)

    def plug(self, is_plugged: bool) -> None:
        """Unplug the line, or plug it in and read again."""
        if is_plugged:
            self.plug_in()
            self.listen()
        else:
            self.unplug()

    def close(self) -> None:
        """Release all resources."""
        self.unplug()
        if self._folder is not None:
            self._folder.cleanup()

    def write(self, data: bytes) -> None:
        """Write to the host; discarded while unplugged."""
        if self._master < 0:
            return
        with suppress(BlockingIOError):
            os.write(self._master, data)

    def _link(self) -> None:
        link = Path(self.port)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self._slave))

    def _readable(self) -> None:
        try:
            data = os.read(self._master, _READ_MAX)
        except BlockingIOError:  # another wake-up took the bytes
            return
        self._on_data(data)


TERMINAL_MAKER: ContextVar[Callable[..., PseudoTerminal]] = ContextVar(
    "TERMINAL_MAKER", default=PseudoTerminal
)
"""The factory in this context."""


def make_terminal(on_data: Callable[[bytes], None], *, unpluggable: bool = False) -> PseudoTerminal:
    """Create a serial line; see `PseudoTerminal`."""
    return TERMINAL_MAKER.get()(on_data, unpluggable=unpluggable)
