"""Send a finger over UDP that comes down, slides to the right for a second and lifts.

python send.py PORT
"""

import json
import socket
import sys
import time

if len(sys.argv) != 2:
    sys.exit(__doc__)
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
    place = ("127.0.0.1", int(sys.argv[1]))
    for step in range(21):
        line.sendto(json.dumps([[1, 0.25 + 0.025 * step, 0.5]]).encode(), place)
        time.sleep(0.05)
    line.sendto(b"this is no touch", place)
    line.sendto(b"[]", place)
