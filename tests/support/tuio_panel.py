"""A touch panel of a test."""

import socket


def free_port() -> int:
    """Find a free UDP port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def panel(port: int) -> str:
    """The lines of a daemon's file for a TUIO panel."""
    return f'touch: [{{name: panel, url: "tuio:127.0.0.1:{port}?timeout=0.15"}}]\n'
