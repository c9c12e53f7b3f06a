"""The work of the verbs. These modules import what is slow to load; the verbs' own modules do not."""
