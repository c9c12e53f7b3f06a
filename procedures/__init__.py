"""What a technician does to a rig: one module per term, each a list of steps."""
