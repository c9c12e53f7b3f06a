"""Noise: EMVA 1288's camera model, a response that may bend, and Tukey-lambda read noise and row noise as in ELD."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Float32

from udccal.models.arrays import Arrayish


class Noise(eqx.Module):
    """Noise parameters of the sensor under their EMVA 1288 and ELD names.

    ``sigma_d_e`` is the temporal dark noise of one frame at zero exposure. It includes row noise but not quantisation.
    ``nonlinearity`` is the fraction of the signal that is missing at saturation; K is that of small signals.
    """

    K_DN_per_e: Float[Arrayish, ""]
    black_DN: Float[Arrayish, ""]
    saturation_DN: Float[Arrayish, ""]
    sigma_d_e: Float[Arrayish, ""]
    lambda_read: Float[Arrayish, ""]
    sigma_row_DN: Float[Arrayish, ""]
    q_DN: Float[Arrayish, ""]
    dark_current_e_per_s: Float[Arrayish, ""]
    DSNU1288_e: Float[Arrayish, ""]
    PRNU1288: Float[Arrayish, ""]
    nonlinearity: Float[Arrayish, ""] = 0.0

    @property
    def bend_per_DN(self) -> Float[Arrayish, ""]:
        """What the response lacks at a linear signal z, over z^2."""
        return self.nonlinearity / (self.saturation_DN - self.black_DN)


def linear_signal(mean_DN, bend_per_DN, K_DN_per_e=0.0):  # type: ignore[no-untyped-def]
    """Return the linear signal z above black of a response y = z - bend (z^2 + K z), in DN.

    K z is the variance of shot noise, for means of many frames; a single sample has none. Arguments and result are
    numpy or JAX arrays. Beyond the parabola's top, which lies beyond saturation, values are finite.
    """
    slope = 1 - bend_per_DN * K_DN_per_e
    # The root that goes to y / slope for a bend of 0, in the form without cancellation.
    return 2 * mean_DN / (slope + abs(slope**2 - 4 * bend_per_DN * mean_DN) ** 0.5)


def electrons(noise: Noise, signal_DN: Float[Arrayish, "*n"]) -> Float[Array, "*n"]:
    """Return the linear signal in e-: DN above black, without the response's bend, over K."""
    return jnp.asarray(linear_signal(jnp.asarray(signal_DN) - noise.black_DN, noise.bend_per_DN) / noise.K_DN_per_e)


def scalar(value: ArrayLike) -> float:
    """Return a term's parameter, a number or an array without dimensions, as a float."""
    return float(np.asarray(value))


def dark_DN(noise: Noise, exposure_s: float) -> float:
    """Return what a sample reads without light: black level and mean dark signal."""
    dark_e = scalar(noise.dark_current_e_per_s) * float(exposure_s)  # an exposure may be a number of numpy's
    return scalar(noise.black_DN) + scalar(noise.K_DN_per_e) * dark_e


def coarse_dark(
    noise: Noise, mean_DN: Float32[np.ndarray, "*n"], variance_DN2: Float32[np.ndarray, "*n"], exposure_s: float
) -> Float32[np.ndarray, "*n"] | None:
    """Return the dark signal in DN by the noise term, where codes are too coarse or cut off for their mean; else None.

    The mean of rounded codes is off by up to half a code where noise does not spread them: by 0.002 codes at a noise
    of half a code, and 0.05 at 0.3 (Widrow and Kollar, Quantization Noise, 2008). Defects beyond a code keep their own.

    Args:
        noise: the noise term.
        mean_DN, variance_DN2: of dark frames, pixel by pixel; the variance is that of one frame.
        exposure_s: exposure time.
    """
    level, q = dark_DN(noise, exposure_s), scalar(noise.q_DN)
    usual, seen2 = float(np.median(mean_DN)), float(np.median(variance_DN2))
    # Half a code squared, and the variance of rounding.
    resolved = seen2 >= (1 / 4 + 1 / 12) * q**2 and level >= 3 * seen2**0.5
    # A term of another camera, or of the rig's description, has another black.
    if resolved or abs(level - usual) > q + seen2**0.5:
        return None
    return np.where(np.abs(mean_DN - usual) > q, mean_DN, np.float32(level))


# One compilation instead of one per operation.
@jax.jit
def variance_e(noise: Noise, signal_e: Float[Arrayish, "*n"], exposure_s: Float[Arrayish, ""]) -> Float[Array, "*n"]:
    """Return the temporal variance of samples in e-^2.

    EMVA 1288, equation of the photon transfer curve: shot + dark current + sigma_d^2 + quantisation.

    Args:
        noise: the noise term.
        signal_e: mean signal in e-, dark signal excluded.
        exposure_s: exposure time.
    """
    quantisation = (noise.q_DN / noise.K_DN_per_e) ** 2 / 12.0
    shot = jnp.maximum(jnp.asarray(signal_e), 0.0)
    dark = noise.dark_current_e_per_s * exposure_s
    return shot + dark + jnp.asarray(noise.sigma_d_e) ** 2 + quantisation
