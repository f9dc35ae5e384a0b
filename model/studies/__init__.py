"""Design studies: placement, number and stiffness of ERAs, over many layouts."""
