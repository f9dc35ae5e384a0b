"""Opening files that a user names: only regular ones, and without waiting."""

import errno
import os
import stat


def regular_file(name: str, flags: int) -> int:
    """Open a file as `opener` of `open`; raises OSError for a pipe, a socket or a device.

    A pipe would be waited for until something writes into it, and a device may never end.
    """
    flags |= getattr(os, "O_NONBLOCK", 0)  # not on Windows
    descriptor = os.open(name, flags, 0o666)
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode):  # `open` refuses a folder
        return descriptor
    os.close(descriptor)
    raise OSError(errno.EINVAL, "must be a regular file, got a pipe or a device", name)
