"""The modulation by the pixel rows and the shading it rides on: shape and fields in one fit."""

from udccal.fitting.wire.data import WireData, WireRules, read_wire
from udccal.fitting.wire.fit import fit_wire, sensor_map

__all__ = ["WireData", "WireRules", "fit_wire", "read_wire", "sensor_map"]
