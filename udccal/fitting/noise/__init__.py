"""Noise after EMVA 1288: what dark frames and flats show of the sensor. ``fit.py`` has the entry."""
