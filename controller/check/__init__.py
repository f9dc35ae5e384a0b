"""What a surface layout would do on the plate, before anybody touches it."""
