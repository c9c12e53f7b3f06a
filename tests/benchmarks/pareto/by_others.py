"""Frames deblurred by a library that udccal does not depend on. It runs in the library's own environment.

    python by_others.py regularizepsf|deepinv IN.npz OUT.npz

IN has ``pictures`` (frame, row, column, colour; from 0 to 1) and the grid of kernels: ``x_px``, ``y_px``, ``kernels``.
OUT has ``restored`` (strength, frame, row, column, colour) and ``seconds`` (strength, frame). What depends on the
kernels alone is prepared before the clock starts. Nothing but numpy and the library is imported.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator

import numpy as np

# For regularizepsf: side of a patch; patches per side; exponents and thresholds of its transfer.
_PATCH, _RATE, _ALPHAS, _EPSILONS = 256, 4, (2.0, 3.0), (0.03, 0.1, 0.3)
# It multiplies by sin^2 before and after. The sum over patches is even at this rate, and 1.5 along each axis.
_PATCH_SUM = 1.5**2
# For deepinv: components of the blur, weight of the total variation, ADMM's steps, and those of its two inner solvers.
_RANK, _WEIGHT, _STEPSIZE, _STEPS, _TV_STEPS, _CG_STEPS = 12, 2e-4, 50.0, 10, 30, 8


def main() -> None:
    """Read, deblur, write."""
    library, given, result = sys.argv[1:]
    with np.load(given) as stored:
        pictures, grid = stored["pictures"], (stored["x_px"], stored["y_px"], stored["kernels"])
    ways = {"regularizepsf": _regularizepsf, "deepinv": _deepinv}[library]
    restored, seconds = [], []
    for way in ways(pictures.shape[1:3], *grid):
        own, took = [], []
        for picture in pictures:
            start = time.perf_counter()
            own.append(way(picture))
            took.append(time.perf_counter() - start)
        restored.append(own)
        seconds.append(took)
    np.savez(result, restored=np.array(restored, np.float32), seconds=np.array(seconds))


def _hats(nodes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Weights of linear interpolation, by node and place; constant beyond the outer nodes."""
    return np.stack([np.interp(at, nodes, one) for one in np.eye(len(nodes))])


def _regularizepsf(
    shape: tuple[int, int], x_px: np.ndarray, y_px: np.ndarray, kernels: np.ndarray
) -> Iterator[Callable[[np.ndarray], np.ndarray]]:
    """Its transform from the kernels of patches to points, colour by colour."""
    from regularizepsf import ArrayPSF, ArrayPSFTransform
    from regularizepsf.util import IndexedCube, calculate_covering

    corners = [tuple(map(int, corner)) for corner in calculate_covering(shape, _PATCH, sample_rate=_RATE)]
    centres = np.array(corners) + _PATCH / 2
    down, across = _hats(y_px, centres[:, 0]), _hats(x_px, centres[:, 1])
    own = np.einsum("ip,jp,ijcyx->cpyx", down, across, kernels, optimize=True)
    ky, kx = kernels.shape[-2:]
    top, left = _PATCH // 2 - ky // 2, _PATCH // 2 - kx // 2
    patches = np.zeros((3, len(corners), _PATCH, _PATCH))
    patches[:, :, top : top + ky, left : left + kx] = own
    point = np.zeros((len(corners), _PATCH, _PATCH))
    point[:, _PATCH // 2, _PATCH // 2] = 1.0
    for alpha in _ALPHAS:
        for epsilon in _EPSILONS:
            transforms = [
                ArrayPSFTransform.construct(
                    ArrayPSF(IndexedCube(corners, each)), ArrayPSF(IndexedCube(corners, point)), alpha, epsilon
                )
                for each in patches
            ]
            yield lambda picture, own=transforms: np.stack(
                [
                    transform.apply(picture[..., colour].astype(float), normalization_coefficient=1 / _PATCH_SUM)
                    for colour, transform in enumerate(own)
                ],
                axis=-1,
            )


def _deepinv(
    shape: tuple[int, int], x_px: np.ndarray, y_px: np.ndarray, kernels: np.ndarray
) -> Iterator[Callable[[np.ndarray], np.ndarray]]:
    """Its space-varying blur, and ADMM with total variation. What lies around the frame is part of the solution."""
    import torch

    # deepinv imports torchvision, whose operators of another build of torch do not load; it uses none of them.
    try:
        import torchvision  # noqa: F401
    except (ImportError, RuntimeError):
        schemas = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            schemas.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    import deepinv

    ky, kx = kernels.shape[-2:]
    down, across = ky // 2, kx // 2
    filters, weights = _components(kernels)
    over_y, over_x = (
        _hats(nodes, np.arange(-reach, count + reach))
        for nodes, reach, count in ((y_px, down, shape[0]), (x_px, across, shape[1]))
    )
    multipliers = np.einsum("cijk,iy,jx->ckyx", weights, over_y, over_x, optimize=True)
    physics = deepinv.physics.SpaceVaryingBlur(
        filters=torch.from_numpy(filters[None].astype(np.float32)),
        multipliers=torch.from_numpy(multipliers[None].astype(np.float32)),
        padding="valid",
        use_fft=True,
    )
    physics.max_iter, physics.tol = _CG_STEPS, 1e-4
    solver = deepinv.optim.ADMM(
        data_fidelity=deepinv.optim.L2(),
        prior=deepinv.optim.TVPrior(n_it_max=_TV_STEPS),
        lambda_reg=_WEIGHT,
        stepsize=_STEPSIZE,
        max_iter=_STEPS,
    )

    def restore(picture: np.ndarray) -> np.ndarray:
        measured = torch.from_numpy(np.ascontiguousarray(np.moveaxis(picture, -1, 0))[None])
        first = torch.nn.functional.pad(measured, (across, across, down, down), mode="reflect")
        with torch.no_grad():
            found = solver(measured, physics, init=(first, first.clone()))
        inner = found[0, :, down : down + shape[0], across : across + shape[1]]
        return np.moveaxis(inner.numpy(), 0, -1)

    yield restore


def _components(kernels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Filters (colour, component, ky, kx) and their weights (colour, grid row, grid column, component) at low rank."""
    rows, columns, colours, *size = kernels.shape
    filters, weights = [], []
    for colour in range(colours):
        left, values, right = np.linalg.svd(kernels[:, :, colour].reshape(rows * columns, -1), full_matrices=False)
        rank = min(_RANK, len(values))
        filters.append(right[:rank].reshape(rank, *size))
        weights.append((left[:, :rank] * values[:rank]).reshape(rows, columns, rank))
    return np.array(filters), np.array(weights)


if __name__ == "__main__":
    main()
