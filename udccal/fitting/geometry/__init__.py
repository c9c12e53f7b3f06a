"""Lens, panel pose and board poses: ``fit_geometry`` fits arrays of corners, ``fit_boards`` a session's boards."""
