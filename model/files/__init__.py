"""Files of numbers, written whole or not at all and checked while they are read."""
