"""Live restoration: a camera's frames, restored as they come, to a sink."""
