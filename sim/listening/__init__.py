"""The witness of protocol 3: it decodes every frame on the wires and reports broken rules.

Messages are read by the one table and codec (`drivers.protocol`, `drivers.codec`), what plays comes
from `drivers.playback`; the rules are its own, and nothing of the host or of the far ends is here.
What does not depend on the version of the protocol is still in `sim.witness`.
"""
