"""A rig whose every number is drawn: what it was built to be, with tolerances, and what it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SIZES = ((400, 300), (416, 320), (480, 320), (480, 360), (512, 384))
# Part of a tolerance by which the truth is off at most.
_WITHIN = 0.9
_NM = np.arange(400.0, 701.0, 10.0)


@dataclass(frozen=True)
class About:
    """A nominal value, its tolerance, and the true value."""

    nominal: float
    tolerance: float
    true: float


@dataclass(frozen=True)
class Lens:
    """Intrinsics of the true camera in px, its entrance pupil, and blur that is no diffraction (one sigma in px)."""

    focal_px: np.ndarray
    centre_px: np.ndarray
    distortion: np.ndarray
    pupil_mm: float
    focus_mm: float
    blur_px: np.ndarray
    blur_growth: float
    shading: tuple[float, float]


@dataclass(frozen=True)
class Shape:
    """One opening of the panel, in periods of it; 0 stands for no such thing.

    Attributes:
        width, height: of the opening. depth: of the opaque columns and rows along the panel's normal.
        corner: radius of the corners. slant: by how much the opening is wider at its lower end than in its middle.
        trace: width of an opaque line through the opening, of a wire or a shield. trace_at: its place.
        upright: whether that line runs along the columns.
        offset: place of the openings' middle from the panel pixels' centres.
    """

    kind: str
    width: float
    height: float
    depth: tuple[float, float]
    corner: float
    slant: float
    trace: float
    trace_at: float
    upright: bool
    offset: tuple[float, float]


@dataclass(frozen=True)
class Emission:
    """Light of the panel in the lens.

    Attributes:
        places, sizes: of the three emitters in a panel pixel, in pixels. mix: e-/s of each camera colour (row) by each
            primary (column), of a footprint full of white. gamma: of the panel.
        stretch: of the footprint against the pupil's. edge: width of its soft edge, relative to its radius.
        lobe: power of the cosine by which emitters radiate.
        reflected: strength of the copy by way of the glass. reflected_mm: its depth.
    """

    places: np.ndarray
    sizes: np.ndarray
    mix: np.ndarray
    gamma: float
    stretch: tuple[float, float]
    edge: float
    lobe: float
    reflected: float
    reflected_mm: float


@dataclass(frozen=True)
class Noise:
    """The sensor; ``kind`` is the shape of its read noise."""

    kind: str
    K_DN_per_e: float
    black_DN: float
    well_e: float
    bits: int
    read_e: float
    tails: float
    row_DN: float
    dark_e_per_s: float
    PRNU: float
    columns_PRNU: float
    DSNU_e: float
    columns_DSNU_e: float
    bend: float


@dataclass(frozen=True)
class Rig:
    """A drawn rig; lengths in mm, angles in degrees."""

    seed: int
    columns: int
    rows: int
    cfa: str
    pitch_um: float
    panel: tuple[int, int]
    glass: tuple[float, float]
    about: dict[str, About]
    lens: Lens
    shape: Shape
    emission: Emission
    noise: Noise
    spectrum: np.ndarray
    wavelengths_nm: np.ndarray
    led_mm: float
    led_distance_mm: float
    flat_e_per_s: float

    def true(self, name: str) -> float:
        """The true value of a number of the rig's description."""
        return self.about[name].true

    @property
    def pupil_place_mm(self) -> np.ndarray:
        """The entrance pupil in the panel's frame."""
        pitch = self.true("pitch_mm")
        return np.array([self.true("panel_x_px") * pitch, self.true("panel_y_px") * pitch, -self.true("standoff_mm")])


def draw(seed: int, size: tuple[int, int] | None = None) -> Rig:
    """Draw the rig of a seed; ``size`` replaces the sensor's columns and rows."""
    rng = np.random.default_rng([seed, 90210])
    u = rng.uniform
    about: dict[str, About] = {}

    def near(name: str, nominal: float, tolerance: float) -> float:
        about[name] = About(float(nominal), float(tolerance), float(nominal + tolerance * u(-_WITHIN, _WITHIN)))
        return about[name].true

    drawn_size = SIZES[int(rng.integers(len(SIZES)))]
    columns, rows = size or drawn_size
    bits = int(rng.choice([8, 10, 12], p=[0.2, 0.3, 0.5]))
    focal_nominal, half_view = u(4.0, 8.0), np.deg2rad(u(24.0, 33.0))
    focal_nominal_px = columns / 2 / np.tan(half_view)
    focal = near("focal_mm", focal_nominal, 0.015 * focal_nominal)
    f_number = u(1.6, 2.6)
    pupil = focal / near("f_number", f_number, 0.025 * f_number)
    pitch_nominal = focal_nominal / f_number / u(3.5, 7.5)
    pitch = near("pitch_mm", pitch_nominal, 0.003 * pitch_nominal)
    standoff = u(13.0, 26.0) * pitch_nominal
    near("standoff_mm", standoff, 0.035 * standoff)
    for name, low, high, tolerance in (
        ("tilt_deg", 0.0, 20.0, 1.0), ("roll_deg", -2.0, 2.0, 1.0), ("yaw_deg", -2.0, 2.0, 1.0),
        ("gamma", 2.0, 2.4, 0.05), ("row_open", 0.3, 0.6, 0.03), ("column_open", 0.75, 0.95, 0.015),
    ):  # fmt: skip
        near(name, u(low, high), tolerance)
    panel = (int(rng.integers(120, 200)), int(rng.integers(90, 130)))
    near("panel_x_px", panel[0] * u(0.45, 0.55), 3.0)
    near("panel_y_px", panel[1] * u(0.35, 0.5), 3.0)
    depth = u(0.02, 0.09) * pitch_nominal
    depths = (near("depth_mm", depth, 0.3 * depth), depth * u(0.73, 1.27))
    well = np.exp(u(np.log(6e3), np.log(2e4)))
    codes = 2.0**bits - 1
    near("full_well_e", well, 0.05 * well)
    near("black_DN", codes * u(0.012, 0.03), 0.002 * codes)
    gain = (codes - about["black_DN"].nominal) * u(0.9, 1.15) / well
    near("K_DN_per_e", gain, 0.05 * gain)
    return Rig(
        seed, columns, rows, str(rng.choice(["RGGB", "BGGR", "GRBG", "GBRG"])),
        focal_nominal * 1000 / focal_nominal_px, panel, (u(0.5, 1.1), u(1.48, 1.55)), about,
        _lens(rng, columns, rows, focal / focal_nominal * focal_nominal_px, pupil),
        _shape(rng, about, (depths[0] / pitch, depths[1] / pitch)),
        _emission(rng, about["gamma"].true),
        _noise(rng, about, bits),
        _spectrum(rng), _NM, u(1.0, 3.0), u(1500.0, 2500.0), np.exp(u(np.log(1e5), np.log(1e6))),
    )  # fmt: skip


