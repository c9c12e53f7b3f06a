"""Compares two profiles of one rig: chi-squared by both covariances, effects in what is seen, and the movement."""
