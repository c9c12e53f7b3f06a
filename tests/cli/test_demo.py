"""The whole way, as a user runs it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

TERMS = {"noise", "geometry", "wire", "psf", "backscatter"}


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_the_demonstration_beats_the_panel(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    done = subprocess.run(
        [sys.executable, "-m", "udccal.cli.main", "demo", "--out", str(out), "--json"],
        capture_output=True,
        text=True,
        timeout=1400,
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert {row["term"] for row in result["terms"]} == TERMS
    assert result["after"]["psnr_dB"] > result["before"]["psnr_dB"] + 5.0
    assert result["after"]["ssim"] > result["before"]["ssim"]
    for made in ("session/session.json", "profile/profile.json", "portrait/after.png", "report.html"):
        assert (out / made).is_file()
    report = (out / "report.html").read_text(encoding="utf-8")
    for term in TERMS:
        assert f'alt="residuals of {term}"' in report
        assert f'alt="accuracy of {term} against captures"' in report
    assert report.count("unused part of the information") == len(TERMS)
    assert "http://" not in report
