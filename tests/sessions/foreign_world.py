"""A tiny rig with physics of its own, for a session writer that knows nothing of udccal.

Camera 480 x 360 behind a display: pinhole with a little radial distortion; a sinusoidal wire; a psf of two Gaussians;
backscatter as a disc blur of the linearised picture; a sensor with shot, read and row noise. Everything in e-/s.
"""

import cv2
import numpy as np
from scipy.special import ndtr

COLUMNS, ROWS, CFA = 480, 360, "GRBG"
FOCAL_PX, CENTRE, K1 = 450.0, np.array([240.4, 178.2]), -0.04
PANEL_COLUMNS, PANEL_ROWS, PITCH_MM, GAMMA = 160, 90, 0.63, 2.2
TILT_DEG, STANDOFF_MM, PUPIL_XY_MM = 12.0, 13.0, np.array([50.4, 25.2])
K_DN_PER_E, BLACK_DN, BITS = 0.35, 60.0, 12
READ_E, ROW_DN, DARK_E_PER_S, PRNU = 5.0, 0.15, 8.0, 0.004
FLAT_E_PER_S = 6.0e5
LED_E_PER_S = 4.0e6


def rotation():
    """R_panel_camera: the camera looks down by TILT_DEG."""
    c, s = np.cos(np.deg2rad(TILT_DEG)), np.sin(np.deg2rad(TILT_DEG))
    return np.array([[1, 0, 0], [0, c, s], [0, -s, c]])


def pixels():
    """Coordinates (x, y) of every sample; (0, 0) is the centre of the top-left one."""
    return np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).astype(float)


def rays():
    """Direction in panel coordinates of every sample's ray, with z = 1."""
    seen = (pixels() - CENTRE) / FOCAL_PX
    ideal = seen.copy()
    for _ in range(20):
        ideal = seen / (1 + K1 * (ideal**2).sum(-1, keepdims=True))
    directions = np.concatenate([ideal, np.ones((ROWS, COLUMNS, 1))], axis=-1) @ rotation().T
    return directions / directions[..., 2:]


def channels():
    """0, 1, 2 for red, green, blue at every sample."""
    cell = np.array(["RGB".index(letter) for letter in CFA]).reshape(2, 2)
    return np.tile(cell, (ROWS // 2, COLUMNS // 2))


def panel_mm():
    """Where every sample's ray crosses the panel."""
    return PUPIL_XY_MM + STANDOFF_MM * rays()[..., :2]


def wire():
    """Lens shading times a sinusoid locked to the panel's rows."""
    x, y = pixels()[..., 0] / COLUMNS - 0.5, pixels()[..., 1] / ROWS - 0.5
    shading = 1 - 0.5 * (x**2 + y**2)
    amplitude = 0.025 * (1 + 0.4 * x - 0.3 * y)
    map_ = shading * (1 + amplitude * np.cos(2 * np.pi * panel_mm()[..., 1] / PITCH_MM + 0.7))
    return map_ / map_.mean()


def flat_rate():
    """An even white light."""
    return FLAT_E_PER_S * np.array([0.6, 1.0, 0.5])[channels()] * wire()


def psf(x_px, y_px, source_px=0.0):
    """Light of a small source imaged at (x_px, y_px) on every sample, for each colour; sums to 1 on a large sensor.

    Two Gaussians, wider for red, that change over the field; ``source_px`` is the diameter of the source's image.
    """
    across, down = x_px / COLUMNS - 0.5, y_px / ROWS - 0.5
    parts = ((0.85, 0.75 + 0.1 * across, 0.9 + 0.2 * down), (0.15, 1.5, 7.0 + 2 * down))
    colours = np.zeros((ROWS, COLUMNS, 3))
    for channel, size in enumerate((1.12, 1.0, 0.9)):
        for weight, sigma_x, sigma_y in parts:
            # A disc of diameter d has the variance d^2 / 16 along each axis.
            sx, sy = (np.hypot(sigma * size, source_px / 4) for sigma in (sigma_x, sigma_y))
            horizontal = np.diff(ndtr((np.arange(COLUMNS + 1) - 0.5 - x_px) / sx))
            vertical = np.diff(ndtr((np.arange(ROWS + 1) - 0.5 - y_px) / sy))
            colours[..., channel] += weight * np.outer(vertical, horizontal)
    return colours


def led_rate(x_px, y_px, source_px):
    """A small LED; its light crosses the wire like any other."""
    colours = LED_E_PER_S * np.array([0.6, 1.0, 0.5]) * psf(x_px, y_px, source_px)
    return np.take_along_axis(colours, channels()[..., None], axis=-1)[..., 0] * wire()


def backscatter_rate(picture):
    """Light of the panel's own picture (8-bit RGB) that returns into the lens."""
    linear = (picture / 255.0) ** GAMMA
    radius = 4
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    disc = (x**2 + y**2 <= radius**2).astype(float)
    blurred = cv2.filter2D(linear, -1, disc / disc.sum(), borderType=cv2.BORDER_REPLICATE)
    place = (panel_mm() / PITCH_MM).astype(np.float32)
    seen = cv2.remap(blurred, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    mix = np.array([[0.6, 0.08, 0.02], [0.1, 1.0, 0.12], [0.02, 0.1, 0.5]])
    mask = 4e4 * (1 + 0.3 * (pixels()[..., 0] / COLUMNS - 0.5))
    colours = mask[..., None] * (seen @ mix.T)
    return np.take_along_axis(colours, channels()[..., None], axis=-1)[..., 0] * wire()


def board_rate(board, square_mm, size, turn, centre_mm):
    """A ChArUco board of ``size`` squares, its middle at ``centre_mm``, turned by the matrix ``turn`` (panel frame)."""
    texels = 60
    picture = board.generateImage((size[0] * texels, size[1] * texels), marginSize=0)
    picture = cv2.GaussianBlur(picture.astype(np.float32) / 255, (0, 0), 1.0)
    pupil = np.array([*PUPIL_XY_MM, -STANDOFF_MM])
    corner = centre_mm - turn @ (np.array([*size, 0]) * square_mm / 2)
    start, run = turn.T @ (pupil - corner), rays() @ turn
    on_board = start[:2] - start[2] * run[..., :2] / run[..., 2:]
    texel = (on_board / square_mm * texels - 0.5).astype(np.float32)
    grey = cv2.remap(picture, texel[..., 0], texel[..., 1], cv2.INTER_LINEAR, borderValue=0.4)
    return 1e5 * (0.05 + grey) * np.array([0.6, 1.0, 0.5])[channels()] * wire()


class Sensor:
    """Turns rates into frames in DN."""

    def __init__(self, seed=0):
        self.rng = np.random.default_rng(seed)
        self.gain = self.rng.normal(1, PRNU, (ROWS, COLUMNS))
        self.offset = self.rng.normal(0, 1.0, (ROWS, COLUMNS))

    def frame(self, rate, exposure_s, x=0, y=0, columns=COLUMNS, rows=ROWS):
        """One 12-bit frame of a region."""
        rng, part = self.rng, np.s_[y : y + rows, x : x + columns]
        electrons = rng.poisson((rate[part] * self.gain[part] + DARK_E_PER_S) * exposure_s)
        electrons = electrons + self.offset[part] + rng.normal(0, READ_E, electrons.shape)
        values = BLACK_DN + K_DN_PER_E * electrons + rng.normal(0, ROW_DN, (rows, 1))
        return np.clip(np.rint(values), 0, 2**BITS - 1).astype(np.uint16)
