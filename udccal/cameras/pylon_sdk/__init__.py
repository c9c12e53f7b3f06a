"""Basler's pylon SDK, through pypylon, behind small typed pieces; ``udccal.cameras.pylon`` puts them together."""
