"""Draws figures with matplotlib's objects on an Agg canvas; nothing opens a window."""

from __future__ import annotations

import base64
import io

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from udccal.fitting.psf.held_out import KernelError
from udccal.reports.board_views import BoardEvidence
from udccal.reports.evidence import PhotonTransfer
from udccal.reports.maps import TermMaps, ripple

_DPI = 110
_COLOURS = ("#c0392b", "#27864b", "#2f6fb5")
_NAMES = ("red", "green", "blue")
_DECADES = 5.0
_MOST_ROWS = 97


def embedded_png(figure: Figure) -> str:
    """Return a figure as a data URI that an HTML page can hold."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": ""})
    return _uri(buffer.getvalue())


def embedded_picture(picture: UInt8[np.ndarray, "rows columns 3"]) -> str:
    """Return an RGB picture as a data URI."""
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    if not done:
        raise ValueError(f"expected a picture that encodes as PNG, found shape {picture.shape}")
    return _uri(encoded.tobytes())


def _uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def row_of_axes(columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure of ``columns`` panels next to each other; sizes in inches."""
    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    return figure, [figure.add_subplot(1, columns, i + 1) for i in range(columns)]


def photon_transfer_figure(points: PhotonTransfer) -> Figure:
    """Draw photon transfer: the slope is the gain K."""
    figure, (axes,) = row_of_axes(1, 6.0, 3.6)
    for channel, (name, colour) in enumerate(zip(_NAMES, _COLOURS, strict=True)):
        mean, variance = points.mean_DN[:, channel], points.variance_DN2[:, channel]
        axes.loglog(mean, variance, "o", ms=4.5, color=colour, label=name, alpha=0.8)
    lowest = max(float(points.mean_DN.min()), 0.1)
    line = np.geomspace(lowest, points.saturation_DN, 50)
    axes.loglog(line, points.slope_DN_per_e * line, "k-", lw=1, label=f"fit: K = {points.slope_DN_per_e:.4f} DN/e⁻")
    axes.axvline(points.saturation_DN, color="0.6", ls=":", lw=1)
    axes.set_xlabel("mean signal above dark [DN]")
    axes.set_ylabel("temporal variance [DN²]")
    axes.legend(frameon=False, fontsize=8)
    axes.grid(alpha=0.25)
    return figure


def board_figure(evidence: BoardEvidence, columns: int, rows: int) -> Figure:
    """Draw the positions of the boards' corners on the sensor, and their residuals."""
    figure, (coverage, residuals) = row_of_axes(2, 6.8, 3.1)
    coverage.plot(evidence.corners_px[:, 0], evidence.corners_px[:, 1], ".", ms=3, color=_COLOURS[2])
    coverage.set(xlim=(0, columns), ylim=(rows, 0), xlabel="x [px]", ylabel="y [px]", aspect="equal")
    coverage.set_title("corners found on the sensor", fontsize=9)
    residuals.plot(evidence.residuals_px[:, 0], evidence.residuals_px[:, 1], ".", ms=3, color=_COLOURS[0], alpha=0.6)
    reach = 1.1 * float(np.abs(evidence.residuals_px).max()) + 1e-6
    rms = float(np.sqrt(np.mean(np.sum(evidence.residuals_px**2, axis=1))))
    residuals.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="x [px]", ylabel="y [px]", aspect="equal")
    residuals.set_title(f"residuals, RMS {rms:.3f} px", fontsize=9)
    residuals.grid(alpha=0.25)
    return figure


def wire_figure(fitted: TermMaps, true: TermMaps | None) -> Figure:
    """Draw the ripple of the wire map in percent; with a truth, also the truth and the difference."""
    shown = [("fitted", 100.0 * ripple(fitted.wire))]
    if true is not None:
        shown += [("truth", 100.0 * ripple(true.wire)), ("fitted − truth", 100.0 * (fitted.wire / true.wire - 1.0))]
    figure, axes = row_of_axes(len(shown), 4.1 * len(shown), 3.1)
    reach = float(np.percentile(np.abs(shown[0][1]), 99.5)) or 1.0
    for index, (axis, (title, values)) in enumerate(zip(axes, shown, strict=True)):
        limit = reach if index < 2 else float(np.percentile(np.abs(values), 99.5)) or 1.0
        image = axis.imshow(values, cmap="gray" if index < 2 else "RdBu_r", vmin=-limit, vmax=limit, aspect="equal")
        bare(axis, title)
        figure.colorbar(image, ax=axis, shrink=0.75, label="%")
    return figure


