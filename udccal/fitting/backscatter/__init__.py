"""Backscatter, the panel's own light scattered into the lens, from pictures shown on it under blackout."""
