"""The calibration board on paper: what to print, on which sheets, and what else stands where."""
