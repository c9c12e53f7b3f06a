"""Procedures: what a technician captures of a rig. One module per term, each a list of steps."""
