"""Picture files as frames: raw files, 16-bit TIFF and PNG, EXR; what they say about themselves, and their order."""
