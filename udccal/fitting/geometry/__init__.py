"""Lens, panel and board poses: ``fit_geometry`` takes arrays of corners, ``fit_boards`` the boards of a session."""
