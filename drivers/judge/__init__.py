"""What an amplifier must show and play after what it was sent: a judge that only listens.

The witness feeds it with what passes on a wire, conformance with the exchanges of its own client.
"""
