# Written by docs/generators/client_stub.py.
# ruff: noqa: E501
"""What every method of the API does: in reference, OpenAPI, and the help of `era`.

Apart from the messages, whose import would double the time of help.
"""

SUMMARIES = {
    "hello": "Introduce the client; returns what the daemon drives.",
    "status": "Show daemon, amplifiers and contacts.",
    "arm": "Switch the high voltage on. Touches are felt until the lease expires.",
    "renew": "Extend the lease.",
    "disarm": "Ramp to silence, then switch the high voltage off. Any client may. While a link is lost it stops all amplifiers.",
    "stop": "Quick-stop all amplifiers, latched until clear. Not an emergency stop. Any client can stop, at any time; error 1006 unless every amplifier is confirmed silent.",
    "clear": "Clear a stop, or a fault that no longer exists. Stays disarmed.",
    "touch": "Report all fingers of a touch source of this client.",
    "layout": "Use one of the daemon's layouts. Of resting fingers, what ends by itself and what a program plays goes on to its end; what lasts follows the new layout at once.",
    "reload": "Read the daemon's files again and apply their layouts. Any other change is refused, and needs a restart.",
    "effects": "List the effects.",
    "play": "Play an effect, or points, at a finger; only while armed.",
    "strength": "Set or show the strength of a source, client or region. The name is that of a touch source, a client or a region; the status shows all strengths. Active effects are faded to it within 100 ms.",
    "subscribe": "Receive notifications of topics.",
    "unsubscribe": "Receive no more notifications of topics.",
}
