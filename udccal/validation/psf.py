"""psf: merged brackets of a session's LEDs, as a profile's kernel predicts them.

The place of each LED, its light in each colour and the background are solved for.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from udccal.fitting.psf.data import HUBER, PsfData, PsfRules, Shots, held_out_positions
from udccal.fitting.psf.held_out import Compared, compare
from udccal.fitting.psf.image import make_windows
from udccal.fitting.psf.kernel import Evaluator, fit_lattice
from udccal.fitting.psf.problem import explain
from udccal.fitting.psf.start import pack, read_psf
from udccal.models.diffraction import is_shaped
from udccal.models.fields import polynomial_basis
from udccal.models.psf import PsfField
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile
from udccal.result import FitResult
from udccal.sessions.store import Session
from udccal.validation.checks import Check, Judged, ZMap, at_most, chi2_check, unusable
from udccal.validation.limits import ValidationLimits
from udccal.validation.patterns import Samples, pattern_check

# Pictures of a place that are predicted.
_PICTURES = 2


def validate_psf(profile: Profile, session: Session, limits: ValidationLimits, own: bool) -> Judged:
    """Judge a session's LEDs; see ``judge_psf``.

    Raises:
        SessionError: when a file of the session is missing or damaged.
    """
    return judge_psf(read_psf(session, profile.noise.term, profile.wire_map), profile.psf, limits, own)


@in_float64
def judge_psf(data: PsfData, result: FitResult[PsfField], limits: ValidationLimits, own: bool) -> Judged:
    """Judge the relative L2 error of the LEDs' pictures, patterns in it, and their chi-squared.

    Of the profile's ``own`` session, only the positions count that its fit held out.
    """
    rules, term = PsfRules(), result.term
    if not float(term.diffraction_fraction):
        why = "The profile's psf is an image without diffraction, which does not place an LED closely enough."
        return Judged((Check("psf", "not predicted", None, None, "", None, why),))
    if data.shots is None:
        return unusable("psf", "No bracket shows an LED that is not clipped. Capture the psf steps again.")
    shots = data.shots.within(rules.half_px)
    shots = shots.pick(held_out_positions(shots.positions)[shots.position]) if own else shots
    shots = shots.pick(_some(shots))
    model_error = result.diagnostic("model_error") or 0.0
    found = _compared(term, shots, model_error, rules)
    colours = found.relative_l2()
    total = found.variance + (model_error * found.left_out) ** 2
    z = np.where(found.known, found.residual / np.sqrt(total), 0.0)
    count = int(found.known.sum())
    worst = int(np.argmax(colours))
    checks = (
        at_most(
            "psf",
            "LED's picture, L2",
            100 * float(colours[worst]),
            limits.kernel_percent,
            "%",
            f"Pictures of {shots.count} LEDs at {shots.positions} places differ from the predicted spots by "
            f"{100 * float(colours[worst]):.2f} % of their light (L2, {('red', 'green', 'blue')[worst]}).",
        ),
        _pattern_check(found, shots, model_error, limits),
        chi2_check(
            "psf",
            float(HUBER.loss(z[found.known]).sum()) / count,
            count,
            result.chi2_dof,
            limits.chi2_factor,
            limits,
            "Samples of LEDs' pictures",
        ),
    )
    caption = "Pictures of LEDs, seen less predicted, mean over all of them about the LED's middle, in sigma."
    seen = np.maximum(found.known.sum(axis=0), 1)
    return Judged(checks, ZMap(z.sum(axis=0) / np.sqrt(seen), "x [px]", "y [px]", caption))


def _pattern_check(found: Compared, shots: Shots, model_error: float, limits: ValidationLimits) -> Check:
    """What all LEDs' pictures share in rings, rows or columns about the LED, and what those of a place share."""
    here, model = found.known, model_error * found.left_out
    # All pictures have the same kernel, and so about the same model error in a sample at the same place about the LED.
    place = np.broadcast_to(np.arange(here[0].size).reshape(here.shape[1:]), here.shape)
    samples = Samples(found.residual[here], found.variance[here], model[here], place[here])
    light = float(np.sqrt(np.mean(found.light[here] ** 2)))
    return pattern_check(
        "psf",
        "pattern of the LEDs' pictures",
        [samples.pattern(np.broadcast_to(group, here.shape)[here]) for group in _groups(shots, found.channel)],
        100 / max(light, 1e-30),
        limits.kernel_pattern_percent,
        "%",
        "Rings, rows, columns and places of the LEDs' pictures",
    )


def _groups(
    shots: Shots, channel: Int[np.ndarray, "shots rows columns"]
) -> tuple[Int[np.ndarray, "shots rows columns"], ...]:
    """Numbers of each sample's ring, row and column about the LED, and of its ring at its place; all by colour."""
    x, y = np.moveaxis(shots.offsets(), -1, 0)
    radius = np.hypot(x, y)
    # At a place, few samples share a pixel: rings double their radius there.
    wide = np.log2(1 + radius).astype(np.int64)
    at_place = shots.position[:, None, None] * (wide.max() + 1) + wide
    return tuple(3 * part + channel for part in (np.rint(radius).astype(np.int64), y - y.min(), x - x.min(), at_place))


def _some(shots: Shots) -> Int[np.ndarray, " some"]:
    """The first pictures of each place: enough to judge, and quick."""
    return np.concatenate([np.flatnonzero(shots.position == place)[:_PICTURES] for place in range(shots.positions)])


def _compared(term: PsfField, shots: Shots, model_error: float, rules: PsfRules) -> Compared:
    """The pictures beside those by the term, at the best places and light of the LEDs."""
    model = term.diffraction
    nodes, lattice = np.asarray(model.wavelengths_nm), fit_lattice(shots.half)
    evaluator = Evaluator(nodes, lattice, bool(model.visibility), is_shaped(model))
    error = max(model_error, rules.first_model_error)
    sources, explained = explain(evaluator, pack(model), shots, term.geometry, error)
    unit = (shots.positions_px() - np.asarray(term.centre_px)) / np.asarray(term.half_px)
    basis = np.asarray(polynomial_basis(unit, term.degree), dtype=np.float64)[shots.position]
    windows = make_windows(shots, sources, explained, basis, model_error)
    light = windows.expected(_framed(np.asarray(term.residual, dtype=np.float64), shots.rate.shape[1:]))
    return compare(shots, windows, light)


def _framed(
    image: Float[np.ndarray, "terms 3 rows columns"], shape: tuple[int, ...]
) -> Float[np.ndarray, "terms 3 window_rows window_columns"]:
    """The residual's image in a window of odd sides, cut or filled up with zeros."""
    framed = np.zeros((*image.shape[:2], *shape))
    rows, columns = (min(have, want) // 2 for have, want in zip(image.shape[2:], shape, strict=True))
    (y, x), (v, u) = ((n // 2 for n in shape), (n // 2 for n in image.shape[2:]))
    framed[:, :, y - rows : y + rows + 1, x - columns : x + columns + 1] = image[
        :, :, v - rows : v + rows + 1, u - columns : u + columns + 1
    ]
    return framed
