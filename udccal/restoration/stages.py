"""Stages of restoration that a scene may do without, and how a frame tells.

A stage runs where leaving it out would change a sample by a tenth of its noise or more. Below that it would add less
than 1 % to the variance of the error, 0.04 dB.
"""

from __future__ import annotations

import enum
from collections.abc import Collection
from dataclasses import dataclass
from typing import ClassVar, Final, final

import cv2
import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from pydantic import ConfigDict

from udccal.errors import RestorationError
from udccal.models.backscatter import panel_light
from udccal.models.noise import Noise
from udccal.profiles.profile import Profile
from udccal.restoration.linear import to_electrons, variance_e2

_LEAST_SIGMAS: Final = 0.1
# Side in samples of the blocks whose mean is the light of a place.
_BLOCK: Final = 16


class Stage(enum.StrEnum):
    """A stage that some scenes need and others do not."""

    wire = "wire"
    backscatter = "backscatter"


def check_stages(stages: object) -> None:
    """Refuse what is no set of stages.

    Raises:
        RestorationError: when something else is among them; the message names the stages that there are.
    """
    if isinstance(stages, str) or not isinstance(stages, Collection) or not all(one in list(Stage) for one in stages):
        raise RestorationError(
            f"Expected a set of stages, of {' and '.join(Stage)}, found {stages!r:.80}. Name those to leave out."
        )


@final
@dataclass(frozen=True)
class StageChoice:
    """Whether a stage runs, and a clause that says why."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    stage: Stage
    runs: bool
    why: str


def chosen_stages(
    profile: Profile,
    mosaic: UInt16[np.ndarray, "rows columns"],
    exposure_s: float,
    panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None,
) -> tuple[StageChoice, ...]:
    """Decide which stages a frame needs.

    Args:
        profile: the rig as measured.
        mosaic: raw frame in DN, which ``check_frame`` accepts.
        exposure_s: exposure time of the frame.
        panel_picture: what the panel showed; None when not known.
    """
    noise = profile.noise.term
    signal = to_electrons(mosaic, noise, exposure_s)
    size = tuple(max(side // _BLOCK, 1) for side in signal.shape[::-1])
    light = cv2.resize(signal, size, interpolation=cv2.INTER_AREA)
    return _wire(profile, light, exposure_s), _backscatter(profile, noise, exposure_s, panel_picture)


def needed_by_any(choices: list[tuple[StageChoice, ...]]) -> tuple[StageChoice, ...]:
    """Return the choices for several frames together: a stage runs when one of them needs it."""
    return tuple(max(same, key=lambda choice: choice.runs) for same in zip(*choices, strict=True))


def _wire(profile: Profile, light_e: Float32[np.ndarray, "down across"], exposure_s: float) -> StageChoice:
    swing = max(float(profile.wire_map.max()) - 1.0, 1.0 - float(profile.wire_map.min()))
    if swing == 0.0:
        return StageChoice(Stage.wire, False, "the profile has no wire")
    change = swing * np.maximum(light_e, 0.0) / np.sqrt(variance_e2(light_e, profile.noise.term, exposure_s))
    most = float(change.max())
    return StageChoice(
        Stage.wire,
        most >= _LEAST_SIGMAS,
        f"where the frame is brightest, it changes a sample by up to {most:.3g} times its noise",
    )


def _backscatter(
    profile: Profile,
    noise: Noise,
    exposure_s: float,
    panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None,
) -> StageChoice:
    if profile.backscatter.unfitted:
        return StageChoice(Stage.backscatter, False, "the profile has no backscatter")
    brightest = np.full(3, 255) if panel_picture is None else panel_picture.max(axis=(0, 1))
    part = float(np.max(np.asarray(panel_light(profile.backscatter.term, brightest))))
    if part == 0.0:
        return StageChoice(Stage.backscatter, False, "the panel is black")
    dark_sigma_e = float(np.sqrt(variance_e2(np.zeros((1, 1), np.float32), noise, exposure_s)[0, 0]))
    most = part * exposure_s * float(profile.backscatter_mask.max()) / dark_sigma_e
    shown = "of a white panel (its picture is not known)" if panel_picture is None else "of the panel's picture"
    return StageChoice(
        Stage.backscatter, most >= _LEAST_SIGMAS, f"the light {shown} is up to {most:.3g} times a dark sample's noise"
    )
