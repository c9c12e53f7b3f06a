"""Benches: camera, display and stage of a rig, real or simulated; running the procedures on them."""
