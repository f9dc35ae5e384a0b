"""What answers give at the skin on plates that deviate, beside an independent optimum."""
