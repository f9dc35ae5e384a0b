"""Formats of content by the ending of a file: those of the project and of installed packages.

Also the named contents that come with the project.
"""

from operator import attrgetter
from pathlib import Path

from controller.content.ahap import Ahap
from controller.content.format import MAX_SIZE, ContentFormat, refusal, too_much
from controller.content.haptic import Haptic
from controller.content.hjif import Hjif
from controller.content.pattern import Pattern, misfit
from controller.content.wav import Wav
from model.config.document import read_bytes
from model.errors import InputError
from registry.plugins import PluginRegistry, WrongResultError, did_you_mean

BUILT_IN: tuple[type[ContentFormat], ...] = (Ahap, Haptic, Hjif, Wav)
"""The formats of the project itself."""

_FORMATS: PluginRegistry[type[ContentFormat]] = PluginRegistry(
    "format of content",
    "era_haptics.content_formats",
    ContentFormat,
    error=InputError,
    own={each.ending: each for each in BUILT_IN},
    called=attrgetter("ending"),
)

_REFUSED = {
    "vij": "is version 0 of the .haptic format; export the content as .haptic, version 1",
    "hmpg": "is the binary form of HJIF; make HJIF of it with the MPEG reference software, "
    "`Decoder -f FILE.hmpg -o FILE.hjif`, or WAV, `Synthesizer -b -f FILE.hmpg -o FILE.wav`",
}

_NAMED = Path(__file__).with_name("named")


def content_formats() -> tuple[str, ...]:
    """Return the endings of all formats, those of the project first, without any plug-in."""
    return _FORMATS.names()


def content_format(ending: str, *, within: str = "") -> type[ContentFormat]:
    """Return the format of an ending; raises InputError if it is unknown or its plug-in fails.

    within: the file's name, for the error.
    """
    return _FORMATS.find(ending, within=within)


def read_content(path: Path, channel: int | None = None) -> Pattern:
    """Read a file of content; raises InputError, with line and key, for one that cannot be read.

    channel: which one, counted from 1, of a format that has several; None for the first.
    """
    source, name = str(path), path.name.lower()
    known = [each for each in content_formats() if name.endswith(f".{each}")]
    ending = max(known, key=len, default=path.suffix[1:].lower())
    if ending in _REFUSED:
        raise refusal(source, _REFUSED[ending])
    reader = content_format(ending, within=source)()
    if channel is not None and not reader.has_channels:
        raise refusal(source, f"channel must be left out: .{ending} has no channels")
    if channel is not None and channel < 1:
        raise refusal(source, f"channel must be at least 1, got {channel}")
    given = read_bytes(
        path, MAX_SIZE, is_for="shorten the content", give="the content as a file of its own"
    )
    pattern = reader.read(given, source, channel or 1)
    if not isinstance(pattern, Pattern):
        raise WrongResultError(reader, pattern, Pattern)
    count = len(pattern.intensity) + len(pattern.transients)
    if problem := too_much(pattern.duration, count) or misfit(pattern):
        raise refusal(source, problem)
    return pattern


def named_contents() -> tuple[str, ...]:
    """Return the names of the contents that come with the project."""
    return tuple(sorted(each.stem for each in _NAMED.iterdir()))


def named_content(name: str) -> Path:
    """Return the file of a named content; raises InputError for an unknown name."""
    for each in _NAMED.iterdir():
        if each.stem == name:
            return each
    known = named_contents()
    raise InputError(
        f"unknown content {name[:40]!a}; {did_you_mean(name, known)}known are {', '.join(known)}; "
        "the name of a file needs its ending"
    )
