"""Options for the ports of far ends."""

from typing import Any

import typer


def port_option(served: str) -> Any:
    """The option for a loopback port; served: what is served there."""
    return typer.Option(
        metavar="PORT", help=f"Serve {served} on this loopback port; 0: any.", min=0, max=65535
    )
