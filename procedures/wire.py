"""Wire: many flats of an evenly lit LED panel, averaged as they arrive, and dark frames at the same exposure."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, final

from procedures.base import Procedure
from procedures.checks import is_dark, is_even
from procedures.plans import Metered, Stack, TimesThatOf
from procedures.step import Step, whole_sensor
from udccal.arrangements import Dark, FlatLight
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName

_LEVEL = 0.65  # of saturation, in the brightest channel
_DARKS = 16


@final
class WireProcedure(Procedure):
    """The modulation by the panel's rows is a few per cent, so averaging reduces shot noise below a thousandth."""

    term: ClassVar[TermName] = "wire"

    def steps(self, rig: RigDescription) -> Iterator[Step]:
        """Yield the flat, then the dark at its exposure."""
        yield Step(
            id="wire/flat",
            term="wire",
            arrangement=FlatLight(),
            instruction="Put the white LED panel close in front of the display so that it fills the view evenly. "
            "Keep our display off and do not touch the rig until the step is done.",
            check=is_even,
            region=whole_sensor(rig),
            exposure=Metered(_LEVEL),
            plan=Stack(rig.captures.flats),
            title="Even light for the wire",
            why="The panel's rows modulate an even light; many frames show that above the noise.",
        )
        yield Step(
            id="wire/dark",
            term="wire",
            arrangement=Dark(),
            instruction="Cap the lens, switch the display off, and keep all light out.",
            check=is_dark,
            region=whole_sensor(rig),
            exposure=TimesThatOf("wire/flat"),
            plan=Stack(_DARKS),
            title="Darkness for the wire",
            why="What the camera gives without light is subtracted from the even light.",
        )
