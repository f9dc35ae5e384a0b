# Written by docs/generators/client_stub.py.
# ruff: noqa: E501
"""Summaries of all API methods, for the reference, OpenAPI and the help of `era`.

Apart from the messages, whose import would double the time of help.
"""

SUMMARIES = {
    "hello": "Introduce the client; returns the daemon's rig, table and layout.",
    "status": "Show the state of the daemon, the amplifiers and the contacts.",
    "arm": "Switch the high voltage on. Touches are felt until the lease expires.",
    "renew": "Extend the lease.",
    "disarm": "Ramp to silence, then switch the high voltage off. Any client can disarm. While a link is lost, this stops all amplifiers.",
    "stop": "Quick-stop all amplifiers. The stop is latched until `clear`. Not an emergency stop. Every client can stop the plate at any time. Fails with error 1006 if an amplifier is not confirmed silent.",
    "clear": "Clear a stop, or a fault that no longer exists. The plate stays disarmed.",
    "touch": "Report all fingers of a touch source.",
    "layout": "Switch to another of the daemon's layouts. Continuous effects under resting fingers change immediately. Effects of limited duration, and effects that a program plays, continue to their end.",
    "reload": "Read the daemon's files again and apply their layouts. All other changes are rejected; they need a restart.",
    "effects": "List the available effects.",
    "play": "Play an effect, or points and taps, at a finger; only while armed. Returns the outcome: when it starts and at which level, or why it is not played.",
    "strength": "Set or show the strength of a source, client or region. The status shows all strengths. Active effects fade to the new strength within 100 ms.",
    "subscribe": "Subscribe to notifications of topics.",
    "unsubscribe": "Unsubscribe from notifications of topics.",
}
