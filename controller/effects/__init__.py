"""What a touch means: surface layouts, their regions, and the effects that play in them."""
