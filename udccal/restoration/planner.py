"""Makes the plan of a scene from a profile, a frame and the panel's picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16

from udccal.cfa import cfa_named
from udccal.errors import RestorationError
from udccal.kernels import fitted_size
from udccal.profiles.profile import Profile
from udccal.restoration.checks import check_frame, check_panel_picture
from udccal.restoration.forecast import expected_error
from udccal.restoration.frame_time import FrameSize, part_times
from udccal.restoration.lamp_pieces import lamp_pieces
from udccal.restoration.linear import saturated
from udccal.restoration.runtime import Restorer
from udccal.restoration.scene_plan import ScenePlan, TierForecast, Wish, chosen_tier
from udccal.restoration.stages import StageChoice
from udccal.restoration.tiles import layout_for
from udccal.tiers import DEFAULT_TIER, Tier


def planned(
    profile: Profile,
    mosaic: UInt16[np.ndarray, "rows columns"],
    exposure_s: float,
    panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None,
    asked: Tier | Wish,
    stages: tuple[StageChoice, ...],
    forecast: bool = False,
    keep: Path | None = None,
) -> ScenePlan:
    """Make a plan, and compute for it no more than is asked.

    A budget takes the times of this computer, a least PSNR the filters of the profile; a plan without both takes
    neither.

    Args:
        profile: the rig as measured.
        mosaic, exposure_s, panel_picture: as for ``Restorer.restore``, which would accept them.
        asked: the tier, or what is asked of the one that is chosen.
        stages: what the scene needs: ``chosen_stages`` of this frame, or ``needed_by_any`` of several.
        forecast: whether the plan says what each tier is expected to give, whatever is asked.
        keep: folder that keeps what is computed; None to keep nothing.

    Raises:
        RestorationError: when no tier does what is asked, a least PSNR is asked where none can be told (no psf, or a
            panel whose picture is not known), or the profile gives no finite values.
    """
    check_frame(mosaic, exposure_s, profile.rig)
    check_panel_picture(panel_picture, profile.rig)
    tier, wish = (None, asked) if isinstance(asked, Wish) else (asked, Wish())
    if not forecast and wish == Wish():
        return ScenePlan.of(profile, tier or DEFAULT_TIER, stages)
    without = frozenset(choice.stage for choice in stages if not choice.runs)
    preview = Restorer.from_profile(profile, Tier.preview, keep=keep, without=without)
    tiers = _timed(profile, preview, mosaic, keep)
    chosen_tier(tiers, Wish(budget_ms=wish.budget_ms))  # refuses before kernels are computed
    untold = _untold(profile, panel_picture is None and preview.mask is not None)
    if wish.min_psnr_dB is not None and untold:
        raise RestorationError(untold)
    if not untold and (forecast or wish.min_psnr_dB is not None):
        restorer = Restorer.from_profile(profile, Tier.balanced, keep=keep, without=without)
        error = expected_error(preview, restorer, mosaic, exposure_s, panel_picture, keep)
        tiers = tuple(TierForecast(each.tier, error.psnr_dB(each.tier), each.frame_ms) for each in tiers)
    return ScenePlan.of(profile, tier or chosen_tier(tiers, wish), stages, tiers)


def _untold(profile: Profile, panel_unknown: bool) -> str:
    """Return why no PSNR can be told, and what to do; empty where one can.

    What is left of the light of a panel whose picture is not known depends on that picture: the frame does not tell it.
    """
    if profile.psf.unfitted:
        return (
            "Expected a profile with a psf for a least PSNR, found one without: no PSNR can be told of this profile. "
            "Leave the least PSNR out."
        )
    if panel_unknown:
        return (
            "Expected the panel's picture for a least PSNR, found that it is not known: how much of the panel's light "
            "is left depends on it. Give it, or leave the least PSNR out."
        )
    return ""


def _timed(
    profile: Profile, preview: Restorer, mosaic: UInt16[np.ndarray, "rows columns"], keep: Path | None
) -> tuple[TierForecast, ...]:
    """Return every tier with its time for a frame; the PSNR is not known yet."""
    options, camera = preview.options, profile.rig.camera
    cfa = cfa_named(camera.cfa)
    largest = options.tile_rows, options.tile_columns
    layout = layout_for(camera.rows, camera.columns, (cfa.rows, cfa.columns), largest, preview.rectification.rows)
    clipped = saturated(mosaic[layout.reach], preview.noise)
    kernel_rows, _ = fitted_size(profile.psf.term, profile.rig, options.kernel_rows, options.kernel_columns)
    lamps = len(lamp_pieces(clipped, layout, options.lamps, kernel_rows))
    view_px = preview.view.rows * preview.view.columns
    size = FrameSize.of(layout, view_px, not profile.psf.unfitted, clipped, lamps)
    times = part_times(options, keep)
    return tuple(TierForecast(tier, None, size.ms(tier, times)) for tier in Tier)
