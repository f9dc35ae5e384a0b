"""One page about a rig, to send or to print: predictions of its plate, promises and tolerances."""
