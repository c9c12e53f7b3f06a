"""What a profile lacks costs picture quality in its own row, and what it knows costs nothing."""

from __future__ import annotations

import numpy as np
import pytest

from tests.benchmarks import budget
from tests.benchmarks.full_blur import build_full_blur
from tests.benchmarks.scenes import Scene
from tests.scenes.toy_restorer import NOISE, fitted
from tests.simulation.toy import toy_truth
from udccal.fitting.nominal import absent_backscatter, absent_psf, absent_wire, nominal_geometry
from udccal.profiles.profile import build_profile
from udccal.profiles.provenance import provenance_now
from udccal.simulation.wire import wire_map


@pytest.mark.medium
@pytest.mark.usefixtures("as_other_programs_call")
def test_what_a_profile_lacks_costs_in_its_own_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget, "_INNER", 8)
    truth, patches = toy_truth(), np.random.default_rng(3).uniform(0.02, 1.0, (60, 80, 3)) ** 2
    scene, rig = Scene("patches", np.kron(patches, np.ones((8, 8, 1)))), truth.description
    blur = build_full_blur(truth, 3, 3, 33, 17)
    geometry = nominal_geometry(rig)
    profile = build_profile(
        rig,
        provenance_now(None, None),
        noise=fitted(NOISE),
        geometry=fitted(geometry),
        wire=fitted(absent_wire(rig, geometry)),
        psf=fitted(absent_psf(rig, geometry)),
        backscatter=fitted(absent_backscatter(rig, geometry)),
        wire_map=wire_map(truth).astype(np.float32),
    )
    cost = budget.measured(truth, blur, profile, [scene])["patches"]
    assert set(cost) == {"reference", "noise", *budget.ROWS, "geometry and view", "all of them"}
    assert np.isfinite(list(cost.values())).all()
    assert abs(cost["wire"]) < 0.01
    assert cost["backscatter"] > 0.2
    assert cost["kernels"] > 3.0
    assert "| kernels | " in budget.summary({"patches": cost})
