"""The limit of open files of this process."""

import contextlib
import resource

MIN_DESCRIPTORS = 64
_MAX_DESCRIPTORS = 65_536


def allow_many_descriptors() -> int:
    """Raise the limit, so that idle connections do not use it up; return it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = _MAX_DESCRIPTORS if hard == resource.RLIM_INFINITY else hard
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
        return limit
    return soft
