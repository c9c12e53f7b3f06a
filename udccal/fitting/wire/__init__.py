"""The modulation by the pixel rows and the shading it rides on: shape and fields in one fit."""

from udccal.fitting.wire.data import WireData, read_wire
from udccal.fitting.wire.fit import fit_wire, sensor_map
from udccal.fitting.wire.rules import WireRules, WireStart, wire_start

__all__ = ["WireData", "WireRules", "WireStart", "fit_wire", "read_wire", "sensor_map", "wire_start"]