def _lens(rng: np.random.Generator, columns: int, rows: int, focal_px: float, pupil_mm: float) -> Lens:
    u = rng.uniform
    return Lens(
        focal_px=focal_px * np.array([1.0, 1 + rng.normal(0, 2e-4)]),
        centre_px=(np.array([columns, rows]) - 1) / 2 + u(-0.008, 0.008, 2) * [columns, rows],
        distortion=u([-0.1, 0.0, -4e-4, -4e-4], [0.02, 0.04, 4e-4, 4e-4]),
        pupil_mm=pupil_mm,
        focus_mm=u(1200.0, 3000.0),
        blur_px=u(0.2, 0.4) * u(0.96, 1.04, 3),
        blur_growth=u(0.0, 0.15),
        shading=(u(0.02, 0.08), u(0.0, 0.03)),
    )


def _shape(rng: np.random.Generator, about: dict[str, About], depth: tuple[float, float]) -> Shape:
    u = rng.uniform
    kind = str(rng.choice(["rectangle", "round corners", "trapezoid", "traced", "all of these"]))
    every = kind == "all of these"
    width, height = about["column_open"].true, about["row_open"].true
    return Shape(
        kind=kind,
        width=width,
        height=height,
        depth=depth,
        corner=u(0.05, 0.2) * (kind == "round corners" or every),
        slant=u(-0.04, 0.04) * (kind == "trapezoid" or every),
        trace=u(0.015, 0.04) * (kind == "traced" or every),
        trace_at=u(-0.3, 0.3) * height,
        upright=bool(rng.random() < 0.5),
        offset=(u(-0.2, 0.2), u(-0.2, 0.2)),
    )


def _emission(rng: np.random.Generator, gamma: float) -> Emission:
    u = rng.uniform
    order = rng.permutation(3)
    across = np.array([-0.3, 0.0, 0.3])[order] + u(-0.05, 0.05, 3)
    crosstalk = np.eye(3) + (1 - np.eye(3)) * u(0.02, 0.2, (3, 3))
    strength = np.exp(u(np.log(2e4), np.log(1e5))) * np.array([u(0.5, 0.9), 1.0, u(0.4, 0.8)])
    return Emission(
        places=np.stack([across, u(0.3, 0.6) + u(-0.04, 0.04, 3)], axis=-1),
        sizes=u(0.1, 0.28, (3, 2)),
        mix=crosstalk * strength[:, None],
        gamma=gamma,
        stretch=(u(0.97, 1.0), u(0.97, 1.0)),
        edge=u(0.02, 0.12),
        lobe=u(0.5, 2.0),
        reflected=np.exp(u(np.log(0.3), np.log(3.0))),
        reflected_mm=u(0.6, 1.4),
    )


def _noise(rng: np.random.Generator, about: dict[str, About], bits: int) -> Noise:
    u = rng.uniform
    K = about["K_DN_per_e"].true
    kind = str(rng.choice(["normal", "Student", "telegraph"]))
    return Noise(
        kind, K, about["black_DN"].true, about["full_well_e"].true, bits, u(2.0, 8.0),
        u(5.0, 12.0) if kind == "Student" else u(0.02, 0.15), u(0.0, 0.8) * K, u(2.0, 60.0), u(0.003, 0.009),
        u(0.0, 0.0015), u(0.5, 3.0), u(0.0, 0.8), float(rng.choice([0.0, u(0.003, 0.02)])),
    )  # fmt: skip


def _spectrum(rng: np.random.Generator) -> np.ndarray:
    """Light of a white LED in the camera's colours, by wavelength; each colour sums to 1."""
    u = rng.uniform
    peaks, widths = np.array([605.0, 535.0, 458.0]) + u(-12, 12, 3), u(28.0, 48.0, 3)
    colours = np.exp(-0.5 * ((_NM - peaks[:, None]) / widths[:, None]) ** 2) + u(0.0, 0.03, (3, 1))
    led = u(0.5, 1.2) * np.exp(-0.5 * ((_NM - u(445, 460)) / u(10, 22)) ** 2)
    led = led + np.exp(-0.5 * ((_NM - u(550, 585)) / u(50, 70)) ** 2)
    light = colours * led
    return light / light.sum(axis=1, keepdims=True)
