"""The witness: it decodes every frame on the wires and reports broken rules.

Messages are read by the one table and the frames of each wire (`drivers.protocol`,
`drivers.wires`), what plays comes from `drivers.playing`; the rules are its own, and
nothing of the host or of the far ends is here.
"""