def psf_figure(fitted: TermMaps, true: TermMaps | None, sigma: KernelError | None) -> Figure:
    """Draw kernels on a logarithmic scale over five decades below their peaks, in the channels' colours.

    Below the fitted ones are one standard deviation of each sample, where it is stated, and the true kernels.
    """
    rows = [("fitted", fitted.kernels)]
    if sigma is not None:
        rows.append(("σ", sigma.of_kernels(fitted.kernels)))
    if true is not None:
        rows.append(("truth", true.kernels))
    places, peaks = fitted.kernels.shape[0], fitted.kernels.max(axis=(2, 3), keepdims=True)
    ky, kx = min(fitted.kernels.shape[2], _MOST_ROWS), fitted.kernels.shape[3]
    figure = Figure(figsize=(2.4 * places, 2.4 * len(rows) * ky / kx + 0.5), dpi=_DPI, layout="constrained")
    for r, (name, kernels) in enumerate(rows):
        for p in range(places):
            axis = figure.add_subplot(len(rows), places, r * places + p + 1)
            axis.imshow(_log_colour(_middle_rows(kernels[p], ky), peaks[p]), interpolation="nearest")
            x, y = fitted.positions_px[p]
            bare(axis, f"{name}, at ({x:.0f}, {y:.0f})")
    return figure


def _middle_rows(kernel: Float[np.ndarray, "3 ky kx"], rows: int) -> Float[np.ndarray, "3 rows kx"]:
    top = (kernel.shape[1] - rows) // 2
    return kernel[:, top : top + rows]


def _log_colour(kernel: Float[np.ndarray, "3 ky kx"], peak: Float[np.ndarray, "3 1 1"]) -> Float[np.ndarray, "ky kx 3"]:
    decades = np.log10(np.maximum(kernel / np.maximum(peak, 1e-30), 1e-12))
    return np.clip(1.0 + decades / _DECADES, 0.0, 1.0).transpose(1, 2, 0)


def backscatter_figure(fitted: TermMaps, true: TermMaps | None, cfa_step: int = 2) -> Figure:
    """Draw the picture on the panel, and the light that it scatters back into the camera (one CFA site)."""
    site = np.s_[1::cfa_step, ::cfa_step]
    shown = [("fitted", fitted.backscatter[site])]
    if true is not None:
        shown += [("truth", true.backscatter[site]), ("fitted − truth", (fitted.backscatter - true.backscatter)[site])]
    figure, axes = row_of_axes(1 + len(shown), 3.6 * (1 + len(shown)), 2.7)
    left, top, right, bottom = fitted.seen_px
    axes[0].imshow(fitted.picture[top : bottom + 1, left : right + 1])
    bare(axes[0], "part of the panel in view")
    reach = max(float(np.max(shown[0][1])), 1e-9)
    for index, (axis, (title, values)) in enumerate(zip(axes[1:], shown, strict=True)):
        limit = reach if index < 2 else float(np.percentile(np.abs(values), 99.5)) or 1.0
        image = axis.imshow(
            values, cmap="magma" if index < 2 else "RdBu_r", vmin=0.0 if index < 2 else -limit, vmax=limit
        )
        bare(axis, title)
        figure.colorbar(image, ax=axis, shrink=0.75, label="e⁻/s")
    return figure


def difference_figure(difference: Float[np.ndarray, "rows columns"], title: str) -> Figure:
    """Draw the absolute difference of display-encoded values, on a scale to 0.1."""
    figure, (axis,) = row_of_axes(1, 6.0, 3.5)
    image = axis.imshow(difference, cmap="inferno", vmin=0.0, vmax=0.1)
    bare(axis, title)
    figure.colorbar(image, ax=axis, shrink=0.8, label="display value")
    return figure


def bare(axis: Axes, title: str) -> None:
    """Give a picture's panel a title and no ticks."""
    axis.set_title(title, fontsize=9)
    axis.set_xticks([])
    axis.set_yticks([])
