"""Where restored frames go: one small protocol, and the sinks behind it."""
