"""The state in which a camera sends raw samples: linear in light, each by itself, at its place on the sensor.

The names are SFNC's, and where it has none those of makers. A camera that does not have a feature, or has it fixed, is
left as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final


@final
@dataclass(frozen=True)
class Choice:
    """An enumeration and what it is set to."""

    name: str
    symbol: str = "Off"


@final
@dataclass(frozen=True)
class WholeNumber:
    """An integer and what it is set to."""

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

# Numbers that are 1 where they change nothing.
GAMMA: Final = "Gamma"
BALANCE_RATIO: Final = ("BalanceRatio", "BalanceRatioAbs")  # the second before SFNC 1.5
BALANCE_SELECTOR: Final = "BalanceRatioSelector"
BALANCE_COLOURS: Final = ("Red", "Green", "Blue")

# Which of several gains is the one that is set, best first; a digital one beside it is 0 dB.
GAIN_SELECTOR: Final = "GainSelector"
GAINS: Final = ("All", "AnalogAll")
DIGITAL_GAIN: Final = "DigitalAll"
