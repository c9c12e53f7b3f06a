"""Finds graphics processors and JAX's devices."""

from __future__ import annotations

import subprocess
from collections import Counter
from typing import Final

from udccal.doctor.answers import Failure, JaxDevice
from udccal.doctor.finding import Finding, Status

ASK_JAX_S: Final = 120.0  # its first start on a slow disk takes a large part of that
_SMI_S: Final = 15.0
_SMI: Final = ("nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader")
_NO_GPU: Final = "Everything runs on the processor; fits and restoration take longer."


def gpu_finding(command: tuple[str, ...] = _SMI, seconds: float = _SMI_S) -> Finding:
    """List NVIDIA's graphics processors, as their driver names them."""
    topic = "GPU"
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=seconds)
    except FileNotFoundError:
        return Finding(topic, Status.NOTE, "none with NVIDIA's driver", _NO_GPU)
    except (OSError, subprocess.TimeoutExpired) as error:
        reason = "does not answer" if isinstance(error, subprocess.TimeoutExpired) else f"cannot be asked ({error})"
        return Finding(topic, Status.NOTE, f"NVIDIA's driver {reason}", f"Restart the computer. {_NO_GPU}")
    lines = [line.strip() for line in done.stdout.decode("utf-8", "replace").splitlines() if line.strip()]
    if done.returncode or not lines:
        said = lines[0][:200] if lines else f"exit status {done.returncode}"
        return Finding(topic, Status.NOTE, f"NVIDIA's driver reports: {said}", f"Install it again. {_NO_GPU}")
    return Finding(topic, Status.OK, "; ".join(line[:200] for line in lines[:16]))


def jax_finding(answer: tuple[JaxDevice, ...] | Failure, gpu: Finding) -> Finding:
    """List the devices that JAX computes on; without JAX it is a problem, since fits and restoration need it."""
    topic = "JAX devices"
    if isinstance(answer, Failure):
        advice = "Install udccal again: pip install --force-reinstall udccal"
        return Finding(topic, Status.PROBLEM, answer.reason, advice)
    counts = Counter((device.platform, device.kind) for device in answer)
    found = "; ".join(f"{number} x {platform} ({kind})" for (platform, kind), number in counts.items())
    if gpu.status is Status.OK and not any(device.platform in ("gpu", "cuda") for device in answer):
        advice = "JAX does not use the GPU. Install its GPU support:\npip install 'jax[cuda13]'"
        return Finding(topic, Status.NOTE, found, advice)
    return Finding(topic, Status.OK, found)
