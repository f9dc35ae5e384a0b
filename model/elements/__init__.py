"""Plate elements, a file each: an element matrix for stiffness and one for mass."""
