"""One drawn rig: its session, its profile, and the judgement; in a process of its own for `make rigs`.

    python -m tests.benchmarks.drawn_rigs.one SEED FOLDER

Writes FOLDER/rig.json. The session is removed: its program writes it again.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from tests.benchmarks.commit import this_commit
from tests.benchmarks.drawn_rigs.draw import draw
from tests.benchmarks.drawn_rigs.judge import Judged, judge
from udccal.calibration import calibrate
from udccal.compilation import keep_compilations
from udccal.errors import UdccalError
from udccal.io.atomic import write_atomically
from udccal.profiles.store import read_profile
from udccal.sessions.store import Session

_FILE = "rig.json"


@dataclass(frozen=True)
class Finished:
    """The judgement of one rig, what the rig is, the commit, and the CPU-seconds of fit and judgement."""

    seed: int
    what: str
    commit: str
    cpu_s: float
    quantities: tuple[Judged, ...]

    def write(self, folder: Path) -> None:
        """At once, so that it is whole or not there."""
        write_atomically(folder / _FILE, (json.dumps(asdict(self), indent=1) + "\n").encode())


def read_finished(folder: Path) -> Finished | None:
    """The judgement in a folder; None where it was not finished."""
    file = folder / _FILE
    if not file.exists():
        return None
    found = json.loads(file.read_text(encoding="utf-8"))
    return Finished(**{**found, "quantities": tuple(Judged(**one) for one in found["quantities"])})


def run(seed: int, folder: Path) -> Finished:
    """Write the session, fit it into a profile, judge that; a rig without a profile has one row, which is missed."""
    session, profile, rig = folder / "session", folder / "profile", draw(seed)
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "tests.benchmarks.drawn_rigs.session", str(seed), str(session)], check=True)
    start = time.process_time()
    try:
        calibrate(Session.open(session), lambda term: print(f"rig {seed}: {term}", flush=True)).write(profile)
        written = Judged("profiles not written", 0.0, 0.0, "", 0.0, "")
        quantities = (written, *judge(read_profile(profile), rig))
    except UdccalError as error:
        print(error, flush=True)
        quantities = (Judged("profiles not written", 1.0, 0.0, "", 0.0, ""),)
    shutil.rmtree(session)
    what = f"{rig.columns} x {rig.rows}, {rig.noise.bits} bits, {rig.shape.kind}, {rig.noise.kind} read noise"
    return Finished(seed, what, this_commit(), time.process_time() - start, quantities)


def main() -> None:
    """Run one rig and keep what came of it."""
    seed, folder = int(sys.argv[1]), Path(sys.argv[2])
    keep_compilations()
    run(seed, folder).write(folder)


if __name__ == "__main__":
    main()
