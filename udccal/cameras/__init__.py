"""Where frames come from: one small protocol, and the backends behind it."""
