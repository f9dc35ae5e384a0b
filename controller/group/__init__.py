"""The amplifiers of a rig as one: armed, played, stopped and closed together."""
