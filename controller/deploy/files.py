"""The files of the system service: the templates beside this module, filled in for one daemon."""

import re
from collections.abc import Mapping
from pathlib import Path
from string import Template

from controller.deploy.permissions import Permissions
from model.errors import InputError

SERVICE_NAME = "era-haptics"
"""Name of the service, its user and its group."""

NICE = -10
"""Scheduling priority of the service, from -20 (first) to 19."""

_SERIAL_PORTS = ("char-ttyUSB rw", "char-ttyACM rw", "char-ttyS rw", "char-ttyAMA rw")
_ANY_ADDRESS = (
    "# No IPAddressDeny=: an amplifier has a host name, or touches may come from other hosts."
)


def service_files(config: Path, era: Path, permissions: Permissions) -> Mapping[Path, str]:
    """Render the unit, its user and its udev rules, by the path at which each is installed.

    config: the daemon's file; era: the `era` command. Raises InputError unless both are absolute
    paths without characters that systemd interprets.
    """
    for path in (config, era):
        if not path.is_absolute() or not re.fullmatch(r"[\w/.+@-]+", str(path), re.ASCII):
            raise InputError(
                f"path in a unit must be absolute and consist of letters, digits and _ . + @ -, "
                f"got {path}; move the file"
            )
    devices = (
        *(_SERIAL_PORTS if permissions.serial else ()),
        *(("char-input r",) if permissions.input else ()),
    )
    addresses = _ANY_ADDRESS
    if permissions.hosts is not None:
        allowed = " ".join(("localhost", *permissions.hosts))
        addresses = f"IPAddressDeny=any\nIPAddressAllow={allowed}"
    unit = Template(_read(f"{SERVICE_NAME}.service")).substitute(
        nice=NICE,
        era=era,
        config=config,
        can_family=" AF_CAN" if permissions.can else "",
        address_filter=addresses,
        device_allow="\n".join(f"DeviceAllow={device}" for device in devices) or "DeviceAllow=",
    )
    rules = [
        "# Written by `era systemd install`; see udev(7).\n",
        *([_read("udev-serial.rules")] if permissions.serial else ()),
        *([_read("udev-input.rules")] if permissions.input else ()),
    ]
    return {
        Path(f"/etc/systemd/system/{SERVICE_NAME}.service"): unit,
        Path(f"/etc/sysusers.d/{SERVICE_NAME}.conf"): _read("sysusers.conf"),
        Path(f"/etc/udev/rules.d/70-{SERVICE_NAME}.rules"): "\n".join(rules),
    }


def _read(name: str) -> str:
    return Path(__file__).with_name(name).read_text("utf-8")
