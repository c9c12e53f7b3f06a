"""udccal: calibrate a camera that looks through a transparent display, and restore what it sees."""

__version__ = "0.1.0"
