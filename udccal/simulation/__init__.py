"""A simulated rig with known ground truth: panel geometry, wave optics, scatter, sensor and scene.

Nothing here calls ``udccal.models``: a fit that is tested against its own formula only recovers its own assumptions.
"""
