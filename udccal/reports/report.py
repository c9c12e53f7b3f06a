"""The report of a calibration: collects the numbers, draws the figures, writes the page."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import UInt8

from udccal.calibration import Calibration
from udccal.comparison.rig_state import rig_state
from udccal.reports import figures
from udccal.reports.accuracy import accuracies
from udccal.reports.advice import advice
from udccal.reports.board_views import board_evidence
from udccal.reports.evidence import photon_transfer
from udccal.reports.fit_tables import state_table
from udccal.reports.maps import fitted_maps
from udccal.reports.page import Fact, Illustration, Page
from udccal.reports.pictures import PictureComparison
from udccal.reports.sections import Evidence, sections
from udccal.reports.tables import Table
from udccal.reports.truth import compare_with_truth, true_maps, truth_table
from udccal.restoration.tone import to_rgb8
from udccal.sessions.store import Session
from udccal.simulation.light import RigLight


def gather(
    session: Session,
    calibration: Calibration,
    picture: UInt8[np.ndarray, "panel_rows panel_columns 3"],
    light: RigLight | None,
) -> Evidence:
    """Collect every number that the report shows.

    Args:
        session: captured data.
        calibration: fits of that session.
        picture: picture on the panel for which backscatter is shown; no calibration has captured it.
        light: true light of a simulated rig; None for a real rig.

    Raises:
        SessionError: when a file of the session is damaged.
    """
    # The maps wait for compiled code, and the forecasts are Python: they run at the same time.
    with ThreadPoolExecutor(1) as beside:
        maps = beside.submit(fitted_maps, calibration, picture)
        accuracy = accuracies(calibration)
    fitted = maps.result()
    true = None if light is None else true_maps(light, fitted)
    rows = () if light is None or true is None else compare_with_truth(calibration, light.truth, fitted, true)
    noise, geometry = calibration.noise.term, calibration.geometry.term
    return Evidence(
        calibration,
        fitted,
        true,
        rows,
        photon_transfer(session, noise),
        board_evidence(calibration.foundation.boards, geometry),
        accuracy,
    )


def calibration_page(session: Session, evidence: Evidence, scene: PictureComparison | None) -> Page:
    """Build the page of one calibration.

    Args:
        session: captured data.
        evidence: numbers of the report, from ``gather``.
        scene: a restored scene; None for none.
    """
    calibration = evidence.calibration
    camera, sensor = session.camera, calibration.rig.camera
    facts = (
        Fact("rig", calibration.rig.name),
        Fact("panel", calibration.rig.panel.model),
        Fact("camera", f"{camera.vendor} {camera.model}, serial {camera.serial}"),
        Fact("sensor", f"{sensor.columns} × {sensor.rows}, {sensor.cfa}, {sensor.bits} bits"),
        Fact("captured", session.manifest.created_at),
        Fact("steps", str(len(session.manifest.steps))),
        *(
            Fact("exchanged", f"{change.what}: {change.before}, then {change.after}")
            for change in session.manifest.changes
        ),
        Fact("fits", ", ".join(f"{t.term} {t.seconds:.1f} s" for t in calibration.times)),
    )
    tables = (truth_table(evidence.rows),) if evidence.rows else ()
    if all(result.usable for result in calibration.results) and (state := rig_state(calibration)).terms:
        tables = (state_table(state), *tables)
    return Page(
        title=f"Calibration of {calibration.rig.name}",
        advice=advice(calibration),
        facts=facts,
        pictures=() if scene is None else scene_illustrations(scene),
        picture_sentence="" if scene is None else scene_sentence(scene),
        tables=tables,
        sections=sections(evidence),
    )


def scene_sentence(scene: PictureComparison) -> str:
    """Return a sentence about a scene's scores before and after restoration."""
    before, after = scene.score_before, scene.score_after
    return (
        f"Restoration takes “{scene.name}” from {before.psnr_dB:.2f} dB to {after.psnr_dB:.2f} dB PSNR "
        f"(gain {scene.gain_dB:.2f} dB) and from {before.ssim:.3f} to {after.ssim:.3f} SSIM."
    )


def scene_table(scene: PictureComparison) -> Table:
    """Return the scores of ``scene`` before and after restoration as a table."""
    rows = tuple(
        (name, f"{score.psnr_dB:.2f}", f"{score.ssim:.4f}")
        for name, score in (("before", scene.score_before), ("after", scene.score_after))
    )
    return Table(f"The picture “{scene.name}”", ("", "PSNR [dB]", "SSIM"), rows, frozenset({1, 2}))


def scene_illustrations(scene: PictureComparison) -> tuple[Illustration, ...]:
    """Return pictures of a scene before, after, its truth and the remaining error."""
    difference = np.abs(scene.after - scene.truth).mean(axis=-1)
    return (
        Illustration(
            figures.embedded_picture(to_rgb8(scene.before)),
            "Before: black level, colour and geometry only.",
            "before",
        ),
        Illustration(figures.embedded_picture(to_rgb8(scene.after)), "After: restored with this profile.", "after"),
        Illustration(figures.embedded_picture(to_rgb8(scene.truth)), "Truth: the same view without a panel.", "truth"),
        Illustration(
            figures.embedded_png(figures.difference_figure(difference, "|after − truth|")),
            "Remaining error, on a scale to a tenth of full scale.",
            "difference",
        ),
    )
