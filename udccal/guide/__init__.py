"""Leads a person through a capture: events that a terminal or a page shows, and the answers that come back."""
