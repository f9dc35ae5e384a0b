"""An independent witness of the wires: it decodes every frame and reports broken rules.

It shares no code with `drivers` and the far ends: its decoders are written from
docs/reference/wire-protocol.md, docs/reference/wire-modbus.md and docs/reference/wire-can.md alone.
"""
