"""Exchange of profiles with other programs: one file for each format."""
