# %% [markdown]
"""
# A panel from Python: simulated amplifier, daemon, touches

For engineers of touch panels. Run `python examples/hmi_engineer.py`, or open this file as a
notebook in VS Code (or in Jupyter with jupytext). It starts the processes of a panel:

    era sim                        serial line       era daemon       socket       this program
    simulated amplifier, plate   <------------->     control      <----------->    touches

With real hardware, omit `era sim`, put the amplifier's URL into the rig, and add `touch:` to the
daemon's configuration.
"""

# %%
import atexit
import json
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

import era_haptics as era

ERA = Path(sys.executable).with_name("era")
target = (0.08, 0.06)
quiet = (0.22, 0.16)
panel = ExitStack()  # on closing, ends the daemon first, then the amplifier
atexit.register(panel.close)  # also if a cell fails
folder = Path(panel.enter_context(tempfile.TemporaryDirectory(prefix="era-")))


def start(*arguments):
    """Start an `era` command that ends with the panel."""
    command = [ERA, *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def end():
        process.terminate()
        process.communicate(timeout=10)

    panel.callback(end)
    return process


# %% [markdown]
"""
## The simulated amplifier
It prints its URL. Its control socket places fingers on the simulated plate and returns the
vibration under them. Requests and replies are JSON objects, one per line.
"""

# %%
simulation = start(
    *("sim", era.example_rig_path(), "--exact", "--serial"),  # exact: the nominal plate
    *("--control", folder / "control"),
)
url = simulation.stdout.readline().strip().removeprefix("main: ")
control_socket = panel.enter_context(socket.socket(socket.AF_UNIX))
control_socket.connect(str(folder / "control"))
lines = panel.enter_context(control_socket.makefile("rw", encoding="utf-8"))


def query_plate(**request):
    """Send a request to the simulated plate and return its reply."""
    print(json.dumps(request), file=lines, flush=True)
    return json.loads(lines.readline())


query_plate(op="fingers", fingers={"target": target, "quiet": quiet})

# %% [markdown]
"""
## One amplifier by hand
Read the amplifier's identity and let one ERA buzz for a tenth of a second. Commands are checked
against the rig's limits, and the amplifier is disarmed at the end of the block.
"""

# %%
rig = era.load_rig(era.example_rig_path())
commands = era.commands_for(rig, {"SW": era.Drive(110, level=0.1)})
with era.open_amplifier(rig, url=url) as amplifier:
    print(amplifier.identity["product"], "with", amplifier.capabilities["channels"], "channels")
    amplifier.arm()
    amplifier.play(commands["main"], duration=0.1)

# %% [markdown]
"""
## The daemon
Its configuration names the rig. The daemon builds the rig's table at its first start, caches it,
and starts disarmed.
"""

# %%
rig_text = era.example_rig_path().read_text("utf-8")
(folder / "rig.yaml").write_text(rig_text.replace('"sim://"', json.dumps(url)), "utf-8")
(folder / "daemon.yaml").write_text(
    "rig: rig.yaml\nmode: phased\nsocket: era.sock\nlog: {level: warning}\n", "utf-8"
)
daemon = start("daemon", folder / "daemon.yaml")


def connect():
    """Connect to the daemon as soon as it is ready."""
    while daemon.poll() is None:
        if (folder / "era.sock").is_socket():
            client = era.Client.connect(folder / "era.sock", name="example")
            if client.status().state == "READY_TO_SWITCH_ON":
                return client
            client.close()
        time.sleep(0.1)
    sys.exit("the daemon has ended")


# %% [markdown]
"""
## Touches
One finger rests on the plate, then a second one lands. The newest finger feels the vibration, the
other one is kept quiet. A finger expires 150 ms after its last frame, so frames are repeated.
"""


# %%
def hold(client, positions, seconds):
    """Hold fingers at some positions for a time."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        client.touch(positions)
        time.sleep(0.05)


client = panel.enter_context(connect())
with client.armed("example"):
    hold(client, [quiet], 0.2)
    hold(client, [quiet, target], 1.0)
    status = client.status()
    now = time.monotonic()  # all processes of a machine share this clock
    felt = query_plate(op="felt", since_s=now - 0.3, until_s=now - 0.05)["fingers"]
    client.touch([])
if not status.drive:
    sys.exit(f"nothing was played: {status.silence_reason or status.cause}")

# %% [markdown]
"""
## Felt and predicted contrast
Amplitudes of different frequencies add. As in the prediction, the target counts with its weighted
mean over the fingertip, and the quiet finger with its maximum.
"""

# %%
peaks = {}
for name, vibration in felt.items():
    peaks[name] = np.sum(vibration["amplitude_m_s2"], axis=0)
at_target = peaks["target"] @ felt["target"]["weights"]
at_quiet = peaks["quiet"].max()
felt_contrast_db = 20 * np.log10(at_target / at_quiet)
print("played:", {name: f"{tone.frequency_hz:g} Hz" for name, tone in status.drive.items()})
print(f"contrast {felt_contrast_db:.1f} dB felt, {status.predicted_contrast_db:.1f} dB predicted")

# %%
panel.close()
print("daemon ended with status", daemon.returncode)
