"""Exposure brackets to one linear picture: maximum likelihood with the sensor's noise model."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import final

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt16
from scipy.special import ndtr

from udccal.arguments import array_of, check_optional, check_unmasked, found_instead
from udccal.errors import FitError
from udccal.fitting.engine.robust import outliers
from udccal.fitting.hdr.likelihood import (
    BlockMerge,
    HdrRules,
    Residuals,
    SensorNumbers,
    compiled_merge_block,
    merge_block,
)
from udccal.models.noise import Noise
from udccal.result import FitStatus, Outliers

# Pixels whose samples are judged, about.
_JUDGED = 20_000
# Sigma where no sample could be used: finite, and larger than any rate that a sensor can measure.
UNKNOWN_SIGMA = 1e12
# Pixels of a picture that is worth compiling for, and of one compiled pass, which stays in the processor's cache.
_LEAST_COMPILED, _BLOCK = 1 << 16, 1 << 14


@final
@dataclass(frozen=True)
class HdrMerge:
    """A picture of one still scene, from a bracket.

    Attributes:
        rate_e_per_s, sigma_e_per_s: light of every pixel, with one standard deviation.
        used: number of samples used for each pixel; where it is 0 the rate is 0 and sigma ``UNKNOWN_SIGMA``.
        outliers: frames and samples that were left out.
        rounded_below: light in e-/s below which rounding to codes moves samples alike, so that they do not average out:
            some codes of the longest exposure where dark noise is far below a code, else 0.
        status, notes: SATURATED where no pixel has a sample that could be used, POOR_FIT where samples of a pixel
            scatter unlike the noise model says, so that rate and sigma are not to be trusted; sentences for a person.
    """

    rate_e_per_s: Float[np.ndarray, "*picture"]
    sigma_e_per_s: Float[np.ndarray, "*picture"]
    used: Int[np.ndarray, "*picture"]
    outliers: tuple[Outliers, ...] = ()
    rounded_below: float = 0.0
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
        FitError: when frames are not codes or have no pixels, exposures are impossible or not as many as frames, or a
            number of the noise is impossible.
    """
    check_optional(rules, HdrRules, FitError)
    rules = rules or HdrRules()
    times = _checked(frames, exposures_s)
    # Times in units of the longest: sums of their squares stay in single precision's range.
    unit, shape = float(times.max()), frames.shape[1:]
    codes = np.ascontiguousarray(frames).reshape(len(frames), -1)
    sensor, dropped = SensorNumbers.of(noise, unit, rules), np.zeros((len(frames), 1), bool)
    bracket = _Bracket(codes, (times / unit).astype(np.float32), sensor, rules, dropped)
    merged, unlike = bracket.merged(), np.zeros(0, int)
    while (bad := bracket.frames_off(merged)).size:
        bracket, unlike = bracket.without(int(bad[0])), bad if len(bad) > 1 else unlike
        merged = bracket.merged()
    hits = bracket.mend_hits(merged)
    doubts = list(bracket.doubts(merged, unlike))
    remarks = doubts or list(bracket.unsteady(merged))
    # In place: copies of a full frame would cost as much as a third of the merging.
    for values in (merged.rate, merged.sigma):
        values /= np.float32(unit)
    unknown = merged.used == 0
    merged.rate[unknown], merged.sigma[unknown] = 0.0, UNKNOWN_SIGMA
    notes = [f"{unknown.sum()} of {unknown.size} pixels have no sample that could be used."] if unknown.any() else []
    notes += remarks
    rounded_below = float(sensor.rounded_below_e) / float(times[~bracket.dropped[:, 0]].max())
    if rounded_below > 0:
        notes.append("Dark noise is far below a code: rounding moves dark pixels by up to half a code. Raise the gain.")
    off = f"frames whose light is off by more than {100 * rules.frame_off:g} % and {rules.frame_sigma:g} sigma"
    hit = f"pixels with a sample more than {rules.believed_sigma:g} sigma from what its other samples say; that sample"
    places = (str(tuple(int(k) for k in np.unravel_index(pixel, shape))) for pixel in hits)
    frames_out = (f"frame {i}" for i in np.flatnonzero(bracket.dropped))
    listed = outliers(off, frames_out) + outliers(f"{hit} is left out", places)
    status = FitStatus.POOR_FIT if doubts else FitStatus.CONVERGED
    status = FitStatus.SATURATED if unknown.size and unknown.all() else status
    rate, sigma, used = (part.reshape(shape) for part in (merged.rate, merged.sigma, merged.used))
    return HdrMerge(rate, sigma, used, listed, rounded_below, status, tuple(notes))


