"""Checks of this computer before a calibration: one small check per file, each harmless to repeat."""
