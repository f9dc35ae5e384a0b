"""Surface layouts, their regions, and the effects that play in them."""
