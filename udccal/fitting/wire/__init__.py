"""The modulation by the pixel rows and the shading under it: shape and fields in one fit."""
