"""Noise: EMVA 1288's linear camera model with the extra terms of the ELD model (Tukey-lambda read noise, row noise)."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from udccal.models.arrays import Arrayish


class Noise(eqx.Module):
    """Noise parameters of the sensor under their EMVA 1288 and ELD names.

    ``sigma_d_e`` is the temporal dark noise of one frame at zero exposure. It includes row noise but not quantisation.
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


def electrons(noise: Noise, signal_DN: Float[Arrayish, "*n"]) -> Float[Array, "*n"]:
    """Return the linear signal in e-: (DN - black) / K."""
    return (jnp.asarray(signal_DN) - noise.black_DN) / noise.K_DN_per_e


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
