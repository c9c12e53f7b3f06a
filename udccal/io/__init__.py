"""Files on disk: EXR, PNG, checksums and atomic writes."""
