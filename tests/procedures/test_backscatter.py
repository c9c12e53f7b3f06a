from __future__ import annotations

from pathlib import Path

import numpy as np

from procedures.backscatter import BackscatterProcedure, brightened
from procedures.base import run_procedure
from tests.procedures.benches import new_writer, simulated_bench, small_rig
from udccal.sessions.store import Session


def test_brightening_is_the_formula() -> None:
    picture = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(3, axis=2)
    found = brightened(picture).astype(float) / 255
    expected = np.minimum((2 * (picture / 255.0) ** 2.2 + 0.3) ** (1 / 2.2), 1)
    np.testing.assert_allclose(found, expected, atol=0.51 / 255)


def test_a_third_of_the_pictures_are_brightened_others() -> None:
    rig = small_rig()
    rig = rig.model_copy(update={"captures": rig.captures.model_copy(update={"backscatter_pictures": 10})})
    steps = {step.id.split("/")[1]: step for step in BackscatterProcedure().steps(rig)}
    roles = [step.role for name, step in steps.items() if name not in ("white", "dark")]
    assert (roles.count("picture"), roles.count("brightened")) == (7, 3)
    for index in range(3):
        shown = steps[f"brightened_{index}"].arrangement.picture
        np.testing.assert_array_equal(shown, brightened(steps[f"picture_{index}"].arrangement.picture))


def test_pictures_are_captured_with_what_the_panel_showed(tmp_path: Path) -> None:
    rig = small_rig()
    with simulated_bench(rig) as bench:
        run_procedure(BackscatterProcedure(), bench, new_writer(tmp_path, rig, bench))
    session = Session.open(tmp_path)
    steps = {step.id.split("/")[1]: step for step in session.steps("backscatter")}
    assert set(steps) == {"white", "dark", "picture_0", "brightened_0", "picture_1"}
    assert {step.captures[0].exposure_s for step in steps.values()} == {steps["white"].captures[0].exposure_s}
    picture, lighter = (session.picture(steps[name].subject) for name in ("picture_0", "brightened_0"))
    np.testing.assert_array_equal(lighter, brightened(picture))
    light = {name: float(session.average(step.captures[0]).mean.mean()) for name, step in steps.items()}
    assert light["dark"] < light["picture_0"] < light["brightened_0"] < light["white"]
