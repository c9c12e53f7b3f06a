"""`make network`: train the network of the tier ``accurate``.

    python -m tests.benchmarks.network.train [--minutes N] [--from FILE] [--rate R] [--root DIR] [--out FILE]

Another process draws examples while this one trains; an example is used several times, mirrored and cut anew. Every few
minutes it prints what the network gains over the tier ``balanced`` with kernels and pictures that it does not train on,
and writes the weights.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from pathlib import Path

import jax
import numpy as np
import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from tests.benchmarks.network.examples import Example, Examples, Optics, drawn_kernels, patch
from tests.benchmarks.network.pictures import Pictures, photographs
from tests.benchmarks.network.torch_network import Network, to_weights
from udccal.restoration.network import WEIGHTS_FILE, Weights, correction

_DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
_BATCH, _POOL = 8, 3000
_LEAST_RATE, _WARM_UP = 1e-5, 200
_AVERAGED = 0.999
_CHECKS, _REPORT_S = 64, 300.0
# Squared error on a display below which it does not matter, 60 dB.
_NEGLIGIBLE = 1e-6
Batch = tuple[np.ndarray, ...]


def main() -> None:
    """Train for some minutes."""
    options = _options()
    # A second thread waits for the first more than it helps, and the other core draws examples.
    torch.set_num_threads(1)
    rng = np.random.default_rng(options.seed)
    kernels, (pictures, judging) = drawn_kernels(rng), photographs(options.data, options.root, rng)
    own = [kernel for index, kernel in enumerate(kernels) if index % 9]
    held_out = Examples(_optics(kernels[::9]), judging, options.seed + 1)
    checks = [held_out.draw() for _ in range(_CHECKS)]
    pool = _Pool(own, pictures, options.seed)
    network = Network(rng, _read(options.start)).to(memory_format=torch.channels_last)
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(_AVERAGED))
    optimiser = torch.optim.Adam(network.parameters(), betas=(0.9, 0.99))
    start, told, step = time.monotonic(), time.monotonic(), 0
    while (elapsed := (time.monotonic() - start) / 60 / options.minutes) < 1:
        step += 1
        rate = max(options.rate * min(step / _WARM_UP, 0.5 + 0.5 * np.cos(np.pi * elapsed)), _LEAST_RATE)
        for group in optimiser.param_groups:
            group["lr"] = rate
        optimiser.zero_grad()
        _loss(network, *(torch.from_numpy(part) for part in pool.batch(rng))).backward()
        optimiser.step()
        average.update_parameters(network)
        if time.monotonic() - told > _REPORT_S:
            told = time.monotonic()
            _report(step, pool.drawn, to_weights(average), checks)
            _write(to_weights(average), options.out)
    pool.close()
    _report(step, pool.drawn, to_weights(average), checks)
    _write(to_weights(average), options.out)


def _optics(kernels: list[np.ndarray]) -> list[Optics]:
    return [Optics.of(each, index) for index, each in enumerate(kernels)]


def _loss(network: Network, detail: Tensor, noise: Tensor, missing: Tensor, weight: Tensor) -> Tensor:
    """Mean of the logarithm of the patches' errors on a display: easy and hard ones count alike, as in a mean PSNR."""
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = network(detail, noise)
    squares = ((found.float() - missing) * weight).square().mean(dim=(1, 2, 3))
    return torch.log(squares + _NEGLIGIBLE).mean()


class _Pool:
    """Examples that another process draws."""

    def __init__(self, kernels: list[np.ndarray], pictures: Pictures, seed: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._queue: multiprocessing.Queue[Batch] = context.Queue(64)
        self._process = context.Process(target=_draw, args=(kernels, pictures, seed, self._queue), daemon=True)
        self._process.start()
        self._examples: list[Batch] = []
        self.drawn = 0
        while len(self._examples) < 200:
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
        """Return patches of drawn examples, in the order examples, channels, rows, columns."""
        self._take(wait=False)
        chosen = rng.integers(len(self._examples), size=_BATCH)
        patches = [patch(self._examples[index], rng) for index in chosen]
        return tuple(np.stack(column).transpose(0, 3, 1, 2) for column in zip(*patches, strict=True))

    def close(self) -> None:
        """Stop drawing."""
        self._process.terminate()


def _draw(kernels: list[np.ndarray], pictures: Pictures, seed: int, queue: multiprocessing.Queue[Batch]) -> None:
    examples, parent = Examples(_optics(kernels), pictures, seed + 100), os.getppid()
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


def _read(file: Path | None) -> dict[str, np.ndarray] | None:
    if file is None:
        return None
    with np.load(file, allow_pickle=False) as stored:
        return {name: stored[name].astype(np.float32) for name in stored.files}


def _write(weights: Weights, file: Path) -> None:
    np.savez(file, **{name: np.asarray(value, np.float16) for name, value in weights.items()})


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0, help="how long to train")
    parser.add_argument("--out", type=Path, default=WEIGHTS_FILE, help="file of the weights")
    parser.add_argument("--from", dest="start", type=Path, help="weights to go on from, of a smaller network, too")
    parser.add_argument("--rate", type=float, default=1.2e-3, help="the largest step; half as much to go on")
    parser.add_argument("--data", type=Path, default=_DATA, help="the shared folder with panoramas")
    parser.add_argument("--root", type=Path, default=Path("/"), help="below which Debian's packages lie")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


if __name__ == "__main__":
    main()
