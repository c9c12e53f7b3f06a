"""How much worse a picture becomes when frames of one profile's time are restored with the other profile.

A small model of frame and restoration, quick enough for a comparison: a seeded scene with a natural spectrum is blurred
by one profile's kernel and gets its backscatter, wire and noise. It is restored by dividing by the wire, subtracting
the backscatter and Wiener's filter. Every pixel has all colours (no demosaicing), and the scene is periodic. Geometry
is left out: it moves the picture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import final

import numpy as np
from jaxtyping import Complex, Float
from scipy.ndimage import map_coordinates

from udccal.comparison.grid import kernel_places, light_step
from udccal.comparison.maps import DifferenceMaps
from udccal.profiles.profile import Profile
from udccal.restoration.kernel_grid import centred
from udccal.restoration.metrics import encode_srgb

# Side of a tile in px; the scene's mean, spread and darkest place; its power spectrum falls as frequency to this power.
_TILE, _MEAN, _SPREAD, _DARKEST, _POWER = 320, 0.35, 0.2, 0.02, -3.0
# Part of the sensor's range that the scene's white fills; the panel's light is as bright at its peak.
_WHITE = 0.4
_TERMS = ("wire", "psf", "backscatter")


@final
@dataclass(frozen=True)
class PictureLoss:
    """Loss of PSNR in dB where these terms are the other profile's: the larger of both directions."""

    wire: float
    psf: float
    backscatter: float
    together: float


@final
@dataclass(frozen=True)
class _Seen:
    """One profile around one place: transfer of the kernels, the panel's light over the scene's white, and the wire."""

    psf: Complex[np.ndarray, "3 rows half_columns"]
    backscatter: Float[np.ndarray, "3 rows columns"]
    wire: Float[np.ndarray, "rows columns"]


@final
@dataclass(frozen=True)
class _Scene:
    """Linear light with white at 1, as it is shown, its power spectrum, and unit noise with the noise's sigma."""

    light: Float[np.ndarray, "3 rows columns"]
    shown: Float[np.ndarray, "3 rows columns"]
    power: Float[np.ndarray, "rows half_columns"]
    noise: Float[np.ndarray, "3 rows columns"]
    sigma: float

    def frame(self, seen: _Seen) -> Float[np.ndarray, "3 rows columns"]:
        """The scene as a camera takes it."""
        blurred = np.fft.irfft2(np.fft.rfft2(self.light) * seen.psf, s=self.light.shape[1:])
        return (blurred + seen.backscatter) * seen.wire + self.sigma * self.noise

    def error(self, frame: Float[np.ndarray, "3 rows columns"], known: _Seen) -> float:
        """Mean square error of a frame restored as ``known``, in display-encoded values."""
        clean = np.fft.rfft2(frame / known.wire - known.backscatter)
        noise = self.sigma**2 * self.light[0].size
        restored = clean * np.conj(known.psf) / (np.abs(known.psf) ** 2 + noise / self.power)
        off = encode_srgb(np.fft.irfft2(restored, s=self.light.shape[1:])) - self.shown
        return float(np.mean(np.square(off, dtype=np.float64)))


def picture_loss(a: Profile, b: Profile, maps: DifferenceMaps) -> PictureLoss:
    """Return the loss of PSNR of display-encoded values, over the places at which kernels are compared."""
    peak = max(float(np.abs(light).max()) for light in (maps.light_a, maps.light_b)) or 1.0
    seen_a = _seen(a, maps.kernels_a, maps.light_a[-1] / peak)
    seen_b = _seen(b, maps.kernels_b, maps.light_b[-1] / peak)
    pairs = list(zip(seen_a, seen_b, strict=True))
    changed = {t for t in _TERMS if not all(np.array_equal(getattr(one, t), getattr(other, t)) for one, other in pairs)}
    if not changed:
        return PictureLoss(0.0, 0.0, 0.0, 0.0)
    scene = _scene(a, b)
    ways = [
        [(scene.frame(one), one, other) for one, other in zip(*seen, strict=True)]
        for seen in ((seen_a, seen_b), (seen_b, seen_a))
    ]
    own = [float(sum(scene.error(frame, one) for frame, one, _ in way)) for way in ways]

    @cache
    def loss_of(terms: frozenset[str]) -> float:
        mixed = [
            sum(scene.error(frame, replace(one, **{t: getattr(other, t) for t in terms})) for frame, one, other in way)
            for way in ways
        ]
        return max(10 * float(np.log10(max(m, 1e-12) / max(o, 1e-12))) for m, o in zip(mixed, own, strict=True))

    def loss(*terms: str) -> float:
        # Terms that are the same lose nothing.
        return loss_of(frozenset(terms) & changed) if changed.intersection(terms) else 0.0

    return PictureLoss(loss("wire"), loss("psf"), loss("backscatter"), loss(*_TERMS))


def _scene(a: Profile, b: Profile) -> _Scene:
    """A scene and the noise of an average sensor of both profiles."""
    rng, shape = np.random.default_rng(0), (_TILE, _TILE)
    frequency = np.hypot(np.fft.fftfreq(_TILE)[:, None], np.fft.rfftfreq(_TILE))
    frequency[0, 0] = 1 / _TILE
    smooth = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(3, *shape))) * frequency ** (_POWER / 2), s=shape)
    # Colours agree for the most part.
    smooth = smooth.mean(axis=0) + 0.3 * smooth
    light = np.clip(_MEAN + _SPREAD * (smooth - smooth.mean()) / smooth.std(), _DARKEST, 1.0)
    power = frequency**_POWER
    power *= np.mean(np.abs(np.fft.rfft2(light - _MEAN)) ** 2) / power.mean()
    terms = [profile.noise.term for profile in (a, b)]
    range_e, dark_e = np.mean(
        [[float((n.saturation_DN - n.black_DN) / n.K_DN_per_e), float(n.sigma_d_e)] for n in terms], axis=0
    )
    white_e = float(np.maximum(_WHITE * range_e, 1.0))
    sigma = float(np.sqrt(_MEAN * white_e + dark_e**2) / white_e)
    return _Scene(light, encode_srgb(light), power, rng.normal(size=light.shape), sigma)


def _seen(
    profile: Profile,
    kernels: Float[np.ndarray, "places 3 ky kx"],
    light: Float[np.ndarray, "3 grid_rows grid_columns"],
) -> list[_Seen]:
    """What the profile says around each place: beyond the sensor's edge the same as at the edge."""
    step, span = light_step(profile.rig), np.arange(_TILE) - _TILE // 2
    found = []
    for (x, y), kernel in zip(kernel_places(profile.rig), kernels, strict=True):
        down, across = (np.clip(int(p) + span, 0, n - 1) for p, n in zip((y, x), profile.wire_map.shape, strict=True))
        at = np.meshgrid((down + 0.5) / step - 0.5, (across + 0.5) / step - 0.5, indexing="ij")
        found.append(
            _Seen(
                psf=np.fft.rfft2(np.stack([centred(one, _TILE, _TILE) for one in kernel])),
                backscatter=np.stack([map_coordinates(one, at, order=1, mode="nearest") for one in light]),
                wire=profile.wire_map[np.ix_(down, across)].astype(np.float64),
            )
        )
    return found
