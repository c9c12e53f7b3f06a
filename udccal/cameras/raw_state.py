"""State of a camera that sends raw samples: linear in light, independent of each other, at their place on the sensor.

The names are SFNC's, or makers' where SFNC has none. A feature that a camera does not have, or has fixed, is skipped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final


@final
@dataclass(frozen=True)
class Choice:
    """An enumeration and the value to set."""

    name: str
    symbol: str = "Off"


@final
@dataclass(frozen=True)
class WholeNumber:
    """An integer and the value to set."""

    name: str
    value: int


# The sequencer first: while it runs, it sets the others itself.
CHOICES: Final = (
    Choice("SequencerMode"),
    Choice("ExposureAuto"),
    Choice("GainAuto"),
    Choice("BalanceWhiteAuto"),
    Choice("TestImageSelector"),
    Choice("TestPattern"),
    Choice("ImageCompressionMode"),
    Choice("BslColorSpace"),
    Choice("BslLightSourcePreset"),
    Choice("LightSourcePreset"),
    Choice("LightSourceSelector"),
    Choice("PgiMode"),
    Choice("BslDefectPixelCorrectionMode"),
    Choice("BslStaticDefectPixelCorrectionMode"),
    Choice("DefectPixelCorrectionMode"),
    Choice("ColorSpace", "RGB"),  # the other one is sRGB, which is not linear
    Choice("BslColorSpaceMode", "RGB"),
    Choice("ExposureMode", "Timed"),
    Choice("AcquisitionMode", "Continuous"),
    Choice("BinningHorizontalMode", "Sum"),
    Choice("BinningVerticalMode", "Sum"),
)
SWITCHED_OFF: Final = (
    *("GammaEnable", "LUTEnable", "ColorTransformationEnable"),
    *("ReverseX", "ReverseY", "CenterX", "CenterY"),
)
WHOLE_NUMBERS: Final = (
    WholeNumber("DigitalShift", 0),
    WholeNumber("BinningHorizontal", 1),
    WholeNumber("BinningVertical", 1),
    WholeNumber("DecimationHorizontal", 1),
    WholeNumber("DecimationVertical", 1),
)

# Numbers whose neutral value is 1.
GAMMA: Final = "Gamma"
BALANCE_RATIO: Final = ("BalanceRatio", "BalanceRatioAbs")  # the second before SFNC 1.5
BALANCE_SELECTOR: Final = "BalanceRatioSelector"
BALANCE_COLOURS: Final = ("Red", "Green", "Blue")

# The gain to set among several, best first; an additional digital gain is set to 0 dB.
GAIN_SELECTOR: Final = "GainSelector"
GAINS: Final = ("All", "AnalogAll")
DIGITAL_GAIN: Final = "DigitalAll"
