"""Print the requested vibration of a content file.

python try_format.py FILE
"""

import sys
from pathlib import Path

from era_haptics.plugins.content_formats import InputError, read_content

if len(sys.argv) != 2:
    sys.exit(__doc__)
try:
    pattern = read_content(Path(sys.argv[1]))
except InputError as error:
    sys.exit(f"error: {error}")
print(f"duration: {pattern.duration:g} s")
for name, curve in (("intensity", pattern.intensity), ("sharpness", pattern.sharpness)):
    print(f"{name}:", ", ".join(f"{value:g} at {time:g} s" for time, value in curve))
print(f"transients: {len(pattern.transients)}")
for remark in pattern.remarks:
    print(f"note: {remark}")
