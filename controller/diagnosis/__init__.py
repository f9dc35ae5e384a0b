"""Driving the channels of a rig one by one while sensors measure the plate."""
