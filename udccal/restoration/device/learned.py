"""What the tier ``accurate`` adds on a device: the network of ``network``, and what samples say against its picture."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from udccal.restoration.blur import kernel_weights
from udccal.restoration.device.bands import between, halved
from udccal.restoration.device.planes import box_mean
from udccal.restoration.kernel_grid import KernelGrid, interpolated_kernels
from udccal.restoration.network import CELL_PX, DETAIL_PX, REACH_PX, WAYS, Weights, correction, network_weights
from udccal.restoration.tiles import TileLayout

Planes = Float[Array, "3 rows columns"]


class Learned(eqx.Module):
    """The network's weights, and the kernels of the tiles.

    Attributes:
        weights: of the network. kernels: of each tile, of odd size. layout: of the tiles.
        views: ways round in which the network sees a picture.
    """

    weights: Weights
    kernels: Float[Array, "tiles 3 ky kx"]
    layout: TileLayout = eqx.field(static=True)
    views: int = eqx.field(static=True)

    @classmethod
    def of(cls, grid: KernelGrid, layout: TileLayout, views: int) -> Learned:
        """Read the network, and interpolate the kernels."""
        return cls(network_weights(), jnp.asarray(interpolated_kernels(grid, layout.centres_px)), layout, views)

    def refined(
        self,
        balanced: Planes,
        chosen: Planes,
        sharp: Planes,
        noise_e: Float[Array, "tiles 3"],
        local_e2: Float[Array, "rows columns"],
        variance: Float[Array, "tiles 3 levels bands"],
    ) -> Planes:
        """Return the picture of the tier ``balanced`` with what the network adds, as ``network.refined`` does."""
        scale = between(self.layout, noise_e)
        first = balanced / scale
        first -= box_mean(first, DETAIL_PX[0])
        detail = jnp.concatenate([first, (chosen - balanced) / scale, (sharp - chosen) / scale])
        brightness = local_e2 / between(self.layout, jnp.mean(noise_e**2, axis=1, keepdims=True))[0]
        sigma = between(self.layout, jnp.sqrt(variance[:, 0].reshape(len(variance), -1)), step=2)
        noise = sigma * jnp.sqrt(halved(brightness))
        whole = [(REACH_PX, REACH_PX + -size % CELL_PX) for size in balanced.shape[1:]]
        half = [
            (before // 2, (before + size + after) // 2 - before // 2 - of_half)
            for (before, after), size, of_half in zip(whole, balanced.shape[1:], noise.shape[1:], strict=True)
        ]
        shown = (jnp.pad(detail, ((0, 0), *whole), mode="symmetric"), jnp.pad(noise, ((0, 0), *half), mode="edge"))
        ways = WAYS[: self.views]
        found = correction(
            self.weights, *(jnp.stack([jnp.moveaxis(each, 0, -1)[::y, ::x] for y, x in ways]) for each in shown)
        )
        mean = sum(one[::y, ::x] for one, (y, x) in zip(found, ways, strict=True)) / len(ways)
        inner = tuple(slice(REACH_PX, REACH_PX + size) for size in balanced.shape[1:])
        return balanced + jnp.moveaxis(mean[inner], -1, 0) * scale

    def blurred(self, picture: Planes) -> Planes:
        """Blur a sharp picture as ``blur.blurred`` does."""
        layout, reach = self.layout, tuple(size // 2 for size in self.kernels.shape[2:])
        starts, hats = zip(
            *(_padded(kernel_weights(*each)) for each in zip(layout.strips, layout.covered, reach, strict=True)),
            strict=True,
        )
        wide = jnp.pad(picture, ((0, 0), *((by, by) for by in reach)), mode="symmetric")
        part = tuple(each.shape[1] for each in hats)
        size = tuple(of + 2 * by for of, by in zip(part, reach, strict=True))
        # The last parts may reach beyond the picture, where their weights are 0.
        room = tuple(2 * by + of for by, of in zip(reach, part, strict=True))
        wide = jnp.pad(wide, ((0, 0), *((0, more) for more in room)))
        tops, lefts = (each.ravel() for each in np.meshgrid(*starts, indexing="ij"))
        row, column = (each.ravel() for each in np.indices((len(layout.tops), len(layout.lefts))))

        def add(result: Planes, tile: tuple[Array, ...]) -> tuple[Planes, None]:
            top, left, down, across, kernel = tile
            own = jax.lax.dynamic_slice(wide, (0, top, left), (3, *part)) * (down[:, None] * across)
            spectrum = jnp.fft.rfft2(own, s=size) * jnp.fft.rfft2(kernel, s=size)
            reached = jax.lax.dynamic_slice(result, (0, top, left), (3, *size))
            return jax.lax.dynamic_update_slice(
                result, reached + jnp.fft.irfft2(spectrum, s=size), (0, top, left)
            ), None

        tiles = (
            jnp.asarray(tops),
            jnp.asarray(lefts),
            jnp.asarray(hats[0])[row],
            jnp.asarray(hats[1])[column],
            self.kernels,
        )
        result, _ = jax.lax.scan(add, jnp.zeros_like(jnp.pad(wide, ((0, 0), *((0, 2 * by) for by in reach)))), tiles)
        return result[:, *(slice(2 * by, 2 * by + of) for by, of in zip(reach, picture.shape[1:], strict=True))]


def _padded(
    weights: list[tuple[slice, Float[np.ndarray, " _"]]],
) -> tuple[Int[np.ndarray, " tiles"], Float[np.ndarray, "tiles samples"]]:
    """Return where each tile's part begins, and its weights with zeros behind up to the longest."""
    most = max(len(hat) for _, hat in weights)
    return (
        np.array([at.start for at, _ in weights]),
        np.stack([np.pad(hat, (0, most - len(hat))) for _, hat in weights]).astype(np.float32),
    )
