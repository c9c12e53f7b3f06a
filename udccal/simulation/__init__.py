"""A rig that is not there: panel geometry, wave optics, scatter, sensor, scene. The ground truth.

Nothing here calls ``udccal.models``: a fit that is tested against its own formula only recovers its own assumptions.
"""
