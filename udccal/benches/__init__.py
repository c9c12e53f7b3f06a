"""Benches: camera, display and stage of a rig, real or simulated, and running the procedures on them."""
