"""Switching off what a camera does to its samples, so that they are linear in light, each by itself.

Features that a camera does not have, or has fixed, are passed over.
"""

from __future__ import annotations

from typing import Final

from udccal.cameras.pylon_sdk.nodes import Nodes

_OFF: Final = (
    *("ExposureAuto", "GainAuto", "BalanceWhiteAuto", "TestImageSelector", "TestPattern", "ImageCompressionMode"),
    *("BslColorSpace", "BslLightSourcePreset", "LightSourcePreset", "LightSourceSelector", "PgiMode", "SequencerMode"),
    *("BslDefectPixelCorrectionMode", "BslStaticDefectPixelCorrectionMode", "DefectPixelCorrectionMode"),
)
_CHOSEN: Final = (
    ("ExposureMode", "Timed"),
    ("AcquisitionMode", "Continuous"),
    ("GainSelector", "All"),
    ("BinningHorizontalMode", "Sum"),
    ("BinningVerticalMode", "Sum"),
)
_FALSE: Final = ("GammaEnable", "LUTEnable", "ColorTransformationEnable", "ReverseX", "ReverseY", "CenterX", "CenterY")
_WHOLE: Final = (
    ("DigitalShift", 0),
    ("BinningHorizontal", 1),
    ("BinningVertical", 1),
    ("DecimationHorizontal", 1),
    ("DecimationVertical", 1),
)


def send_raw_samples(nodes: Nodes) -> None:
    """Switch it all off."""
    for name in _OFF:
        nodes.choose(name, "Off")
    for name, value in _CHOSEN:
        nodes.choose(name, value)
    for name in _FALSE:
        nodes.set_flag(False, name)
    for name, number in _WHOLE:
        nodes.set_whole(number, name)
    nodes.set_number(1.0, "Gamma")
    for colour in ("Red", "Green", "Blue"):
        if nodes.choose("BalanceRatioSelector", colour):
            nodes.set_number(1.0, "BalanceRatio", "BalanceRatioAbs")


def send_chunks(nodes: Nodes) -> None:
    """Have each frame carry its own exposure, gain and timestamp, where the camera can."""
    if not (nodes.has("ChunkSelector") and nodes.set_flag(True, "ChunkModeActive")):
        return
    for chunk in ("ExposureTime", "Gain", "Timestamp"):
        if nodes.choose("ChunkSelector", chunk):
            nodes.set_flag(True, "ChunkEnable")
