"""How far the kernel reaches beyond the windows that are fitted: pictures held out, in windows as wide as a kernel."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from udccal.fitting.psf.held_out import judge
from udccal.fitting.psf.read import Reading, read_shots, window_half
from udccal.fitting.psf.residual import Sources, about_middle, make_windows, predict, with_light_of_peak
from udccal.fitting.psf.support import Support, choose_support
from udccal.kernels import kernel_size, kernels_at
from udccal.models.noise import Noise
from udccal.models.psf import PsfField
from udccal.models.wire import Wire
from udccal.numerics import in_float64
from udccal.sessions.store import Session

# Of each position held out, so many pictures are looked at.
_PICTURES: Final = 2
# About the source, whole pixels are too coarse for a kernel that is moved by fractions of one; all windows hold it.
_CORE_PX: Final = 4


@in_float64
def wide_support(
    session: Session,
    noise: Noise,
    wire: Wire,
    reading: Reading,
    sources: Sources,
    term: PsfField,
    held_out: Bool[np.ndarray, " positions"],
) -> Support | None:
    """Choose the support from whole pictures of the positions held out.

    Args:
        session, noise, wire: what the pictures are read with.
        reading: the crops that were fitted. sources: their places and light.
        term: fitted; its support is not looked at.
        held_out: positions that the fit has not seen.

    Returns:
        None where an image carries the kernel, which ends with the crops; or where kernel or pictures are too small.
    """
    assert reading.shots is not None
    rows, columns = kernel_size(session.rig)
    half = window_half(session, (rows // 2, columns // 2))
    if not term.diffraction_share or half[0] > rows // 2 or half[1] > columns // 2:
        return None
    position = reading.shots.position
    chosen = np.concatenate([np.flatnonzero(position == p)[:_PICTURES] for p in np.flatnonzero(held_out)])
    wide = read_shots(session, noise, wire, half, tuple(reading.steps[index] for index in chosen)).shots
    if wide is None or wide.count != len(chosen):
        return None
    sources = sources.pick(chosen)
    windows = make_windows(wide, sources, np.zeros_like(wide.rate), half, np.zeros((wide.count, 2)), 0, 0.0)
    # Of the size that a profile holds: compiled but once.
    kernels = about_middle(kernels_at(term, wide.positions_px(), rows, columns).astype(np.float64), half)
    light = np.asarray(predict(replace(windows, basis=np.eye(len(kernels))[wide.position]), jnp.asarray(kernels)))
    sources = with_light_of_peak(wide, sources, light)
    windows = make_windows(wide, sources, light, half, np.zeros((wide.count, 2)), 0, 0.0)
    judged = judge(windows, 1.0, np.zeros((1, 3, 2 * half[0] + 1, 2 * half[1] + 1)))
    core = (np.abs(wide.offsets()) <= _CORE_PX).all(axis=-1)
    return choose_support(replace(judged, known=judged.known & ~core))
