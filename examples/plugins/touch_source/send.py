"""Send a finger over UDP that touches the plate, slides to the right for a second and lifts.

python send.py PORT
"""

import json
import socket
import sys
import time

if len(sys.argv) != 2:
    sys.exit(__doc__)
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
    address = ("127.0.0.1", int(sys.argv[1]))
    for step in range(21):
        finger = [1, 0.25 + 0.025 * step, 0.5]
        sender.sendto(json.dumps([finger]).encode(), address)
        time.sleep(0.05)
    sender.sendto(b"not a touch", address)  # malformed, to be counted
    sender.sendto(b"[]", address)
