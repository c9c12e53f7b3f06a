"""Pictures that the network learns from: drawn shapes, and photographs that no benchmark restores.

Drawn shapes are dead leaves (Achddou, Gousseau and Ladjal, "Synthetic images as a regularity prior for image
restoration neural networks", SSVM 2021): discs, stripes, polygons and letters that cover each other, of sizes from
2 to 120 px, some of them textured or shaded. They have edges at every angle and every contrast.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import skimage
import sklearn.datasets
from jaxtyping import Float, Float32, Int

# Of scikit-image's pictures, and of scikit-learn's; grey ones are tinted.
_COLOURED = ("astronaut.png", "chelsea.png", "coffee.png", "motorcycle_left.png", "rocket.jpg", "hubble_deep_field.jpg")
_GREY = ("camera.png", "brick.png", "coins.png", "grass.png", "gravel.png", "page.png")
_LEARN = ("china.jpg", "flower.jpg")
# Of packages of Debian 12, below the root folder.
_DEBIAN = {
    "mate-backgrounds": (
        "usr/share/backgrounds/mate/{}.jpg",
        "nature/Blinds nature/Dune nature/LadyBird nature/RainDrops nature/Storm nature/TwoWings nature/Wood "
        "abstract/Elephants_3840x2160",
    ),
    "plasma-workspace-wallpapers": (
        "usr/share/wallpapers/{}/contents/images/2560x1600.jpg",
        "BytheWater ColdRipple ColorfulCups EveningGlow FallenLeaf OneStandsOut Path",
    ),
    "opencv-doc": (
        "usr/share/doc/opencv-doc/examples/data/{}",
        "aloeL.jpg baboon.jpg board.jpg building.jpg chicky_512.png fruits.jpg graf1.png leuvenA.jpg rubberwhale1.png "
        "squirrel_cls.jpg starry_night.jpg",
    ),
}
# Larger pictures are halved: at full size few have detail to the pixel.
_SHARP_PX = 1600
# Pictures by which training is judged, and panoramas that the benchmarks look at.
_HELD_OUT = ("coffee", "china", "Dune", "EveningGlow", "leuvenA", "baboon", "Path")
_SEEN = ("lobby", "park")
_OVERSAMPLED = 2
_LEAST_PX, _MOST_PX = 1.5, 120.0
# The longest shape, in units of its radius.
_REACH = 5.0

Pictures = list[Float32[np.ndarray, "rows columns 3"]]


def photographs(data: Path, root: Path, rng: np.random.Generator) -> tuple[Pictures, Pictures]:
    """Return photographs in linear light, to learn from and to judge by.

    Args:
        data: the shared folder; without it there are no panoramas.
        root: below which Debian's packages lie.
        rng: of gammas and tints.

    Raises:
        FileNotFoundError: when a package is missing.
    """
    own, judging = [], []
    for name, file in files(root).items():
        if not file.exists():
            raise FileNotFoundError(_missing(file))
        display = cv2.imread(str(file), cv2.IMREAD_COLOR)[..., ::-1] / 255.0
        tint = rng.uniform(0.6, 1.0, 3) if file.name in _GREY else np.ones(3)
        light = _sharp(_exposed(tint * display ** rng.uniform(1.8, 2.2)))
        (judging if name in _HELD_OUT else own).append(light)
    for file in sorted((data / "environments").glob("*.hdr")):
        if not file.stem.startswith(_SEEN):
            own.append(_exposed(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[..., ::-1]))
    return own, judging


def files(root: Path) -> dict[str, Path]:
    """Return the photographs' files by name."""
    folder, learn = Path(skimage.data_dir), Path(sklearn.datasets.__file__).parent / "images"
    found = [*(folder / name for name in (*_COLOURED, *_GREY)), *(learn / name for name in _LEARN)]
    named = {file.stem: file for file in found}
    for pattern, names in _DEBIAN.values():
        named |= {Path(name).stem: root / pattern.format(name) for name in names.split()}
    return named


def _missing(file: Path) -> str:
    package = next(p for p, (pattern, _) in _DEBIAN.items() if pattern.split("{")[0] in str(file))
    return (
        f"Expected the pictures of Debian's package {package}, found no {file}. Install it, or unpack it "
        "(dpkg-deb -x) and give the folder as --root."
    )


