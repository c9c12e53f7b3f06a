"""The modulation by the pixel rows and the shading it rides on: shape and fields in one fit."""
