"""Picture files as frames: raw files, 16-bit TIFF and PNG, EXR; their fields and their order."""
