"""What the panel shows."""
