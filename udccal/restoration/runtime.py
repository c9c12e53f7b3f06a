"""Restoration of frames with a profile: everything is computed once, then reused for every frame.

Units: a restored picture is linear light in e-/s of each camera colour, on the scale of a pixel whose wire value is 1
(the wire's mean over the sensor). Noise may make it slightly negative; encoding for a display clips that.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Bool, Float32, UInt8, UInt16

from udccal.arguments import check_kind
from udccal.cfa import cfa_named
from udccal.errors import RestorationError
from udccal.kernels import fitted_size
from udccal.models.geometry import VirtualView
from udccal.models.noise import Noise
from udccal.models.psf import PsfField
from udccal.profiles.profile import Profile
from udccal.profiles.store import check_profile, load_profile
from udccal.restoration.backscatter import PanelLight, refuse_excess
from udccal.restoration.blind import BlindSamples
from udccal.restoration.checks import check_exposure, check_frame, check_panel_picture
from udccal.restoration.dark_places import plausible
from udccal.restoration.defects import without_defects
from udccal.restoration.demosaic import demosaic
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.linear import least_saturated_e, saturated, to_electrons, variance_e2
from udccal.restoration.panel_mask import PanelMask, mask_mosaic
from udccal.restoration.plan import PlanOptions, checked_options, kernel_grid
from udccal.restoration.prepared import checked_folder, kept
from udccal.restoration.preview import Preview
from udccal.restoration.rectify import Rectification
from udccal.restoration.sharpen import Sharpener
from udccal.restoration.stages import Stage, check_stages
from udccal.restoration.tone import TONE_ADVICE, Tone
from udccal.restoration.view import kept_view
from udccal.rig import RigDescription
from udccal.tiers import Tier, tier_named

# A preview has no sharp edges to win, and overshoots those that it has by 7 % of their step and not by 12 %.
_PREVIEW_DETAIL = 0.65
# In e-/s, or what a wire passes: nothing.
_NO_LIGHT = 1e-9

Mosaic = Float32[np.ndarray, "rows columns"]
Picture = Float32[np.ndarray, "rows columns 3"]


@final
@dataclass(frozen=True)
class SceneLight:
    """The scene's part of some rows of a frame.

    Attributes:
        signal_e: in e-, divided by the wire.
        variance_e2: of its noise in e-^2.
        clipped: samples whose light was more than they say.
        panel_error_e: sigma of the panel's light that was taken off, in e-; None where it is 0 or not known.
        levels: of the panel, as the frame shows them; None where the panel's picture is known, or nothing comes of it.
    """

    signal_e: Mosaic
    variance_e2: Mosaic
    clipped: Bool[np.ndarray, "rows columns"]
    panel_error_e: Mosaic | None
    levels: Float32[np.ndarray, "3"] | None


@dataclass(frozen=True, eq=False)
class Restorer:
    """A profile prepared to restore frames at one tier.

    Attributes:
        tier: how much is done to a frame.
        rig: the rig description.
        noise: the noise term.
        view: the view of restored pictures.
        wire: map to divide the frame's ``rows`` by; None when it is 1 everywhere.
        mask: backscatter in these rows of pictures that are not known; None when the rig has none.
        panel: backscatter in these rows of known panel pictures; None when the rig has none, or the tier does not ask
            for the picture.
        sharpener: demosaics and deblurs; None when the rig has no blur, or the tier leaves it.
        rectification: map from sensor to view.
        options: options of the restoration.
    """

    tier: Tier
    rig: RigDescription
    noise: Noise
    view: VirtualView
    wire: Mosaic | None
    mask: PanelMask | None
    panel: PanelLight | None
    sharpener: Sharpener | None
    rectification: Rectification
    options: PlanOptions

    @classmethod
    def load(
        cls,
        profile: str | Path,
        tier: Tier | str = Tier.balanced,
        options: PlanOptions | None = None,
        keep: str | Path | None = None,
    ) -> Restorer:
        """Read a profile, and prepare it.

        Args:
            profile: path of a folder or a zip file, or the name of a rig that has a profile.
            tier: how much is done to a frame; preview, fast, balanced or accurate.
            options: accuracy against time within the tier.
            keep: as for ``from_profile``.

        Raises:
            ProfileError: when it cannot be read.
            RestorationError: as ``from_profile``.
        """
        return cls.from_profile(load_profile(profile), tier, options, keep)

    @classmethod
    def from_profile(
        cls,
        profile: Profile,
        tier: Tier | str = Tier.balanced,
        options: PlanOptions | None = None,
        keep: str | Path | None = None,
        without: frozenset[Stage] = frozenset(),
    ) -> Restorer:
        """Prepare a profile.

        Args:
            profile: the rig as measured.
            tier: how much is done to a frame; preview, fast, balanced or accurate.
            options: accuracy against time within the tier.
            keep: folder that keeps what is computed, so that the next start of a program reads it instead; None to
                keep nothing. ``prepared_folder()`` is the one of the ``udccal`` command.
            without: stages that the scene does not need (``chosen_stages``). Nothing is computed for them, and frames
                do not pass them.

        Raises:
            RestorationError: when its geometry leaves no view through the panel, a term gives values that are not
                finite, there is no such tier or stage, options are no ``PlanOptions``, or ``keep`` is no path of a
                folder.
        """
        check_profile(profile)
        check_stages(without)
        options, tier, keep = checked_options(options), tier_named(tier), checked_folder(keep)
        rig, geometry = profile.rig, profile.geometry.term
        camera, cfa = rig.camera, cfa_named(rig.camera.cfa)
        view = kept_view(geometry, rig, keep)
        rectification = kept(
            keep,
            Rectification,
            (geometry, view, camera),
            lambda: Rectification.within(geometry, view, camera.columns, camera.rows),
        )
        quick = tier is Tier.preview
        sharpener = (
            None
            if quick or profile.psf.unfitted
            else Sharpener.of(
                _kept_grid(profile.psf.term, rig, options, keep), rig, rectification.rows, tier, options, keep
            )
        )
        rows = _needed_rows(sharpener, rig)
        unscattered = profile.backscatter.unfitted or Stage.backscatter in without
        error = profile.backscatter.diagnostic("held_out_without_noise_of_peak") or 0.0
        even = profile.wire.unfitted and bool(np.all(profile.wire_map == 1.0))
        return cls(
            tier=tier,
            rig=rig,
            noise=profile.noise.term,
            view=view,
            wire=None if even or Stage.wire in without else profile.wire_map[rows],
            mask=None
            if unscattered
            else PanelMask(mask_mosaic(profile.backscatter_mask, cfa, camera.rows, camera.columns)[rows], cfa, error),
            panel=None if quick or unscattered else PanelLight.of(profile.backscatter.term, rig, keep).of_rows(rows),
            sharpener=sharpener,
            rectification=rectification,
            options=options,
        )

    @property
    def rows(self) -> slice:
        """Rows of the frame that are worked on: those that the view sees, and what their tiles reach beyond."""
        return _needed_rows(self.sharpener, self.rig)

    @property
    def seen_rows(self) -> slice:
        """Rows of the frame that ``display`` depends on: a camera may leave out the others."""
        if self.sharpener is not None:
            return self.rows
        first, last = self.rectification.rows
        return slice(max(first, 0) // (cell := cfa_named(self.rig.camera.cfa).rows) * cell, min(last, self.rows.stop))

    def restore(
        self,
        mosaic: UInt16[np.ndarray, "frame_rows frame_columns"],
        exposure_s: float,
        panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None = None,
    ) -> Picture:
        """Restore a frame.

        Args:
            mosaic: raw frame in DN.
            exposure_s: exposure time of the frame in s.
            panel_picture: what the panel showed, 8-bit RGB (a black picture when it was off); None when not known.

        Returns:
            the clean picture on the virtual view: linear RGB in e-/s.

        Raises:
            RestorationError: when the frame, its exposure or the panel picture does not belong to this rig.
            PanelPictureError: when the panel's picture alone would give more light than the frame has: the exposure is
                wrong, or the picture.
        """
        linear = self._restored_e(mosaic, exposure_s, panel_picture)
        linear /= np.float32(exposure_s)
        return linear

    def _restored_e(
        self,
        mosaic: UInt16[np.ndarray, "frame_rows frame_columns"],
        exposure_s: float,
        panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None,
    ) -> Picture:
        """Return the clean picture in e-."""
        light = self.scene_light(mosaic, exposure_s, panel_picture)
        if self.sharpener is None:
            seen, rectification = self._seen
            return rectification.apply(demosaic(light.signal_e[seen], self.rig.camera.cfa, _PREVIEW_DETAIL))
        inner = self.sharpener.layout.inner
        sharp = self.sharpener.apply(light.signal_e, light.variance_e2, light.clipped)
        if light.levels is not None and self.mask is not None:
            sharp = self.mask.put_back(sharp, light.levels, inner.start, exposure_s, self.noise)
        if light.panel_error_e is not None:
            sharp = plausible(sharp, light.panel_error_e[inner])
        return self.strip_rectification.apply(sharp, self.options.interpolation)

    def scene_light(
        self,
        mosaic: UInt16[np.ndarray, "frame_rows frame_columns"],
        exposure_s: float,
        panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None = None,
    ) -> SceneLight:
        """Return the light of the scene alone, before it is deblurred, of the frame's ``rows``.

        Arguments and errors are those of ``restore``.
        """
        check_frame(mosaic, exposure_s, self.rig)
        check_panel_picture(panel_picture, self.rig)
        cfa, workers = self.rig.camera.cfa, self.options.workers
        mosaic = without_defects(self.blind.mended(mosaic[self.rows], exposure_s), self.noise, exposure_s, cfa, workers)
        signal = to_electrons(mosaic, self.noise, exposure_s)
        variance = variance_e2(signal, self.noise, exposure_s)
        if (wire := self.blind.wire) is not None:
            signal /= wire
            variance /= wire
            variance /= wire
        clipped = saturated(mosaic, self.noise)
        panel_error_e, levels = None, None
        if self.mask is not None:
            if panel_picture is None or self.panel is None:
                levels = self.mask.levels(signal, exposure_s, self.noise)
                panel_e = np.float32(exposure_s) * self.mask.rate(levels)
            else:
                panel_e = np.float32(exposure_s) * self.panel.rate(panel_picture)
                refuse_excess(signal, panel_e, clipped)
            signal -= panel_e
            if self.mask.error > 0:
                panel_error_e = np.float32(self.mask.error) * panel_e
        return SceneLight(signal, variance, clipped, panel_error_e, levels)

    def display(
        self,
        mosaic: UInt16[np.ndarray, "frame_rows frame_columns"],
        exposure_s: float,
        tone: Tone,
        panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None = None,
    ) -> UInt8[np.ndarray, "view_rows view_columns 3"]:
        """Restore a frame for a display: 8-bit sRGB on the virtual view.

        The tier ``preview`` has a path of its own for this, many times quicker than ``restore``.

        Args:
            mosaic: raw frame in DN.
            exposure_s: exposure time of the frame in s.
            tone: exposure and colour gains, such as ``Tone(display_exposure(picture))`` of an earlier picture.
            panel_picture: as for ``restore``.

        Raises:
            RestorationError: as ``restore``.
        """
        check_exposure(exposure_s)
        check_kind(tone, Tone, TONE_ADVICE, RestorationError)
        if self.tier is not Tier.preview:
            return tone.of_electrons(exposure_s).rgb8(self._restored_e(mosaic, exposure_s, panel_picture))
        check_frame(mosaic, exposure_s, self.rig)
        check_panel_picture(panel_picture, self.rig)
        return self._preview.rgb8(mosaic, exposure_s, tone)

    def before(self, mosaic: UInt16[np.ndarray, "frame_rows frame_columns"], exposure_s: float) -> Picture:
        """Return the frame without restoration: black level, demosaicing and geometry only, linear RGB in e-/s."""
        check_frame(mosaic, exposure_s, self.rig)
        sensor_e = demosaic(to_electrons(mosaic, self.noise, exposure_s), self.rig.camera.cfa)
        return self.rectification.apply(sensor_e) / np.float32(exposure_s)

    def clipping_light(self, exposure_s: float) -> float:
        """Return light in e-/s that a restored picture has wherever samples clip: a display shows it white.

        Args:
            exposure_s: exposure time of the frame in s.

        Raises:
            RestorationError: when it is no time.
        """
        check_exposure(exposure_s)
        wire, panel = self._brightest
        light = least_saturated_e(self.noise, exposure_s) / (exposure_s * wire)
        # A panel that nearly fills the range by itself would leave nothing, and dark current may leave nothing at all.
        return max(light - panel, light / 2) if light > _NO_LIGHT else math.inf

    @functools.cached_property
    def _brightest(self) -> tuple[float, float]:
        """The most that the wire passes, and the most light of a white panel in e-/s."""
        wire = 1.0 if self.wire is None else max(float(self.wire.max()), _NO_LIGHT)
        return wire, 0.0 if self.mask is None else float(self.mask.white.max())

    @functools.cached_property
    def blind(self) -> BlindSamples:
        """Samples of the frame's ``rows`` that carry no information."""
        shape = len(range(*self.rows.indices(self.rig.camera.rows))), self.rig.camera.columns
        return BlindSamples.of(self.wire, shape, cfa_named(self.rig.camera.cfa), self.noise)

    @functools.cached_property
    def strip_rectification(self) -> Rectification:
        """Map from the rows that the sharpener returns to the view."""
        assert self.sharpener is not None
        return self.rectification.from_row(self.sharpener.rows.start)

    @functools.cached_property
    def _seen(self) -> tuple[slice, Rectification]:
        """Rows of the frame that the view reads, with those that demosaicing reads beside them; map from them."""
        first, last = self.rectification.rows
        cell, beside = cfa_named(self.rig.camera.cfa).rows, 2
        start = max(first - beside, 0) // cell * cell
        return slice(start, last + beside), self.rectification.from_row(start)

    @functools.cached_property
    def _preview(self) -> Preview:
        camera = self.rig.camera
        cfa = cfa_named(camera.cfa)
        sensor = camera.rows, camera.columns
        return Preview.of(self.noise, self.wire, self.mask, cfa, self.rectification, sensor)


def _needed_rows(sharpener: Sharpener | None, rig: RigDescription) -> slice:
    return slice(0, rig.camera.rows) if sharpener is None else sharpener.layout.reach


def _kept_grid(psf: PsfField, rig: RigDescription, options: PlanOptions, keep: Path | None) -> KernelGrid:
    """Return ``kernel_grid``. Of the rig and the options, sizes alone matter to what is kept."""
    size = fitted_size(psf, rig, options.kernel_rows, options.kernel_columns)
    nodes = options.grid_rows, options.grid_columns
    sensor = rig.camera.rows, rig.camera.columns
    return kept(keep, KernelGrid, (psf, size, nodes, sensor), lambda: kernel_grid(psf, rig, options))
