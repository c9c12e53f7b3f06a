"""Numbers to figures to HTML."""
