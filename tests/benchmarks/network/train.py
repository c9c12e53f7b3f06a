"""`make network`: train the network of the tier ``accurate``.

    python -m tests.benchmarks.network.train [--minutes N] [--out FILE] [--from FILE] [--data DIR]

Another process draws examples while this one trains; an example is used several times, mirrored and cut anew. Every few
minutes it prints what the network gains over the tier ``balanced`` with kernels that it does not train on, and writes
the weights.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from tests.benchmarks.network.examples import INNER_PX, Example, Examples, Optics, drawn_kernels
from udccal.restoration.network import WEIGHTS_FILE, Weights, correction, shapes

_DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
PATCH_PX, _BATCH, _PER_EXAMPLE = 64, 16, 2
_POOL, _DRAWERS = 3000, 1
_RATE, _LEAST_RATE, _WARM_UP = 1.5e-3, 1e-5, 200
_FIRST, _SECOND, _TINY = 0.9, 0.99, 1e-8
_AVERAGED = 0.999
_CHECKS, _REPORT_S = 48, 240.0
# Squared error on a display below which it does not matter, 60 dB.
_NEGLIGIBLE = 1e-6
Batch = tuple[np.ndarray, ...]


def main() -> None:
    """Train for some minutes."""
    options = _options()
    rng = np.random.default_rng(options.seed)
    kernels = drawn_kernels(rng)
    held_out, own = kernels[::9], [k for index, k in enumerate(kernels) if index % 9]
    checks = _checks(_optics(held_out), options.data, options.seed + 1)
    pool = _Pool(own, options.data, options.seed)
    weights = _started(options.start, rng)
    state = (weights, jax.tree.map(jnp.zeros_like, weights), jax.tree.map(jnp.zeros_like, weights))
    average, start, told, step = weights, time.monotonic(), time.monotonic(), 0
    while (elapsed := (time.monotonic() - start) / 60 / options.minutes) < 1:
        step += 1
        rate = max(_RATE * min(step / _WARM_UP, 0.5 + 0.5 * np.cos(np.pi * elapsed)), _LEAST_RATE)
        state, average = _step(state, average, pool.batch(rng), jnp.float32(rate), jnp.float32(step))
        if time.monotonic() - told > _REPORT_S:
            told = time.monotonic()
            _report(step, pool.drawn, average, checks)
            _write(average, options.out)
    pool.close()
    _report(step, pool.drawn, average, checks)
    _write(average, options.out)


def _optics(kernels: list[np.ndarray]) -> list[Optics]:
    return [Optics.of(each, index) for index, each in enumerate(kernels)]


def _checks(optics: list[Optics], data: Path, seed: int) -> list[Example]:
    examples = Examples(optics, data, seed)
    return [examples.draw() for _ in range(_CHECKS)]


def _started(file: Path | None, rng: np.random.Generator) -> Weights:
    """Return weights of a file, or He's; the network begins without a correction."""
    if file is not None:
        with np.load(file, allow_pickle=False) as stored:
            return {name: jnp.asarray(stored[name], jnp.float32) for name in shapes()}
    drawn = {}
    for name, shape in shapes().items():
        spread = np.sqrt(2 / np.prod(shape[:3])) * (0.0 if name == "out" else 0.2 if name.endswith("b") else 1.0)
        drawn[name] = jnp.asarray(spread * rng.standard_normal(shape), jnp.float32)
    return drawn


def _loss(weights: Weights, detail: jax.Array, noise: jax.Array, missing: jax.Array, weight: jax.Array) -> jax.Array:
    """Mean of the logarithm of the patches' errors on a display: easy and hard ones count alike, as in a mean PSNR."""
    error = (correction(weights, detail, noise) - missing) * weight
    return jnp.mean(jnp.log(jnp.mean(error**2, axis=(1, 2, 3)) + _NEGLIGIBLE))


State = tuple[Weights, Weights, Weights]


