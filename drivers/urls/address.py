"""The address of an amplifier within its URL."""

import re

from drivers.errors import CommandError


def with_address(url: str, address: int) -> str:
    """Return the URL with another address, unit or node; CommandError for a wire without any."""
    scheme = url.partition("://")[0]
    if scheme == "serial":
        kept = re.sub(r"(?<=[?&])address=\d+&?", "", url).rstrip("?&")
        return f"{kept}{'&' if '?' in kept else '?'}address={address}"
    if scheme == "modbus+tcp":
        place, _, options = url.partition("?")
        host = "/".join(place.split("/")[:3])
        return f"{host}/{address}" + (f"?{options}" if options else "")
    if scheme == "modbus+rtu" or scheme.startswith("can"):
        return f"{url.partition('#')[0]}#{address}"
    raise CommandError(f"amplifiers at {url} have no address that can be set")
