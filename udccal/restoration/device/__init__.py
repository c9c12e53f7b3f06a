"""Restoration on a device of JAX, such as a GPU: one compiled function from raw to 8 bit."""
