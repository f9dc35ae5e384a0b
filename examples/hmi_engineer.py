# %% [markdown]
"""
# A panel from Python: simulated amplifier, daemon, touches

For engineers of touch panels. Run `python examples/hmi_engineer.py`, or open it as a notebook in VS
Code or, with jupytext, in Jupyter. It starts the processes of a panel:

    simulated amplifier, plate (era sim)  <- serial ->  daemon (era daemon)  <- socket ->  here

With real hardware, leave out the first, put the amplifier's URL into the rig, and add `touch:` to
the daemon's file.
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

target, quiet = (0.08, 0.06), (0.22, 0.16)
ERA = Path(sys.executable).with_name("era")
panel = ExitStack()  # closed at the end: daemon, then amplifier
atexit.register(panel.close)  # also where a cell fails
folder = Path(panel.enter_context(tempfile.TemporaryDirectory(prefix="era-")))


def start(*arguments):
    """Start an `era` command that ends with the panel."""
    process = subprocess.Popen([ERA, *map(str, arguments)], stdout=subprocess.PIPE, text=True)

    def end():
        process.terminate()
        process.communicate(timeout=10)

    panel.callback(end)
    return process


# %% [markdown]
"""
## The simulated amplifier
It prints its URL and serves a control socket, which places fingers on the plate and returns what
they felt: one JSON object per line each way.
"""

# %%
far_end = start(
    *("sim", era.example_rig_path(), "--exact", "--serial"),  # the table's nominal plate
    *("--control", folder / "control"),
)
url = far_end.stdout.readline().strip().removeprefix("main: ")
control_socket = panel.enter_context(socket.socket(socket.AF_UNIX))
control_socket.connect(str(folder / "control"))
lines = panel.enter_context(control_socket.makefile("rw", encoding="utf-8"))


def query_plate(**question):
    """Send a request to the simulated plate and return its reply."""
    print(json.dumps(question), file=lines, flush=True)
    return json.loads(lines.readline())


query_plate(op="fingers", fingers={"target": target, "quiet": quiet})

# %% [markdown]
"""
## One amplifier by hand
Before a daemon uses it: its identity, and a buzz of a tenth of a second on one ERA. Commands stay
within the rig's limits, and the amplifier is disarmed when the block ends.
"""

# %%
rig = era.load_rig(era.example_rig_path())
with era.open_amplifier(rig, url=url) as amplifier:
    print(amplifier.identity["product"], "with", amplifier.capabilities["channels"], "channels")
    amplifier.arm()
    amplifier.play(era.commands_for(rig, {"SW": era.Drive(110, level=0.1)})["main"], duration=0.1)

# %% [markdown]
"""
## The daemon
Its file names the rig; its table is built once and cached. It starts disarmed.
"""

# %%
text = era.example_rig_path().read_text("utf-8").replace('"sim://"', json.dumps(url))
(folder / "rig.yaml").write_text(text, "utf-8")
(folder / "daemon.yaml").write_text(
    "rig: rig.yaml\nmode: phased\nsocket: era.sock\nlog: {level: warning}\n", "utf-8"
)
daemon = start("daemon", folder / "daemon.yaml")


def connect():
    """Connect as soon as the daemon is ready; its first start builds the table."""
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
A finger rests, then another comes down: the newest one feels the vibration, the other one does not.
Fingers expire after 150 ms without a frame, so frames are repeated.
"""


# %%
def hold(client, places, seconds):
    """Hold fingers at places for some seconds."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        client.touch(places)
        time.sleep(0.05)


client = panel.enter_context(connect())
with client.armed("example"):
    hold(client, [quiet], 0.2)
    hold(client, [quiet, target], 1.0)
    status = client.status()
    now = time.monotonic()  # one clock for all processes of a machine
    felt = query_plate(op="felt", since_s=now - 0.3, until_s=now - 0.05)["fingers"]
    client.touch([])
if not status.drive:
    sys.exit(f"nothing was played: {status.silence_reason or status.cause}")

# %% Amplitudes of different frequencies add. As in the predictions, a target counts by its mean and
# a quiet finger by its loudest point.
peak = {name: np.sum(each["amplitude_m_s2"], axis=0) for name, each in felt.items()}
at_target = peak["target"] @ felt["target"]["weights"]
felt_contrast_db = 20 * np.log10(at_target / peak["quiet"].max())
print("played:", {name: f"{tone.frequency_hz:g} Hz" for name, tone in status.drive.items()})
print(f"contrast {felt_contrast_db:.1f} dB felt, {status.predicted_contrast_db:.1f} dB predicted")

# %%
panel.close()
print("daemon ended with status", daemon.returncode)
