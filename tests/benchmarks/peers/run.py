"""`make peers`: udccal and its peers on the same works with known truth. Puts a table of each work into docs/peers.md.

The peers run in environments of their own, made by the works' setup.sh; one after another, since timings side by side
are worthless. A peer that cannot run here is a line that says why.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from tests.benchmarks.commit import this_commit
from tests.benchmarks.peers.lines import Line, table
from tests.benchmarks.readme_tables import put_table

_ROOT = Path(__file__).resolve().parents[3]
_PAGE = _ROOT / "docs" / "peers.md"
_LIMIT_S = 1800
_SYSTEM_PYTHON = "/usr/bin/python3"


@dataclass(frozen=True)
class Peer:
    """One script of a peer; ``environment`` of setup.sh, None for the system's Python (Debian packages)."""

    work: str
    environment: str | None
    script: str


# Their arguments are those that the works' own run gives them.
SCICO = Peer("deconv", "scico", "deconv_scico.py sv 12 30 2e-4")
PEERS = (
    Peer("noise", "classic", "noise_floor.py --eff"),
    Peer("noise", "classic", "noise_floor.py --nonlin"),
    Peer("noise", "emva", "noise_emva1288.py"),
    Peer("noise", "emva", "noise_emva1288.py --nonlin"),
    Peer("hdr", "classic", "hdr_floor.py"),
    Peer("hdr", "hdr", "hdr_hdrutils.py"),
    Peer("hdr", "classic", "hdr_opencv.py"),
    Peer("hdr", "chdri", "hdr_colourhdri.py"),
    Peer("psf_field", "classic", "psf_field_baselines.py"),
    Peer("psf_field", "piff", "psf_field_piff.py 4"),
    Peer("psf_field", "regpsf", "psf_field_regularizepsf.py 128"),
    Peer("psf_field", "jaxstar", "psf_field_starred.py"),
    Peer("deconv", "classic", "deconv_tiles.py wiener"),
    Peer("deconv", "classic", "deconv_tiles.py skwiener"),
    Peer("deconv", "classic", "deconv_tiles.py skrl"),
    Peer("deconv", "regpsf", "deconv_regularizepsf.py 256 4"),
    SCICO,
    Peer("deconv", "torch", "deconv_deepinv.py 12 10 2e-4"),
    Peer("intrinsics", "classic", "intrinsics_opencv.py"),
    Peer("intrinsics", None, "intrinsics_mrcal.py"),
)
OURS = {
    "noise": ("ours_noise --small 20", "ours_noise --variant nonlin --seeds 0"),
    "hdr": ("ours_hdr",),
    "psf_field": ("ours_psf_field",),
    "deconv": ("ours_deconv --tier fast", "ours_deconv", "ours_deconv --tier accurate"),
    "intrinsics": ("ours_intrinsics --starts 1000 --covered 200",),
}


