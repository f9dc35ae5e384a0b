"""The files of a system service: its unit, its user, and the rights to its devices.

systemd.exec(5), systemd.service(5), sysusers.d(5) and udev(7) say what each line means.
"""

from dataclasses import dataclass
from pathlib import Path

from controller.deploy.needs import Needs, check_path
from model.errors import InputError

NAME = "era-haptics"
"""Of the service, its user and its group."""

NICE = -10
"""How urgent the service is; the lower, the more, from -20."""

_HEAD = (
    "# Written by `era systemd install`; systemctl edit changes it without touching this file.\n"
)


@dataclass(frozen=True)
class File:
    """A file of the system: where, and what is in it."""

    path: Path
    text: str


def service_files(config: Path, executable: Path, needs: Needs) -> tuple[File, ...]:
    """All files of the service; raises InputError for paths that a unit cannot name.

    config: the daemon's file; executable: the `era` command.
    """
    for path in (config, executable):
        if not check_path(path):
            raise InputError(
                f"{path}: a unit can only name absolute paths of plain letters, digits and "
                "_ . + @ -; move it to such a place"
            )
    return (
        File(Path(f"/etc/systemd/system/{NAME}.service"), _unit(config, executable, needs)),
        File(Path(f"/etc/sysusers.d/{NAME}.conf"), _user()),
        File(Path(f"/etc/udev/rules.d/70-{NAME}.rules"), _rules(needs)),
    )


def _unit(config: Path, executable: Path, needs: Needs) -> str:
    devices = [
        *(("char-ttyUSB rw", "char-ttyACM rw", "char-ttyS rw", "char-ttyAMA rw") * needs.serial),
        *(("char-input r",) * needs.input),
    ]
    families = " ".join(["AF_UNIX", "AF_INET", "AF_INET6", *(["AF_CAN"] * needs.can)])
    network = (
        "# IPAddressDeny= is left out: an amplifier is named by a name, or touches come from afar."
    )
    if needs.hosts is not None:
        allowed = " ".join(["localhost", *needs.hosts])
        network = f"IPAddressDeny=any\nIPAddressAllow={allowed}"
    allow = "\n".join(f"DeviceAllow={device}" for device in devices) or "DeviceAllow="
    return f"""{_HEAD}
[Unit]
Description=Localized vibration on a touch plate
Documentation=man:systemd.service(5)
After=network.target

[Service]
Type=notify
ExecStart={executable} daemon {config}
ExecReload=/bin/kill -HUP $MAINPID
Restart=on-failure
RestartSec=2
# The amplifiers' own watchdogs silence the plate 250 ms after the control loop hangs; this one
# starts it anew.
WatchdogSec=2
TimeoutStartSec=120
TimeoutStopSec=5

User={NAME}
Group={NAME}
UMask=0077
RuntimeDirectory={NAME}
RuntimeDirectoryMode=0750
CacheDirectory={NAME}
StateDirectory={NAME}
LogsDirectory={NAME}
Environment=XDG_RUNTIME_DIR=/run XDG_CACHE_HOME=/var/cache/{NAME}
Environment=OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 PYTHONNOUSERSITE=1

# Touches go before everything that is not urgent; nice alone counts within a session only.
Nice={NICE}
CPUWeight=1000
OOMScoreAdjust=-500
LimitNOFILE=4096
TasksMax=64

NoNewPrivileges=yes
CapabilityBoundingSet=
AmbientCapabilities=
ProtectSystem=strict
ProtectHome=yes
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectProc=invisible
ProcSubset=pid
PrivateTmp=yes
PrivateUsers=yes
PrivateIPC=yes
PrivateMounts=yes
RemoveIPC=yes
LockPersonality=yes
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@privileged @resources
SystemCallErrorNumber=EPERM
RestrictAddressFamilies={families}
{network}
DevicePolicy=closed
{allow}

[Install]
WantedBy=multi-user.target
"""


def _user() -> str:
    return f"""{_HEAD}
u {NAME} - "Localized vibration" /var/lib/{NAME}
"""


def _rules(needs: Needs) -> str:
    lines = [_HEAD]
    if needs.serial:
        lines += [
            "# Amplifiers on USB adapters; ATTRS{idVendor} and ATTRS{idProduct} name yours alone.",
            f'SUBSYSTEM=="tty", SUBSYSTEMS=="usb", GROUP="{NAME}", MODE="0660"',
            "# FTDI adapters hold bytes back for 16 ms unless they are told not to.",
            'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"',
        ]
    if needs.input:
        lines += [
            "# Touch panels.",
            f'SUBSYSTEM=="input", KERNEL=="event*", ENV{{ID_INPUT_TOUCHSCREEN}}=="1", '
            f'GROUP="{NAME}", MODE="0660"',
        ]
    if not (needs.serial or needs.input):
        lines.append("# No device needs other rights.")
    return "\n".join(lines) + "\n"
