"""Validates a profile: predicts captures that its fits have not used, and judges what is left."""
