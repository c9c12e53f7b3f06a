"""Finds how a rig has changed since its profile was made, from a capture of a few minutes."""
