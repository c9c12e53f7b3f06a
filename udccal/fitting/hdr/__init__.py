"""Brackets of exposures merged into one rate per sample."""