def _checked(frames: object, exposures_s: object) -> Float[np.ndarray, " exposures"]:
    """The exposures, where frames and exposures are what they should be."""
    check_unmasked(frames, "frames", FitError)
    check_unmasked(exposures_s, "exposures", FitError)
    if not isinstance(frames, np.ndarray) or frames.dtype.kind not in "ui" or frames.ndim < 2:
        expected = "Expected frames as an array of whole codes, frame by frame"
        raise FitError(f"{expected}, found {found_instead(frames)}. Pass raw codes.")
    if len(frames) and not frames.size:
        raise FitError(f"Expected frames with pixels, found the shape {frames.shape}. Pass whole frames.")
    given = array_of(exposures_s)
    times = given.astype(np.float64) if given.dtype.kind in "iuf" else np.zeros(0)
    # Single precision holds the rates of these exposures.
    if times.shape != (len(frames),) or not len(times) or not np.all((times >= 1e-9) & (times <= 1e6)):
        expected = f"Expected a positive exposure (1e-9 to 1e6 s) for each of the {len(frames)} frames of a bracket"
        raise FitError(f"{expected}, found {np.atleast_1d(times)[:8].tolist()}. Give the exposures in seconds.")
    return times


@final
@dataclass(frozen=True)
class _Bracket:
    """Frames with their times, less the samples or frames that are ``dropped``."""

    codes: UInt16[np.ndarray, "n pixels"]
    times: Float[np.ndarray, " n"]
    sensor: SensorNumbers
    rules: HdrRules
    dropped: Bool[np.ndarray, "n #pixels"]

    def without(self, frame: int) -> _Bracket:
        """The bracket less one more frame."""
        return replace(self, dropped=self.dropped | (np.arange(len(self.times)) == frame)[:, None])

    def part(self, pixels: slice | Int[np.ndarray, " some"]) -> _Bracket:
        """Some of the pixels."""
        return replace(self, codes=np.ascontiguousarray(self.codes[:, pixels]))

    def merged(self) -> BlockMerge:
        """The light of all pixels."""
        pixels, dropped = self.codes.shape[1], np.broadcast_to(self.dropped, self.codes.shape)

        def of(part: slice, merge: Callable[..., BlockMerge] = merge_block) -> BlockMerge:
            return merge(self.codes[:, part], self.times, self.sensor, dropped[:, part], self.rules.believed_sigma)

        if pixels < _LEAST_COMPILED:
            return of(np.s_[:])
        out = BlockMerge(*(np.empty(pixels, kind) for kind in ("f4", "f4", "i4", "i4", "f4")))
        # The last block overlaps the one before it, so that all have one size.
        parts = [np.s_[one : one + _BLOCK] for one in (*range(0, pixels - _BLOCK, _BLOCK), pixels - _BLOCK)]
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(lambda part: _put(out, part, of(part, compiled_merge_block)), parts))
        return out

    def frames_off(self, merged: BlockMerge) -> Int[np.ndarray, " off"]:
        """Frames without any one of which the others agree, the best first; none where all agree."""
        least, most = self.rules.least_to_judge, self.rules.frame_sigma
        if not self._frame_scores(merged, least, 10.0).max() > most:
            return np.zeros(0, int)
        # The frame of most light sets the merged light: where it is wrong, the others are off. Each is left out once.
        part, left = self.part(np.s_[:: max(1, self.codes.shape[1] // _JUDGED)]), np.full(len(self.times), np.inf)
        for i in np.flatnonzero(~self.dropped).tolist():
            rest = part.without(i)
            left[i] = rest._frame_scores(rest.merged(), least - 1, 10.0).max()
        return np.argsort(left)[: max(1, int(np.sum(left <= most)))]

    def _samples(self, merged: BlockMerge, least: int, least_rate: float = 0.0, most: int = _JUDGED) -> Residuals:
        """Of some pixels, about ``most``, with more than ``least_rate`` and at least so many samples."""
        sensor, pixels = self.sensor, np.flatnonzero((merged.used >= least) & (merged.rate > least_rate))
        pixels = pixels[:: max(1, len(pixels) // max(min(most, _JUDGED), 1))]
        light = np.asarray(sensor.electrons(self.codes[:, pixels].astype(np.float64)))
        times = self.times[:, None].astype(np.float64)
        signal = merged.rate[pixels] * times
        mean = signal + sensor.dark_e_per_s * times
        variance = np.maximum(mean, 0.0) + sensor.floor_e2
        weight = np.where(~self.dropped & (light < sensor.level_e), 1 / variance, 0.0)
        clear = ~self.dropped & (mean + 5 * np.sqrt(variance) < sensor.level_e)
        return Residuals(times, light - mean, mean, signal, variance, weight, clear)

    def _frames_light(
        self, merged: BlockMerge, least: int, bright: float
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """How far each frame's light is off that of all, of itself, with its sigma; 0 and infinite where unknown.

        It is seen in samples of ``bright`` sigma and more, of pixels with at least so many samples.
        """
        seen, off, sigma = self._samples(merged, least), np.zeros(len(self.times)), np.full(len(self.times), np.inf)
        used = seen.bright(bright)
        for i in np.flatnonzero(used.sum(axis=1) >= 8):
            frame = np.eye(len(off))[i, None, :, None] * seen.signal
            (off[i],), (sigma[i],) = seen.amounts(frame, seen.weight, used, self.rules.believed_sigma)
        return off, sigma

    def _frame_scores(self, merged: BlockMerge, least: int, bright: float) -> Float[np.ndarray, " n"]:
        """The same in sigma; 0 where it is little."""
        return self._in_sigma(*self._frames_light(merged, least, bright))

    def _in_sigma(self, off: Float[np.ndarray, " n"], sigma: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return np.where(np.abs(off) > self.rules.frame_off, np.abs(off) / sigma, 0.0)

    def _bend(self, merged: BlockMerge) -> float:
        """Part of the signal that is missing at saturation, whatever the light of each frame; 0 where it is little."""
        count = len(self.times)
        seen = self._samples(merged, 2, most=2_000_000 // count**2)
        bent = -(seen.signal**2) / float(self.sensor.level_e)
        causes = np.concatenate([np.eye(count)[:, :, None] * seen.signal, bent[None]])
        off, sigma = seen.amounts(causes, seen.weight, seen.bright(3.0), self.rules.believed_sigma)
        # The light of few electrons hardly tells it, and is itself too uncertain.
        known = 2 * sigma[-1] < self.rules.bend_off
        most = max(self.rules.bend_off, self.rules.frame_sigma * sigma[-1])
        return float(off[-1]) if known and abs(off[-1]) > most else 0.0

    def unsteady(self, merged: BlockMerge) -> Iterator[str]:
        """A sentence for light that differs between frames by too little to leave one out."""
        off, sigma = self._frames_light(merged, 2, 3.0)
        worst = int(np.argmax(np.abs(off) / sigma))
        least = self.rules.light_off * float(self.sensor.level_e) ** -0.5
        if abs(off[worst]) > max(least, self.rules.frame_sigma * sigma[worst]):
            yield (
                f"The light of frame {worst} differs by {100 * off[worst]:+.2g} % from that of the others: rates may "
                "be off by as much, which their sigma does not include."
            )

    def mend_hits(self, merged: BlockMerge) -> Int[np.ndarray, " hits"]:
        """Leave out the worst sample of a pixel while it is too far off; changes ``merged``, returns the pixels."""
        limit, most = self.rules.believed_sigma**2, len(self.times) - self.rules.least_to_judge
        # Samples that are all clipped do not contradict one another.
        hits = suspects = np.flatnonzero((merged.deviation2 > limit) & (merged.used > 0) & (self.dropped.sum() <= most))
        left_out = np.repeat(self.dropped, len(suspects), axis=1)
        while len(suspects):
            left_out[merged.worst[suspects], np.arange(len(suspects))] = True
            again = replace(self.part(suspects), dropped=left_out).merged()
            _put(merged, suspects, again)
            more = (again.deviation2 > limit) & (left_out.sum(axis=0) <= most)
            suspects, left_out = suspects[more], np.ascontiguousarray(left_out[:, more])
        return hits

    def doubts(self, merged: BlockMerge, unlike: Int[np.ndarray, " off"]) -> Iterator[str]:
        """Sentences for samples that contradict the noise model, or one another."""
        if (stuck := self._stuck()).size:
            yield (
                f"All pixels of frame {stuck[0]} have the code {self.codes[stuck[0], 0]}, where noise is expected: "
                f"the stream is stuck ({stuck.size} of {len(self.times)} frames). Check the camera; capture anew."
            )
        scatter, black_DN = self._scatter(merged), self._black_off(merged) / self.sensor.e_per_DN
        # Where exposures lie far apart, few pixels have a third sample that tells which frame is wrong.
        off, sigma = self._frames_light(merged, 2, 3.0)
        scores = self._in_sigma(off, sigma)
        differs = scores.max() > self.rules.frame_sigma * max(scatter, 1.0) ** 0.5 and not black_DN
        if scatter != 1 and not differs:
            yield (
                f"Samples scatter about a pixel's light with {scatter:.2f} times the variance of the noise model. "
                "Check K, black level and exposure times; rate and sigma are not to be trusted."
            )
        if black_DN:
            yield (
                f"Dark samples of all exposures lie {black_DN:+.2g} DN off the black level. Fit the noise with frames "
                "of this gain and temperature; the light of dark pixels is not to be trusted."
            )
        advice = "Check their exposure times, or take exposures that lie closer together."
        lost = np.flatnonzero(self.dropped.all(axis=1))
        if len(lost) > 1 and 2 * len(lost) > len(self.times) - len(lost):
            frames = f"frames {', '.join(map(str, lost))} of {len(self.times)}"
            yield f"The light of {frames} differs, and few that agree are left. Check light, scene, times, black."
        elif not black_DN and (bend := self._bend(merged)):
            yield (
                f"Light near saturation is off by {-100 * bend:+.2g} % of that in shorter exposures: the response "
                "bends otherwise than the noise model's. Fit the noise with frames of this sensor."
            )
        if scatter == 1 and not black_DN and not differs:
            for i in self._alone(np.isinf(sigma)):
                yield f"The light of frame {i} differs from that of the others. {advice}"
        if unlike.size:
            frames = f"frames {' and '.join(map(str, unlike))} differs, and no other frame tells which one is right"
            yield f"The light of {frames}: frame {unlike[0]} is left out. {advice}"
        elif differs:
            few = "too few pixels have a third sample that tells which one is right"
            yield f"The light of frame {scores.argmax()} differs from that of the frames beside it, and {few}. {advice}"

    def _alone(self, unjudged: Bool[np.ndarray, " n"]) -> Iterator[int]:
        """Those of the frames with too few samples clear of clipping to be judged that are not what the others say.

        Clipped or not, a sample is compared to the mean of a normal one that may clip.
        """
        part, level = self.part(np.s_[:: max(1, self.codes.shape[1] // _JUDGED)]), float(self.sensor.level_e)
        unjudged = unjudged & ~self.dropped.all(axis=1) & bool(self.dropped.sum() + 1 < len(self.times))
        for i in np.flatnonzero(unjudged).tolist():
            rest, time = part.without(i).merged(), float(self.times[i])
            known = np.flatnonzero(rest.used)
            mean = (rest.rate[known].astype(np.float64) + float(self.sensor.dark_e_per_s)) * time
            variance = np.maximum(mean, 0.0) + float(self.sensor.floor_e2) + (rest.sigma[known] * time) ** 2
            sigma, codes = np.sqrt(variance), part.codes[i : i + 1, known].astype(np.float64)
            light = np.asarray(self.sensor.electrons(codes))[0]
            room = (level - mean) / sigma
            below, density = ndtr(room), np.exp(-0.5 * room**2) / math.sqrt(2 * math.pi)
            expected = mean * below - sigma * density + level * (1 - below)
            square = (mean**2 + variance) * below - sigma * (level + mean) * density + level**2 * (1 - below)
            spread = np.sqrt(np.maximum(square - expected**2, 0.0))
            off = np.clip(np.minimum(light, level) - expected, -(most := self.rules.believed_sigma * spread), most)
            # Others clip whatever their light is.
            free = (room > -5) | (light < level)
            least = self.rules.frame_off * float(np.abs(expected[free]).sum())
            if abs(float(off[free].sum())) > max(least, self.rules.frame_sigma * float(np.linalg.norm(spread[free]))):
                yield i

    def _stuck(self) -> Int[np.ndarray, " stuck"]:
        """Open frames that have one code at all pixels, where noise of some codes makes that impossible."""
        codes = self.codes[:, :: max(1, self.codes.shape[1] // _JUDGED)]
        first = codes[:, :1].astype(np.float64)
        # Code 0 cuts off the noise about a black level below it.
        free = (self.sensor.electrons(first) < self.sensor.level_e) & ((first > 0) | (self.sensor.black_DN > 0))
        judged = codes.shape[1] >= self.rules.least_even and self.sensor.rounded_below_e == 0
        return np.flatnonzero((codes == first).all(axis=1) & (free & ~self.dropped)[:, 0] & bool(judged))

    def _scatter(self, merged: BlockMerge) -> float:
        """Variance of samples about their pixel's light over the model's; 1 where that is what chance gives."""
        seen = self._samples(merged, 2)
        # Clear of pixels whose light is known badly: that the variance is that of the light as merged, and not as it
        # is, changes nothing then.
        known = 1 / np.maximum((seen.weight * seen.times**2).sum(axis=0), 1e-30)
        clear = seen.clear & (seen.signal**2 > self.rules.sure_electrons * known * seen.times**2)
        # Samples that rounding moves alike, or that code 0 cuts off, scatter less.
        zero_e = self.sensor.electrons(np.zeros((1, 1)))
        clear &= (seen.mean >= self.sensor.rounded_below_e) & (seen.mean - 5 * np.sqrt(seen.variance) > zero_e)
        # Hits in pixels of two samples are not found: a few of them must not count much.
        chi2 = np.minimum(seen.errors**2 / seen.variance, 4.0**2)
        # A pixel's offset moves its samples by what its light does not follow.
        offset = self.sensor.offset_e * seen.left(np.ones_like(seen.mean), seen.weight)
        expected = 1 - np.minimum(known * seen.times**2 / seen.variance, 1) + offset**2 / seen.variance
        dof = max(float(np.sum(expected[clear])), 1e-9)
        found = float(np.sum(chi2[clear])) / dof
        # Hits that are not found add to the scatter, and nothing but a wrong noise model takes from it.
        sigmas = 6.0 if found > 1 else 3.5
        return found if abs(found - 1) > max(self.rules.scatter_off, sigmas * math.sqrt(2 / dof)) else 1.0

    def _black_off(self, merged: BlockMerge) -> float:
        """The error of the black level, which is the same in all exposures, in electrons; 0 where it is small."""
        seen, floor = self._samples(merged, 2, -np.inf), float(self.sensor.floor_e2)
        dark = seen.clear & (seen.mean < 30 * floor)
        # Light whose brighter samples are off themselves must not count.
        offset = np.ones((1, *seen.mean.shape))
        (found,), (sigma,) = seen.amounts(offset, dark / seen.variance, dark, self.rules.believed_sigma)
        least = max(self.rules.black_off * floor**0.5, 6 * sigma, self.sensor.rounding_e)
        return float(found) if abs(found) > least else 0.0


def _put(out: BlockMerge, where: slice | Int[np.ndarray, " some"], part: BlockMerge) -> None:
    for into, values in zip(jax.tree.leaves(out), jax.tree.leaves(part), strict=True):
        into[where] = values
