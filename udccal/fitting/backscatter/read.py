"""From a session to the data of the backscatter fit."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import chain

import numpy as np
from jaxtyping import Float

from udccal.bins import Bins
from udccal.fitting.backscatter.data import BackscatterData, Binned
from udccal.fitting.backscatter.model import PanelCrop, corners_of, directions, grid_step
from udccal.fitting.backscatter.parameters import BackscatterRules, linear_of, prior_of
from udccal.fitting.nominal import nominal_backscatter
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise, coarse_dark, linear_signal, scalar, variance_e
from udccal.rig import RigDescription
from udccal.sessions.schema import DarkSubject, PanelSubject, StoredStep
from udccal.sessions.store import Average, Session


def read_backscatter(
    session: Session, noise: Noise, geometry: Geometry, shading: Float[np.ndarray, "rows columns"]
) -> BackscatterData:
    """Bin the averages of the steps ``backscatter/*`` of a session, one at a time.

    Args:
        session: holds ``backscatter/white``, ``backscatter/dark`` and other pictures, as averages.
        noise: gives K, black level and saturation, and the variance of samples.
        geometry: the rays of pixels.
        shading: the wire's map of the sensor (``fitting.wire.sensor_map``), which divides the rates.

    Returns:
        rates in e-/s by bin and colour; without shots where white or dark were not captured.

    Raises:
        SessionError: when a file is missing or damaged.
    """
    crop, bins = visible_crop(geometry, session.rig), Bins(session.rig.camera.cfa, grid_step(session.rig))
    steps = session.steps("backscatter")
    panels = [(step, step.subject) for step in steps if isinstance(step.subject, PanelSubject)]
    white = [step for step, subject in panels if subject.role == "white"]
    dark = [step for step in steps if isinstance(step.subject, DarkSubject)]
    others = [(step, subject) for step, subject in panels if subject.role != "white"]
    shown = np.zeros((0, crop.rows, crop.columns, 3), np.uint8)
    if not white or not dark:
        nothing, none = np.zeros((0, 3, 1, 1)), np.zeros(0)
        return BackscatterData(Binned(nothing, nothing, nothing, nothing > 0, none, none), shown, crop, ())
    captures = (step.captures[0] for step in (white[0], *(step for step, _ in others)))
    averages = chain(((session.average(one), one.exposure_s) for one in captures), [_dark(session, dark[0], noise)])
    shots = binned(averages, noise, shading, bins)
    shown = np.concatenate([shown, *(crop.of(session.picture(subject))[None] for _, subject in others)])
    return BackscatterData(shots, shown, crop, tuple(step.id for step, _ in others))


def _dark(session: Session, step: StoredStep, noise: Noise) -> tuple[Average, float]:
    """The dark frame's average and exposure, by the noise term where codes are too coarse to tell the dark level."""
    average, exposure_s = session.average(step.captures[0]), step.captures[0].exposure_s
    coarse = coarse_dark(noise, average.mean, average.variance, exposure_s)
    return average if coarse is None else replace(average, mean=coarse), exposure_s


def binned(
    averages: Iterable[tuple[Average, float]],
    noise: Noise,
    shading: Float[np.ndarray, "rows columns"],
    bins: Bins,
    most: float = BackscatterRules.clipped,
) -> Binned:
    """Bin shots, given as averages in DN and exposures in s; means from ``most`` of saturation on are clipped."""
    gain, black_DN, row_DN, saturation_DN, bend_per_DN = (
        scalar(getattr(noise, name))
        for name in ("K_DN_per_e", "black_DN", "sigma_row_DN", "saturation_DN", "bend_per_DN")
    )
    # Variance of bins if that of a sample over its shading is 1 / shading, or 1: by sample, or by row.
    each, row_e2, shots = 1 / shading, (row_DN / gain) ** 2, []
    shot, sample, row = bins.variance(each), bins.variance(each**2), bins.row_variance(each**2)
    for average, exposure_s in averages:
        signal_e = linear_signal(average.mean - black_DN, bend_per_DN) / gain
        clipped = average.mean >= most * saturation_DN
        # Variance in the dark, e-^2: of a row's offset, and of each sample independently.
        rest_e2 = max(scalar(variance_e(noise, np.zeros(()), np.float64(exposure_s))) - row_e2, 0.0)
        expected = np.maximum(signal_e, 0.0) + rest_e2
        shots.append(
            Binned(
                rate=bins.mean(signal_e / shading)[None] / exposure_s,
                shot=shot[None] / (exposure_s * average.frames),
                rest=(rest_e2 * sample + row_e2 * row)[None] / (exposure_s**2 * average.frames),
                clipped=(bins.mean(clipped.astype(np.float32)) > 0)[None],
                exposure_s=np.array([exposure_s]),
                scatter=np.array([average.variance.mean(dtype=np.float64) / gain**2 / expected.mean()]),
            )
        )
    return Binned.joined(shots)


def visible_crop(geometry: Geometry, rig: RigDescription) -> PanelCrop:
    """Return the part of the panel that any sensor pixel may see, with room for the tolerances of the mounting.

    Args:
        geometry: gives the rays of pixels.
        rig: gives the panel's size and the nominal footprints.
    """
    camera, panel, room_px = rig.camera, rig.panel, 12
    edge_x, edge_y = np.linspace(0, camera.columns - 1, 9), np.linspace(0, camera.rows - 1, 9)
    pixels = np.stack(np.meshgrid(edge_x, edge_y), axis=-1).reshape(-1, 2)
    template = nominal_backscatter(geometry, rig, np.zeros((3, 1, 1)), grid_step(rig), window=1)
    middle = corners_of(template, linear_of(prior_of(rig).mean), directions(geometry, pixels))
    first = np.clip(middle.min(axis=0) - room_px, 0, [panel.columns - 8, panel.rows - 8])
    last = np.clip(middle.max(axis=0) + room_px + 1, first + 8, [panel.columns, panel.rows])
    return PanelCrop(int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1]))
