"""Files on disk: EXR, PNG, checksums, and writes that are whole or absent."""
