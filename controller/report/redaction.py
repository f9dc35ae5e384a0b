"""Removes secrets and the home folder from a text."""

import re
from pathlib import Path

HIDDEN = "[hidden]"

# scheme://user:password@host, as pyserial's and others' URLs may have it.
_USER = re.compile(r"(?<=://)[^/\s@\"']+(?=@)")
# key: value in YAML or JSON, and ?key=value or #key=value in a URL.
_SECRET = re.compile(
    r"(?i)([\"']?\b[\w-]*(?:token|password|passwd|secret|credential|private[_-]?key)\b[\"']?"
    r"\s*[:=]\s*)(\"[^\"]*\"|'[^']*'|[^\s,}&#]+)"
)
_BEARER = re.compile(r"(?i)(bearer\s+)[\w.~+/=-]+")


def redacted(text: str, *, home: Path) -> str:
    """Return a text without passwords and tokens, and with ~ for the home folder."""
    text = _USER.sub(HIDDEN, text)
    text = _SECRET.sub(rf"\g<1>{HIDDEN}", text)
    text = _BEARER.sub(rf"\g<1>{HIDDEN}", text)
    # The home "/" of system users is part of every path.
    return text.replace(str(home), "~") if home != home.parent else text
