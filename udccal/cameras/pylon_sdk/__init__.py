"""Small typed wrappers of Basler's pylon SDK (pypylon), which ``udccal.cameras.pylon`` combines."""