def main() -> None:
    """Run ours and theirs; the results stay in a JSON-lines file, from which the tables are made."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("works", nargs="*", default=[], choices=[[], *OURS], metavar="work")
    parser.add_argument("--peers", type=Path, default=_ROOT.parent / "shared" / "peers", help="folder of works.py")
    parser.add_argument("--environments", type=Path, default=Path(tempfile.gettempdir()) / "peers")
    parser.add_argument("--ours-only", action="store_true", help="leave the peers' earlier results as they are")
    parser.add_argument("--out", type=Path, default=Path("peers"), help="folder for results.jsonl")
    options = parser.parse_args()
    works = tuple(options.works) or tuple(OURS)
    options.out.mkdir(parents=True, exist_ok=True)
    environment = environment_for(options.environments)
    if not options.ours_only:
        _set_up(works, options.peers, environment)
    results = options.out / "results.jsonl"
    kept = [line for line in _read(results) if not _measured_again(line, works, options.ours_only)]
    for work in works:
        _read_once(Path(environment["PEERS_OUT"]), work)
        for script in OURS[work]:
            kept += run_ours(work, script, options.peers, environment)
        for peer in PEERS if not options.ours_only else ():
            if peer.work == work:
                kept += run_peer(peer, python_of(peer.environment, options.environments), options.peers, environment)
        results.write_text("".join(line.text() + "\n" for line in kept), encoding="utf-8")
        stamp = f"Measured {datetime.now(UTC):%Y-%m-%d}, all in one run." if not options.ours_only else ""
        own = [line for line in kept if line.work == work]
        put_table(_PAGE, f"peers {work}", f"{stamp}\n\n{table(work, own)}", {line.commit for line in own})


def environment_for(environments: Path) -> dict[str, str]:
    """Variables of the scripts: where their environments are, and where inputs are kept."""
    return {
        **os.environ,
        "PEERS_VENVS": str(environments),
        "PEERS_OUT": os.environ.get("PEERS_OUT", str(environments / "data")),
    }


def run_ours(work: str, script: str, peers: Path, environment: dict[str, str]) -> list[Line]:
    """Run one of ``OURS`` with its arguments; a line says so where it failed.

    Args:
        work: its name. script: a module of this package, and its arguments.
        peers: folder of works.py.
        environment: of ``environment_for``.
    """
    command = [sys.executable, "-m", *f"tests.benchmarks.peers.{script}".split(), "--peers", str(peers)]
    return _run(work, f"udccal ({script})", command, _ROOT, environment)


def run_peer(peer: Peer, python: str, peers: Path, environment: dict[str, str]) -> list[Line]:
    """Run a peer's script; a line says so where it failed.

    Args:
        peer: what to run. python: of its environment.
        peers: folder of the scripts.
        environment: of ``environment_for``.
    """
    return _run(peer.work, peer.script, [python, *peer.script.split()], peers, environment)


def _set_up(works: tuple[str, ...], peers: Path, environment: dict[str, str]) -> None:
    """Those of setup.sh's environments that the works' peers need; each of its lines ``mk NAME ...`` makes one."""
    needed = {peer.environment for peer in PEERS if peer.work in works}
    script = "\n".join(
        line
        for line in (peers / "setup.sh").read_text(encoding="utf-8").splitlines()
        if not line.startswith("mk ") or line.split()[1] in needed
    )
    subprocess.run(["sh", "-c", script], cwd=peers, env=environment, check=False, timeout=_LIMIT_S)


def _read_once(data: Path, work: str) -> None:
    """Read the work's inputs of earlier runs: else the script that comes first is timed with the disk, and no other."""
    for path in data.glob(f"{work}_*/*"):
        with path.open("rb") as file:
            while file.read(1 << 24):
                pass


def python_of(environment: str | None, environments: Path) -> str:
    """The Python of an environment of setup.sh, which need not be there; None is the system's."""
    if environment is None:
        return _SYSTEM_PYTHON
    return str(environments / f"venv_{environment}" / "bin" / "python")


def _read(path: Path) -> list[Line]:
    if not path.is_file():
        return []
    return [Line.read(text) for text in path.read_text(encoding="utf-8").splitlines()]


def _measured_again(line: Line, works: tuple[str, ...], ours_only: bool) -> bool:
    return line.work in works and (not ours_only or line.peer.startswith("udccal"))


def _run(work: str, name: str, command: list[str], folder: Path, environment: dict[str, str]) -> list[Line]:
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=_LIMIT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return [Line.failure(work, name, str(error)).measured_at(this_commit())]
    lines = [Line.read(text).measured_at(this_commit()) for text in done.stdout.splitlines() if text.startswith("{")]
    if lines:
        print("\n".join(line.text() for line in lines), flush=True)
        return lines
    reason = (done.stderr.strip().splitlines() or ["no output"])[-1]
    print(f"{name}: {reason}", flush=True)
    return [Line.failure(work, name, reason[:160]).measured_at(this_commit())]


if __name__ == "__main__":
    main()
