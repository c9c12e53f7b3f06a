"""Backscatter: the light that the lit panel sends into the lens under blackout, for white and face-like pictures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, final

import numpy as np
from jaxtyping import UInt8

from procedures.base import Procedure
from procedures.checks import is_dark, sees_anything
from procedures.plans import Exposure, Metered, Stack, TimesThatOf
from procedures.step import PictureRole, Step, whole_sensor
from udccal.arrangements import Dark, PanelPicture
from udccal.displays.pictures import face_picture
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName

_WHITE = "backscatter/white"
_LEVEL = 0.7  # of saturation, with the white picture
_GAMMA, _GAIN, _LIFT = 2.2, 2.0, 0.3
_BLACKOUT = (
    "Keep all light out. The only light is our display, which shows each picture by itself and for the step "
    "backscatter/dark is off."
)
_TITLE = "Blackout for the panel's own light"
_WHY = "Pictures on the panel show how much of its light comes back into the lens, and where."

Picture = UInt8[np.ndarray, "panel_rows panel_columns 3"]


@final
class BackscatterProcedure(Procedure):
    """The white picture determines the mask; the others, at the same exposure, determine how the light spreads."""

    term: ClassVar[TermName] = "backscatter"

    def steps(self, rig: RigDescription) -> Iterator[Step]:
        """Yield white, dark, then pictures; a third of them are brightened versions of others."""
        panel, count = rig.panel, rig.captures.backscatter_pictures
        white = np.full((panel.rows, panel.columns, 3), 255, np.uint8)
        yield _shown(rig, _WHITE, white, "white", Metered(_LEVEL))
        yield Step(
            id="backscatter/dark",
            term="backscatter",
            arrangement=Dark(),
            instruction=_BLACKOUT,
            check=is_dark,
            region=whole_sensor(rig),
            exposure=TimesThatOf(_WHITE),
            plan=Stack(rig.captures.backscatter_frames),
            title=_TITLE,
            why=_WHY,
        )
        brightened_count = count // 3
        for index in range(count - brightened_count):
            picture = face_picture(index, panel.columns, panel.rows)
            yield _shown(rig, f"backscatter/picture_{index}", picture, "picture", TimesThatOf(_WHITE))
            if index < brightened_count:
                yield _shown(
                    rig, f"backscatter/brightened_{index}", brightened(picture), "brightened", TimesThatOf(_WHITE)
                )


def brightened(picture: Picture) -> Picture:
    """Brighten: I' = (a I^gamma + b)^(1/gamma) on 0..1, clipped at white, with gamma = 2.2, a = 2, b = 0.3."""
    values = (_GAIN * (np.arange(256) / 255.0) ** _GAMMA + _LIFT) ** (1 / _GAMMA)
    return np.rint(255 * np.minimum(values, 1.0)).astype(np.uint8)[picture]


def _shown(rig: RigDescription, step_id: str, picture: Picture, role: PictureRole, exposure: Exposure) -> Step:
    return Step(
        id=step_id,
        term="backscatter",
        arrangement=PanelPicture(picture),
        instruction=_BLACKOUT,
        check=sees_anything,
        region=whole_sensor(rig),
        exposure=exposure,
        plan=Stack(rig.captures.backscatter_frames),
        role=role,
        title=_TITLE,
        why=_WHY,
    )
