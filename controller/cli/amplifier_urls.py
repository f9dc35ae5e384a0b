"""URLs of a rig's amplifiers: those of its file, or of `--url` in their place."""

from collections.abc import Sequence

from model.errors import InputError
from model.rig.rig import Rig


def urls_of(rig: Rig, texts: Sequence[str]) -> dict[str, str]:
    """Return the URL of each amplifier by name; texts: NAME=URL, or a URL where there is one.

    Raises InputError for an amplifier that the rig does not have.
    """
    found = dict(rig.amplifiers)
    for text in texts:
        name, equals, url = text.partition("=")
        if len(found) == 1 and "://" in name:
            (name,), equals, url = found, "=", text
        if not equals or name not in found:
            raise InputError(
                f"--url must be NAME=URL with one of {', '.join(rig.amplifiers)}, got {text}"
            )
        found[name] = url
    return found
