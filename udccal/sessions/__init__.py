"""Captured data on disk: manifest, frames, running averages, checksums, resume."""
