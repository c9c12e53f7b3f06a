"""The network of the tier ``accurate`` in PyTorch, for training: a core with bfloat16 matrices takes four times less.

Restoration has it in JAX (``udccal.restoration.network.correction``), by which each report of a training judges.
"""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from udccal.restoration.network import BLOCKS, Weights, shapes

# JAX has rows, columns, in, out; PyTorch has out, in, rows, columns.
_TO_TORCH, _FROM_TORCH = (3, 2, 0, 1), (2, 3, 1, 0)


class Network(nn.Module):
    """The network with weights that can be trained."""

    def __init__(self, rng: np.random.Generator, start: Mapping[str, np.ndarray] | None = None) -> None:
        """Draw weights; with ``start``, of a network of this size or a smaller one, it begins as that one."""
        super().__init__()
        drawn = {}
        for name, shape in shapes().items():
            # He's spread; it begins without a correction, and residual blocks begin small.
            spread = np.sqrt(2 / np.prod(shape[:3])) * (0.0 if name == "out" else 0.2 if name.endswith("b") else 1.0)
            kernel = spread * rng.standard_normal(shape)
            if start is not None and name in start:
                _embed(start[name], kernel, 4 if name == "up" else 1)
            elif start is not None and name.endswith("b"):
                kernel *= 0.0
            tensor = torch.as_tensor(kernel.transpose(_TO_TORCH), dtype=torch.float32)
            drawn[name] = nn.Parameter(tensor.contiguous(memory_format=torch.channels_last))
        self.kernels = nn.ParameterDict(drawn)

    def forward(self, detail: Tensor, noise: Tensor) -> Tensor:
        """Return what is to be added, for planes in the order examples, channels, rows, columns."""
        first = self._convolved(torch.cat([_apart(detail), noise], dim=1), "in")
        fine = self._block(first, "fine0")
        coarse = functional.conv2d(fine, self.kernels["down"], stride=2)
        for block in range(BLOCKS["coarse"]):
            coarse = self._block(coarse, f"coarse{block}")
        fine = fine + _together(functional.conv2d(coarse, self.kernels["up"]))
        for block in range(1, BLOCKS["fine"]):
            fine = self._block(fine, f"fine{block}")
        return _together(self._convolved(functional.relu(fine), "out"))

    def _block(self, planes: Tensor, name: str) -> Tensor:
        inner = functional.relu(self._convolved(functional.relu(planes), f"{name}a"))
        return planes + self._convolved(inner, f"{name}b")

    def _convolved(self, planes: Tensor, name: str) -> Tensor:
        return functional.conv2d(planes, self.kernels[name], padding=1)


def to_weights(network: nn.Module) -> Weights:
    """Return a network's weights as restoration has them."""
    kernels = {name.split(".")[-1]: value for name, value in network.state_dict().items()}
    return {name: jnp.asarray(kernels[name].numpy().transpose(_FROM_TORCH)) for name in shapes()}


def _embed(smaller: np.ndarray, kernel: np.ndarray, places: int) -> None:
    """Give a kernel the outputs of a smaller one, in place; its further inputs do not matter to these yet."""
    (inputs, outputs), old = smaller.shape[2:], smaller.reshape(*smaller.shape[:3], places, -1)
    new = kernel.reshape(*kernel.shape[:3], places, -1)
    new[..., : outputs // places] = 0.0
    new[:, :, :inputs, :, : outputs // places] = old


def _apart(planes: Tensor) -> Tensor:
    """Return the 2 x 2 places of a picture as channels, places first, as in JAX."""
    n, c, y, x = planes.shape
    return planes.reshape(n, c, y // 2, 2, x // 2, 2).permute(0, 3, 5, 1, 2, 4).reshape(n, 4 * c, y // 2, x // 2)


def _together(planes: Tensor) -> Tensor:
    n, c, y, x = planes.shape
    return planes.reshape(n, 2, 2, c // 4, y, x).permute(0, 3, 4, 1, 5, 2).reshape(n, c // 4, 2 * y, 2 * x)
