"""Exposure brackets to one linear picture: maximum likelihood with the sensor's noise model."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

from udccal.errors import FitError
from udccal.fitting.engine.robust import outliers
from udccal.fitting.hdr.doubts import checked, doubts, rounding_e
from udccal.fitting.hdr.likelihood import BlockMerge, SensorNumbers, compiled_merge_block, merge_block
from udccal.models.noise import Noise
from udccal.result import FitStatus, Outliers

# Sigma where no sample could be used: finite, and larger than any rate that a sensor can measure.
UNKNOWN_SIGMA = 1e12
# Pixels of a picture that is worth compiling for, and of one compiled pass, which stays in the processor's cache.
_LEAST_COMPILED, _BLOCK = 1 << 16, 1 << 14


@final
@dataclass(frozen=True)
class HdrRules:
    """The constants of a merge.

    Attributes:
        believed_sigma: a sample farther than this from the other samples of its pixel is a hit, clipped or not.
        margin_sigma: samples count as clipped from this many sigma of dark noise below saturation on.
        frame_off, frame_sigma: a frame is left out when its light is off by more than both (relative, and in sigma).
        least_to_judge: the fewest samples of a pixel for finding hits and testing frames.
        scatter_off: scatter of samples about their light, relative to the noise model's variance, that is too much.
        sure_electrons: electrons that a pixel's light is worth before the scatter about it is judged.
        black_off: error of the black level, in sigma of dark noise, that is too much.
    """

    believed_sigma: float = 6.0
    margin_sigma: float = 6.0
    frame_off: float = 0.02
    frame_sigma: float = 5.0
    least_to_judge: int = 3
    scatter_off: float = 0.05
    sure_electrons: float = 100.0
    black_off: float = 0.1


@final
@dataclass(frozen=True)
class HdrMerge:
    """A picture of one still scene, from a bracket.

    Attributes:
        rate_e_per_s, sigma_e_per_s: light of every pixel, with one standard deviation.
        used: number of samples used for each pixel; where it is 0 the rate is 0 and sigma ``UNKNOWN_SIGMA``.
        outliers: frames and samples that were left out.
        status, notes: SATURATED where no pixel has a sample that could be used, POOR_FIT where samples of a pixel
            scatter unlike the noise model says, so that rate and sigma are not to be trusted; sentences for a person.
    """

    rate_e_per_s: Float[np.ndarray, "*picture"]
    sigma_e_per_s: Float[np.ndarray, "*picture"]
    used: Int[np.ndarray, "*picture"]
    outliers: tuple[Outliers, ...] = ()
    status: FitStatus = FitStatus.CONVERGED
    notes: tuple[str, ...] = ()


def merge_bracket(
    frames: UInt16[np.ndarray, "n *picture"],
    exposures_s: Float[np.ndarray, " exposures"],
    noise: Noise,
    rules: HdrRules | None = None,
) -> HdrMerge:
    """Merge frames of one still scene at several exposures (repeats allowed).

    It solves the likelihood equation of ``hdr.likelihood`` for each pixel: weights from single noisy samples would pull
    dark pixels down. Frames of other light (a lamp that flickered, a dropped frame) and samples far from the others of
    their pixel (cosmic hits, blinking pixels) are left out and listed.

    Args:
        frames: codes in DN, one frame or mosaic per exposure, all of one shape.
        exposures_s: exposure of each frame.
        noise: noise model of the sensor.
        rules: see ``HdrRules``.

    Returns:
        rate and sigma in e-/s of every pixel, and the outliers.

    Raises:
        FitError: when frames are not codes, exposures are not positive or not as many as frames, or a number of the
            noise is impossible.
    """
    rules = rules or HdrRules()
    times = checked(frames, exposures_s)
    # Times in units of the longest: sums of their squares stay in single precision's range.
    unit, shape, dropped = float(times.max()), frames.shape[1:], np.zeros((len(frames), 1), bool)
    codes = np.ascontiguousarray(frames).reshape(len(frames), -1)
    sensor, rounded_e = sensor_numbers(noise, unit, rules), rounding_e(noise)
    bracket = _Bracket(codes, (times / unit).astype(np.float32), sensor, rules, rounded_e)
    merged = bracket.merged(dropped)
    unlike: list[int] = []
    while (bad := bracket.frames_off(merged, dropped)).size:
        dropped[bad[0]] = True
        unlike = bad.tolist() if len(bad) > 1 else unlike
        merged = bracket.merged(dropped)
    hits, black_e = bracket.mend_hits(merged, dropped), bracket.black_off(merged, dropped)
    scatter, unsure = bracket.scatter(merged, dropped), bracket.light_off(merged, dropped)
    # In place: copies of a full frame would cost as much as a third of the merging.
    for values in (merged.rate, merged.sigma):
        values /= np.float32(unit)
    unknown = merged.used <= 0
    merged.rate[unknown], merged.sigma[unknown] = 0.0, UNKNOWN_SIGMA
    notes = [f"{unknown.sum()} of {unknown.size} pixels have no sample that could be used."] if unknown.any() else []
    doubted = doubts(scatter, black_e * float(np.asarray(noise.K_DN_per_e)), unlike, unsure)
    notes += doubted
    if rounded_e > rules.black_off * math.sqrt(sensor.floor_e2):
        notes.append("Dark noise is far below a code: rounding moves dark pixels by up to half a code. Raise the gain.")
    off = f"frames whose light is off by more than {100 * rules.frame_off:g} % and {rules.frame_sigma:g} sigma"
    hit = f"pixels with a sample more than {rules.believed_sigma:g} sigma from what its other samples say; that sample"
    places = (str(tuple(int(k) for k in np.unravel_index(pixel, shape))) for pixel in hits)
    listed = outliers(off, (f"frame {i}" for i in np.flatnonzero(dropped)))
    listed += outliers(f"{hit} is left out", places)
    status = FitStatus.POOR_FIT if doubted else FitStatus.CONVERGED
    status = FitStatus.SATURATED if unknown.size and unknown.all() else status
    rate, sigma, used = (part.reshape(shape) for part in (merged.rate, merged.sigma, merged.used))
    return HdrMerge(rate, sigma, used, listed, status, tuple(notes))


def sensor_numbers(noise: Noise, unit_s: float, rules: HdrRules) -> SensorNumbers:
    """The numbers of a noise model that the likelihood uses, times in units of ``unit_s``."""
    parts = noise.K_DN_per_e, noise.black_DN, noise.saturation_DN, noise.sigma_d_e, noise.q_DN, noise.DSNU1288_e
    K, black, saturation, sigma_d, q, offset = values = [float(np.asarray(part)) for part in parts]
    if not (np.isfinite(values).all() and K > 0 and sigma_d >= 0 and saturation > black):
        found = f"K {K:g} DN/e, black {black:g} DN, saturation {saturation:g} DN, sigma_d {sigma_d:g} e"
        raise FitError(f"Expected a noise model with a gain above 0 and saturation above black, found {found}. Fit it.")
    # A sensor without any dark noise still has a least variance: the likelihood of its dark pixels stays finite.
    floor = max(sigma_d**2 + (q / K) ** 2 / 12.0, 1e-4)
    level = (saturation - black) / K - rules.margin_sigma * math.sqrt(floor)
    numbers = black, 1 / K, float(np.asarray(noise.dark_current_e_per_s)) * unit_s, floor, level, offset
    return SensorNumbers(*(np.float32(n) for n in numbers))


@dataclass(frozen=True)
class _Bracket:
    codes: UInt16[np.ndarray, "n pixels"]
    times: Float[np.ndarray, " n"]
    sensor: SensorNumbers
    rules: HdrRules
    rounding_e: float

    def merged(self, left_out: Bool[np.ndarray, "n #pixels"]) -> BlockMerge:
        """All pixels, without the samples that are left out."""
        codes, pixels, left_out = self.codes, self.codes.shape[1], np.broadcast_to(left_out, self.codes.shape)
        if pixels < _LEAST_COMPILED:
            return merge_block(codes, self.times, self.sensor, left_out, self.rules.believed_sigma)
        out = BlockMerge(*(np.empty(pixels, kind) for kind in ("f4", "f4", "i4", "i4", "f4")))

        def run(start: int) -> None:
            part = np.s_[start : start + _BLOCK]
            numbers = codes[:, part], self.times, self.sensor, left_out[:, part], self.rules.believed_sigma
            _put(out, part, compiled_merge_block(*numbers, jnp))

        with ThreadPoolExecutor(2) as pool:
            # The last block overlaps the one before it, so that all have one size.
            list(pool.map(run, (min(start, pixels - _BLOCK) for start in range(0, pixels, _BLOCK))))
        return out

    def frames_off(self, merged: BlockMerge, dropped: Bool[np.ndarray, "n 1"]) -> Int[np.ndarray, " off"]:
        """Frames without any one of which the others agree, the best first; none where all agree."""
        if not self._frame_scores(merged, dropped, self.rules.least_to_judge).max() > self.rules.frame_sigma:
            return np.zeros(0, int)
        # The frame of most light sets the merged light: where it is wrong, the others are off. Each is left out once.
        part = replace(self, codes=np.ascontiguousarray(self.codes[:, :: max(1, self.codes.shape[1] // 20_000)]))
        left = np.full(len(dropped), np.inf)
        for i in np.flatnonzero(~dropped):
            without = dropped | (np.arange(len(dropped)) == i)[:, None]
            left[i] = part._frame_scores(part.merged(without), without, self.rules.least_to_judge - 1).max()
        order = np.argsort(left)
        return order[: max(1, int(np.sum(left <= self.rules.frame_sigma)))]

    def _frame_scores(
        self, merged: BlockMerge, dropped: Bool[np.ndarray, "n 1"], least: int
    ) -> Float[np.ndarray, " n"]:
        """How far each frame's light is off that of all, in sigma, in pixels of at least so many samples.

        It is 0 where that is little or unknown.
        """
        rules, sensor = self.rules, self.sensor
        _, light, mean, variance = self._lit(merged, least)
        dark, sigma = float(sensor.dark_e_per_s) * self.times[:, None].astype(np.float64), np.sqrt(variance)
        signal = mean - dark
        # Unclipped samples near the level are the low ones of their kind; samples of few electrons are skewed. Both are
        # left out here. The median keeps hits from counting as a lamp that flickers.
        clear = ~dropped & (mean + 5 * sigma < float(sensor.level_e)) & (10 * sigma < signal)
        score = np.zeros(len(clear))
        for i in np.flatnonzero(clear.sum(axis=1) >= 8):
            part = np.s_[i, clear[i]]
            off = abs(float(np.median((light - dark)[part] / signal[part] - 1)))
            # A median's standard error is 1.2533 times a mean's.
            error = 1.2533 * float(np.median(sigma[part] / signal[part])) / math.sqrt(clear[i].sum())
            score[i] = off / error if off > rules.frame_off else 0.0
        return score

    def _lit(
        self, merged: BlockMerge, least: int, least_rate: float = 0.0
    ) -> tuple[
        Int[np.ndarray, " lit"], Float[np.ndarray, "n lit"], Float[np.ndarray, "n lit"], Float[np.ndarray, "n lit"]
    ]:
        """Some lit pixels with at least so many samples; their samples, and those' mean and variance, in electrons."""
        sensor, lit = self.sensor, np.flatnonzero((merged.used >= least) & (merged.rate > least_rate))
        lit = lit[:: max(1, len(lit) // 20_000)]
        light = (self.codes[:, lit].astype(np.float64) - float(sensor.black_DN)) * float(sensor.e_per_DN)
        mean = (merged.rate[lit].astype(np.float64) + float(sensor.dark_e_per_s)) * self.times[:, None]
        return lit, light, mean, np.maximum(mean, 0.0) + float(sensor.floor_e2)

    def scatter(self, merged: BlockMerge, dropped: Bool[np.ndarray, "n 1"]) -> float:
        """Variance of samples about their pixel's light over the model's; 1 where that is what chance gives."""
        lit, light, mean, variance = self._lit(merged, 2)
        times, level_e = self.times[:, None].astype(np.float64), float(self.sensor.level_e)
        # Clear of clipping, and of pixels whose light is known well: that the variance is that of the light as merged,
        # and not as it is, changes nothing then.
        sure = merged.rate[lit] > self.rules.sure_electrons**0.5 * merged.sigma[lit]
        clear = ~dropped & sure & (mean + 5 * np.sqrt(variance) < level_e)
        # Hits in pixels of two samples are not found: a few of them must not count much.
        chi2 = np.minimum((light - mean) ** 2 / variance, 4.0**2)
        # A pixel's offset moves its light by `follows` of itself, and its samples by what is left.
        slope = np.where(~dropped & (mean < level_e), times / variance, 0.0)
        follows = slope.sum(axis=0) / np.maximum((slope * times).sum(axis=0), 1e-30)
        offset_e = float(self.sensor.offset_e)
        known = times**2 * np.maximum(merged.sigma[lit].astype(np.float64) ** 2 - (offset_e * follows) ** 2, 0)
        expected = 1 - np.minimum(known / variance, 1) + (offset_e * (1 - follows * times)) ** 2 / variance
        dof = float(np.sum(expected[clear]))
        found = float(np.sum(chi2[clear])) / max(dof, 1e-9)
        return found if abs(found - 1) > max(self.rules.scatter_off, 6 * math.sqrt(2 / max(dof, 1e-9))) else 1.0

    def light_off(self, merged: BlockMerge, dropped: Bool[np.ndarray, "n 1"]) -> list[int]:
        """The frame whose light is off most, where it is off by too much in pixels of two samples; or none.

        Where exposures lie far apart, few pixels have a third sample that tells which frame is wrong.
        """
        _, light, mean, variance = self._lit(merged, 2)
        sigma, signal = np.sqrt(variance), mean - float(self.sensor.dark_e_per_s) * self.times[:, None]
        clear = ~dropped & (mean + 5 * sigma < float(self.sensor.level_e)) & (3 * sigma < signal)
        # Hits count as samples at the limit.
        most = self.rules.believed_sigma * sigma
        weight = np.where(clear, signal / variance, 0.0)
        information = np.maximum((weight * signal).sum(axis=1), 1e-30)
        off = np.abs((weight * np.clip(light - mean, -most, most)).sum(axis=1) / information)
        score = np.where(off > self.rules.frame_off, off * np.sqrt(information), 0.0)
        return [int(score.argmax())] if score.max() > self.rules.frame_sigma else []

    def black_off(self, merged: BlockMerge, dropped: Bool[np.ndarray, "n 1"]) -> float:
        """The error of the black level that dark samples show, in electrons; 0 where it is not too much.

        A wrong black level is the same in all exposures, and light is not: this is its weighted mean, light taken out.
        """
        _, light, mean, variance = self._lit(merged, 2, -np.inf)
        times, floor = self.times[:, None].astype(np.float64), float(self.sensor.floor_e2)
        weight = np.where(~dropped & (mean < 30 * floor), 1 / variance, 0.0)
        light_taken = times * (weight * times).sum(axis=0) / np.maximum((weight * times**2).sum(axis=0), 1e-30)
        slope = 1 - light_taken
        information = max(float(np.sum(weight * slope)), 1e-30)
        # Hits count as samples at the limit.
        most = self.rules.believed_sigma * np.sqrt(variance)
        found = float(np.sum(weight * slope * np.clip(light - mean, -most, most))) / information
        limit = max(self.rules.black_off * math.sqrt(floor), 6 / math.sqrt(information), self.rounding_e)
        return found if abs(found) > limit else 0.0

    def mend_hits(self, merged: BlockMerge, dropped: Bool[np.ndarray, "n 1"]) -> Int[np.ndarray, " hits"]:
        """Leave out the worst sample of a pixel while it is too far off; changes ``merged``, returns the pixels."""
        limit, most = self.rules.believed_sigma**2, len(self.times) - self.rules.least_to_judge
        # Samples that are all clipped do not contradict one another.
        hits = suspects = np.flatnonzero((merged.deviation2 > limit) & (merged.used > 0) & (dropped.sum() <= most))
        left_out = np.repeat(dropped, len(suspects), axis=1)
        while len(suspects):
            left_out[merged.worst[suspects], np.arange(len(suspects))] = True
            again = replace(self, codes=np.ascontiguousarray(self.codes[:, suspects])).merged(left_out)
            _put(merged, suspects, again)
            more = (again.deviation2 > limit) & (left_out.sum(axis=0) <= most)
            suspects, left_out = suspects[more], np.ascontiguousarray(left_out[:, more])
        return hits


def _put(out: BlockMerge, where: slice | Int[np.ndarray, " some"], part: BlockMerge) -> None:
    for into, values in zip(jax.tree.leaves(out), jax.tree.leaves(part), strict=True):
        into[where] = values
