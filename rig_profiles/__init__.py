"""Rigs that ship with udccal: one folder per rig, each with its ``rig.toml`` and the profile made from it."""