@jax.jit
def _step(state: State, average: Weights, batch: Batch, rate: jax.Array, step: jax.Array) -> tuple[State, Weights]:
    """Take one step of Adam (Kingma and Ba, 2015), and follow the weights' average."""
    weights, mean, square = state
    slope = jax.grad(_loss)(weights, *(part.astype(jnp.float32) for part in batch))
    mean = jax.tree.map(lambda old, new: _FIRST * old + (1 - _FIRST) * new, mean, slope)
    square = jax.tree.map(lambda old, new: _SECOND * old + (1 - _SECOND) * new**2, square, slope)
    one, two = 1 - _FIRST**step, 1 - _SECOND**step
    weights = jax.tree.map(lambda w, m, s: w - rate * (m / one) / (jnp.sqrt(s / two) + _TINY), weights, mean, square)
    keep = jnp.minimum(_AVERAGED, step / (step + 10))
    return (weights, mean, square), jax.tree.map(lambda old, new: keep * old + (1 - keep) * new, average, weights)


class _Pool:
    """Examples that another process draws."""

    def __init__(self, kernels: list[np.ndarray], data: Path, seed: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._queue = context.Queue(64)
        self._processes = [
            context.Process(target=_draw, args=(kernels, data, seed + 100 + i, self._queue), daemon=True)
            for i in range(_DRAWERS)
        ]
        for process in self._processes:
            process.start()
        self._examples: list[Batch] = []
        self.drawn = 0
        while len(self._examples) < 100:
            self._take(wait=True)

    def _take(self, wait: bool) -> None:
        while wait or not self._queue.empty():
            wait = False
            example = self._queue.get()
            if len(self._examples) < _POOL:
                self._examples.append(example)
            else:
                self._examples[self.drawn % _POOL] = example
            self.drawn += 1

    def batch(self, rng: np.random.Generator) -> Batch:
        """Return patches of drawn examples."""
        self._take(wait=False)
        chosen = rng.integers(len(self._examples), size=_BATCH // _PER_EXAMPLE)
        patches = [patch(self._examples[index], rng) for index in chosen for _ in range(_PER_EXAMPLE)]
        return tuple(np.stack(column) for column in zip(*patches, strict=True))

    def close(self) -> None:
        """Stop drawing."""
        for process in self._processes:
            process.terminate()


def patch(example: Batch, rng: np.random.Generator) -> Batch:
    """Cut a patch, at whole places of the coarse level, and mirror it."""
    y, x = (4 * int(rng.integers((INNER_PX - PATCH_PX) // 4 + 1)) for _ in range(2))
    down, across = rng.choice([-1, 1], 2)
    parts = []
    for index, array in enumerate(example):
        step = 2 if index == 1 else 1
        cut = array[y // step : (y + PATCH_PX) // step, x // step : (x + PATCH_PX) // step]
        parts.append(cut[::down, ::across])
    return tuple(parts)


def _draw(kernels: list[np.ndarray], data: Path, seed: int, queue: multiprocessing.Queue[Batch]) -> None:
    os.nice(10)
    examples, parent = Examples(_optics(kernels), data, seed), os.getppid()
    while os.getppid() == parent:  # Else the training was killed.
        e = examples.draw()
        queue.put(tuple(part.astype(np.float32) for part in (e.detail, e.noise, e.missing, e.weight)))


def _report(step: int, drawn: int, weights: Weights, checks: list[Example]) -> None:
    """Print the mean gain of the network over the tier ``balanced``, on the examples that are held out."""
    gains = []
    for each in checks:
        found = np.asarray(_corrected(weights, each.detail[None], each.noise[None]))[0]
        before, after = (np.mean((error * each.weight) ** 2) for error in (each.missing, each.missing - found))
        gains.append(10 * np.log10(before / after))
    spread = ", ".join(f"{gain:.2f}" for gain in np.percentile(gains, (0, 10, 50, 90)))
    print(f"step {step}, {drawn} drawn: gain {np.mean(gains):.3f} dB; least, 10 %, median, 90 %: {spread}", flush=True)


_corrected = jax.jit(correction)


def _write(weights: Weights, file: Path) -> None:
    np.savez(file, **{name: np.asarray(value, np.float16) for name, value in weights.items()})


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0, help="how long to train")
    parser.add_argument("--out", type=Path, default=WEIGHTS_FILE, help="file of the weights")
    parser.add_argument("--from", dest="start", type=Path, help="weights to go on from")
    parser.add_argument("--data", type=Path, default=_DATA, help="the shared folder with panoramas")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


if __name__ == "__main__":
    main()
