"""The modulation by the pixel rows: shape and fields in one fit. ``sigma`` says how sure the map is, pixel by pixel."""

from udccal.fitting.wire.fit import fit_wire, fit_wire_and_sigma

__all__ = ["fit_wire", "fit_wire_and_sigma"]