def _sharp(light: Float32[np.ndarray, "rows columns 3"]) -> Float32[np.ndarray, "rows columns 3"]:
    while max(light.shape) > _SHARP_PX:
        light = cv2.resize(light, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return light


def _exposed(picture: np.ndarray) -> Float32[np.ndarray, "rows columns 3"]:
    """Bring the 97th percentile to 0.9, as a camera's exposure would, and clip far above."""
    light = np.maximum(np.nan_to_num(picture), 0.0)
    return np.minimum(light * (0.9 / max(float(np.percentile(light, 97)), 1e-6)), 4.0).astype(np.float32)


def drawn_picture(size: int, rng: np.random.Generator) -> Float32[np.ndarray, "size size 3"]:
    """Return dead leaves in linear light."""
    big = size * _OVERSAMPLED
    canvas = np.empty((big, big, 3), dtype=np.float32)
    canvas[:] = _colour(rng)
    colourful = rng.uniform(0.02, 0.5)
    base = _colour(rng)
    for _ in range(int(rng.uniform(60, 400))):
        radius = float(np.exp(rng.uniform(*np.log([_LEAST_PX, _MOST_PX])))) * _OVERSAMPLED
        centre, reach = rng.uniform(0, big, 2), _REACH * radius
        first = np.maximum(centre - reach, 0).astype(int)
        part = canvas[first[1] : int(centre[1] + reach) + 1, first[0] : int(centre[0] + reach) + 1]
        mask = np.zeros(part.shape[:2], dtype=np.uint8)
        _draw(mask, centre - first, radius, rng)
        tint = np.clip(_grey(rng) * (1 + colourful * rng.standard_normal(3)) * (0.5 + 0.5 * base), 0.002, 1.2)
        places = np.argwhere(mask)
        part[places[:, 0], places[:, 1]] = _filled(tint.astype(np.float32), places, rng)
    blurred = cv2.GaussianBlur(canvas, (0, 0), _OVERSAMPLED * rng.choice([0.35, 0.5, 0.9]))
    return np.ascontiguousarray(blurred[::_OVERSAMPLED, ::_OVERSAMPLED])


def _grey(rng: np.random.Generator) -> float:
    return float(rng.uniform(0, 1) ** 2.2)


def _colour(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    return np.clip(_grey(rng) * (1 + 0.3 * rng.standard_normal(3)), 0.002, 1.0)


def _draw(mask: np.ndarray, centre: np.ndarray, radius: float, rng: np.random.Generator) -> None:
    """Draw one shape into the mask."""
    kind, at = rng.integers(5), (int(centre[0]), int(centre[1]))
    if kind == 0:
        cv2.circle(mask, at, max(int(radius), 1), 255, -1)
    elif kind == 1:
        axes = max(int(radius), 1), max(int(radius * rng.uniform(0.1, 1)), 1)
        cv2.ellipse(mask, at, axes, float(rng.uniform(0, 180)), 0, 360, 255, -1)
    elif kind == 2:
        angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 7)))
        points = centre + radius * np.column_stack([np.cos(angles), np.sin(angles)])
        cv2.fillPoly(mask, [points.astype(np.int32)], 255)
    elif kind == 3:
        angle = rng.choice([0, np.pi / 2, rng.uniform(0, np.pi)])
        along = radius * rng.uniform(1, 5) * np.array([np.cos(angle), np.sin(angle)])
        ends = [tuple(int(v) for v in centre + side * along) for side in (-1, 1)]
        cv2.line(mask, ends[0], ends[1], 255, max(int(radius * rng.uniform(0.1, 0.5)), 1))
    else:
        text = "".join(chr(c) for c in rng.integers(33, 126, rng.integers(1, 8)))
        cv2.putText(mask, text, at, int(rng.integers(0, 8)), radius / 16, 255, max(int(radius / 8), 1))


def _filled(
    tint: Float32[np.ndarray, "3"], places: Int[np.ndarray, "samples 2"], rng: np.random.Generator
) -> Float32[np.ndarray, "samples 3"]:
    """Return a shape's samples: even, shaded, striped or grained."""
    even = np.repeat(tint[None], len(places), axis=0)
    kind = rng.integers(6)
    if kind == 1 and len(places):
        slope = places @ rng.standard_normal(2) / 100
        even = even * np.clip(1 + slope - slope.mean(), 0.2, 2.0)[:, None]
    elif kind == 2:
        wave = places @ (rng.standard_normal(2) * rng.uniform(0.05, 0.8))
        even = even * (1 + rng.uniform(0.05, 0.6) * np.sin(wave))[:, None]
    elif kind == 3:
        even = even * (1 + rng.uniform(0.02, 0.4) * rng.standard_normal((len(places), 1)))
    return np.maximum(even, 0.001).astype(np.float32)
