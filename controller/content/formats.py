"""Content formats by file extension, and the built-in contents; installed packages add formats."""

from operator import attrgetter
from pathlib import Path

from controller.content.ahap_format import Ahap
from controller.content.haptic_format import Haptic
from controller.content.hjif_format import Hjif
from controller.content.pattern import Pattern, misfit
from controller.content.reading import MAX_SIZE, ContentFormat, refusal, too_much
from controller.content.wav_format import Wav
from model.config.document import read_bytes
from model.errors import InputError
from registry.plugins import PluginRegistry, WrongResultError, did_you_mean

BUILT_IN_FORMATS: tuple[type[ContentFormat], ...] = (Ahap, Haptic, Hjif, Wav)
"""Built-in formats."""

_FORMATS: PluginRegistry[type[ContentFormat]] = PluginRegistry(
    "format of content",
    "era_haptics.content_formats",
    ContentFormat,
    error=InputError,
    own={file_format.ending: file_format for file_format in BUILT_IN_FORMATS},
    called=attrgetter("ending"),
)

_UNSUPPORTED = {
    "vij": "is version 0 of the .haptic format; export the content as .haptic, version 1",
    "hmpg": "is the binary form of HJIF; convert it to HJIF with the MPEG reference software, "
    "`Decoder -f FILE.hmpg -o FILE.hjif`, or WAV, `Synthesizer -b -f FILE.hmpg -o FILE.wav`",
}
"""Why files with an extension are rejected, and the remedy."""

_NAMED = Path(__file__).with_name("named")


def content_formats() -> tuple[str, ...]:
    """Return the extensions of all formats, built-in formats first; loads no plug-in."""
    return _FORMATS.names()


def content_format(ending: str, *, within: str = "") -> type[ContentFormat]:
    """Return the format of an extension; raises InputError if unknown or if its plug-in fails.

    within: the file's name, for the error.
    """
    return _FORMATS.find(ending, within=within)


def read_content(path: Path, channel: int | None = None) -> Pattern:
    """Read a content file; raises InputError, with line and key, if it cannot be read.

    channel: counted from 1, for formats with several channels; None for the first.
    """
    source = str(path)
    ending = _ending_of(path)
    if ending in _UNSUPPORTED:
        raise refusal(source, _UNSUPPORTED[ending])
    reader = content_format(ending, within=source)()
    if channel is None:
        channel = 1
    elif not reader.has_channels:
        raise refusal(source, f"channel must be left out: .{ending} has no channels")
    elif channel < 1:
        raise refusal(source, f"channel must be at least 1, got {channel}")
    content = read_bytes(
        path, MAX_SIZE, is_for="shorten the content", give="the content as a file of its own"
    )
    pattern = reader.read(content, source, channel)
    if not isinstance(pattern, Pattern):
        raise WrongResultError(reader, pattern, Pattern)
    count = len(pattern.intensity) + len(pattern.transients)
    problem = too_much(pattern.duration, count) or misfit(pattern)
    if problem:
        raise refusal(source, problem)
    return pattern


def _ending_of(path: Path) -> str:
    """Return the longest known extension of a file name, or else its last one."""
    name = path.name.lower()
    endings = [ending for ending in content_formats() if name.endswith(f".{ending}")]
    return max(endings, key=len, default=path.suffix[1:].lower())


def named_contents() -> tuple[str, ...]:
    """Return the names of the built-in contents."""
    return tuple(sorted(file.stem for file in _NAMED.iterdir()))


def named_content(name: str) -> Path:
    """Return the file of a built-in content; raises InputError for an unknown name."""
    for file in _NAMED.iterdir():
        if file.stem == name:
            return file
    names = named_contents()
    raise InputError(
        f"unknown content {name[:40]!a}; {did_you_mean(name, names)}known: {', '.join(names)}; "
        "the name of a file needs its ending"
    )
