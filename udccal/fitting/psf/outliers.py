"""Samples and whole pictures that the psf fit leaves out, by rules that it states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.psf.blocks import Block, Local
from udccal.result import Outliers

SAMPLE_SIGMA = 5.0
# Of residuals of at most so many sigma, so that one cosmic hit does not condemn its picture.
_PICTURE_SIGMA, _PICTURE_TIMES = 3.0, 2.5
_FEWEST_PICTURES = 4
_NAMED = 8


def without_outliers(
    blocks: list[Block], lights: list[Float[np.ndarray, "shots n"]], local: tuple[Local, ...]
) -> tuple[tuple[Block, ...], tuple[Outliers, ...]]:
    """Blocks in which outliers have no weight, and what was left out: pictures first, then samples of the others."""
    sizes = [
        (np.asarray(b.rate) - light - np.asarray(own.background)[:, None]) * np.sqrt(np.asarray(b.weight))
        for b, light, own in zip(blocks, lights, local, strict=True)
    ]
    bad_pictures = _pictures(blocks, sizes)
    kept, samples, pictures = [], [], []
    for place, (block, size, bad) in enumerate(zip(blocks, sizes, bad_pictures, strict=True)):
        off = (np.abs(size) > SAMPLE_SIGMA) & ~bad[:, None]
        index = np.asarray(block.index)
        pictures += [f"picture {index[s]} at position {place}" for s in np.flatnonzero(bad)]
        samples += [f"picture {index[s]} at position {place}, {size[s, n]:+.0f} sigma" for s, n in np.argwhere(off)]
        kept.append(replace(block, weight=np.where(off | bad[:, None], 0.0, np.asarray(block.weight))))
    rules = (
        (f"pictures whose mean squared residual is over {_PICTURE_TIMES} times the median picture's", pictures),
        (f"samples off by more than {SAMPLE_SIGMA:g} sigma of noise and model error", samples),
    )
    return tuple(kept), tuple(Outliers(rule, len(named), tuple(named[:_NAMED])) for rule, named in rules if named)


def _pictures(blocks: list[Block], sizes: list[Float[np.ndarray, "shots n"]]) -> list[Bool[np.ndarray, " shots"]]:
    """Which pictures fit so much worse than the others that something moved, flickered or was in the way."""
    squares = []
    for block, size in zip(blocks, sizes, strict=True):
        seen = np.asarray(block.weight) > 0
        bounded = np.minimum(size**2, _PICTURE_SIGMA**2) * seen
        squares.append(bounded.sum(axis=1) / np.maximum(seen.sum(axis=1), 1))
    real = np.concatenate([s[np.asarray(b.index) >= 0] for s, b in zip(squares, blocks, strict=True)])
    if real.size < _FEWEST_PICTURES:
        return [np.zeros(len(s), dtype=bool) for s in squares]
    worst = _PICTURE_TIMES * max(float(np.median(real)), 1.0)
    return [(s > worst) & (np.asarray(b.index) >= 0) for s, b in zip(squares, blocks, strict=True)]
