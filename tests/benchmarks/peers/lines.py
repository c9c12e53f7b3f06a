"""The JSON lines that the scripts of the works print, and the tables made of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

_NONE = "–"


@dataclass(frozen=True)
class Line:
    """One printed line: the script's own names (see works.py's ``emit``), or why there is none."""

    work: str
    peer: str
    fields: dict[str, Any]

    @classmethod
    def read(cls, text: str) -> Line:
        """From a line of JSON."""
        fields = json.loads(text)
        return cls(fields["work"], fields["peer"], fields)

    @classmethod
    def failure(cls, work: str, peer: str, reason: str) -> Line:
        """Of a script that printed nothing."""
        return cls(work, peer, {"work": work, "peer": peer, "failed": reason})

    def measured_at(self, commit: str) -> Line:
        """The same line, with the commit of udccal that it was measured beside."""
        return Line(self.work, self.peer, {**self.fields, "commit": commit})

    @property
    def commit(self) -> str:
        """See ``measured_at``; lines of earlier versions do not say it."""
        return str(self.fields.get("commit", "unknown"))

    def text(self) -> str:
        """As a line of JSON."""
        return json.dumps(self.fields)

    def number(self, *path: str) -> float | None:
        """The number under nested names; None where the script does not say it."""
        value: Any = self.fields
        for name in path:
            value = value.get(name) if isinstance(value, dict) else None
        return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None


Cell = Callable[[Line], str]


def _number(*path: str, factor: float = 1.0, digits: int = 3) -> Cell:
    def cell(line: Line) -> str:
        value = line.number(*path)
        return _NONE if value is None else f"{factor * value:.{digits}g}"

    return cell


def _name(line: Line) -> str:
    version = str(line.fields.get("version", ""))
    variant = ", 1 % nonlinear" if line.fields.get("variant") == "nonlin" else ""
    return f"{line.peer} {version}{variant}".strip()


def _decades(line: Line) -> str:
    """Ratio to the bound per decade of the one picture that every script merges, darkest first."""
    ratios = line.fields.get("full", {}).get("ratio") or []
    return ", ".join(f"{r:.3g}" for r in ratios) or _NONE


def _converged(line: Line) -> str:
    starts = line.fields.get("starts_converged")
    if starts is not None:
        return str(starts)
    return f"{line.fields.get('converged', line.fields.get('seeds', _NONE))} of {line.fields.get('seeds', _NONE)} seeds"


def _z_std(line: Line) -> str:
    if "projection_z_std_error" not in line.fields:
        return _NONE
    z, error = line.fields["projection_z_std"], line.fields["projection_z_std_error"]
    return f"{z:.2f} ± {error:.2f}, {line.fields['covered']} seeds"


_SECONDS: tuple[tuple[str, Cell], ...] = (
    ("s", _number("seconds")),
    ("first run, s", _number("first_run_s")),
    ("MiB", _number("peak_rss_mb", digits=4)),
)
_COLUMNS: dict[str, tuple[tuple[str, Cell], ...]] = {
    "noise": (
        ("K, %", _number("rel_err_rms", "K", factor=100, digits=2)),
        ("σ_d, %", _number("rel_err_rms", "sigma_d", factor=100, digits=2)),
        ("PRNU, %", _number("rel_err_rms", "prnu", factor=100, digits=2)),
        ("DSNU, %", _number("rel_err_rms", "dsnu", factor=100, digits=2)),
        ("saturation, %", _number("rel_err_rms", "sat", factor=100, digits=2)),
        ("dark current, %", _number("rel_err_rms", "dark_current", factor=100, digits=2)),
        ("linearity, points", _number("rel_err_rms", "lin_rms_pp", digits=2)),
        ("K over its bound, 20 small sets", _number("K_rmse_over_crb_20small")),
    ),
    "hdr": (
        ("over the bound per decade, dark to bright", _decades),
        ("bias of the darkest decade, %", lambda line: _first_bias(line)),
    ),
    "psf_field": (
        ("median, %", _number("err_median", factor=100)),
        ("95th percentile, %", _number("err_p95", factor=100)),
        ("z std", _number("z_std")),
    ),
    "deconv": (
        ("PSNR, dB", _number("psnr", digits=4)),
        ("SSIM", _number("ssim")),
    ),
    "intrinsics": (
        ("error after rotation, px", _number("rot_rms")),
        ("largest, px", _number("rot_max")),
        ("right minimum", _converged),
        ("projection z std", _z_std),
    ),
}


def _first_bias(line: Line) -> str:
    bias = line.fields.get("full", {}).get("bias")
    return f"{100 * bias[0]:.2g}" if bias and bias[0] is not None else _NONE


def table(work: str, lines: list[Line]) -> str:
    """A Markdown table of the lines of a work."""
    columns = (*_COLUMNS[work], *_SECONDS)
    head = ["", *(title for title, _ in columns)]
    rules = ["---", *["---:"] * len(columns)]
    rows = [
        [_name(line), f"did not run here: {line.fields['failed']}", *[""] * (len(columns) - 1)]
        if "failed" in line.fields
        else [_name(line), *(cell(line) for _, cell in columns)]
        for line in lines
        if line.work == work
    ]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, rules, *rows))
