"""A rig, from the file that describes it to the values that the model computes with."""
