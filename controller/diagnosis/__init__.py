"""Driving a rig's channels in turn and listening to what the plate does."""
