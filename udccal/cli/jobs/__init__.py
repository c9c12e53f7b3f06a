"""What the verbs do once their words are understood; these modules import what is slow to load, the verbs do not."""
