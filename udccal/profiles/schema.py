"""``profile.json``, format version 8, which docs/profile.md describes."""

from __future__ import annotations

from typing import Annotated, Final, Literal, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from udccal.result import Effort
from udccal.rig import RigDescription
from udccal.sessions.schema import Sha256, StoredCamera

FORMAT: Final = "udccal-profile"
VERSION: Final = 8
# Arrays of at most this many values are stored in profile.json, where a person can read and compare them.
INLINE_VALUES = 512

Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z0-9_]+)*$", max_length=120)]
Identifier = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$", max_length=60)]
FileName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*\.exr$", max_length=100)]
Sentence = Annotated[str, Field(max_length=2000)]
Unit = Annotated[str, Field(max_length=40)]
Sigma = Annotated[float, Field(ge=0)]
Decibel = Annotated[float, Field(ge=-200, le=200)]
Celsius = Annotated[float, Field(ge=-273.15, le=500)]
Shape = Annotated[tuple[Annotated[int, Field(ge=0, le=2**24)], ...], Field(max_length=6)]
DType = Literal["float64", "float32", "int64", "int32", "uint8", "bool"]


def _rising(span: tuple[float, float]) -> tuple[float, float]:
    if span[0] > span[1]:
        raise ValueError(f"the lower of two numbers first, not {span[0]:g} and {span[1]:g}")
    return span


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Number(_Strict):
    """One real parameter."""

    kind: Literal["number"] = "number"
    name: Name
    value: float
    unit: Unit
    sigma: Sigma | None


class Numbers(_Strict):
    """A small array in row-major order; ``sigma`` has one value per element, or is null."""

    kind: Literal["numbers"] = "numbers"
    name: Name
    dtype: DType
    shape: Shape
    value: Annotated[tuple[float, ...], Field(max_length=INLINE_VALUES)]
    unit: Unit
    sigma: Annotated[tuple[Sigma, ...], Field(max_length=INLINE_VALUES)] | None


class Choice(_Strict):
    """An order, a size, a name or a switch that defines the model's form and is not fitted; null means none."""

    kind: Literal["choice"] = "choice"
    name: Name
    value: bool | int | Annotated[str, Field(max_length=200)] | None


class Group(_Strict):
    """A parameter made of parameters: a nested ``model`` whose fields follow as ``name.field``."""

    kind: Literal["group"] = "group"
    name: Name
    model: Identifier


class Sequence(_Strict):
    """A parameter that is a sequence; its items follow as ``name.0``, ``name.1``, ..."""

    kind: Literal["sequence"] = "sequence"
    name: Name
    length: Annotated[int, Field(ge=0, le=256)]


class Reference(_Strict):
    """A parameter that is the term of another section, where it is stored once."""

    kind: Literal["reference"] = "reference"
    name: Name
    section: Literal["geometry"]


Parameter = Annotated[Number | Numbers | Choice | Group | Sequence | Reference, Field(discriminator="kind")]


class StoredArray(_Strict):
    """An array in an EXR file of the same folder, folded to two dimensions (all but the last; the last).

    Its value is the sum in float64 of the channels ``value``, ``remainder`` and ``remainder2``, as far as present.
    """

    name: Name
    file: FileName
    sha256: Sha256
    dtype: DType
    shape: Shape
    unit: Unit


PictureName = Literal["wire_map", "psf_atlas", "backscatter_white", "wire_sigma", "psf_sigma", "backscatter_sigma"]


class StoredPicture(_Strict):
    """A map evaluated from the terms, for viewing and for restoration."""

    name: PictureName
    file: FileName
    sha256: Sha256
    columns: Annotated[int, Field(ge=1, le=16384)]
    rows: Annotated[int, Field(ge=1, le=16384)]
    unit: Unit
    what: Sentence


class StoredPrior(_Strict):
    """What was known before the data: nominal value, tolerance as one standard deviation, and whether that decides."""

    value: float
    sigma: Sigma
    decides: bool


class StoredEstimate(_Strict):
    """One named quantity of a fit with its unit and one standard deviation; ``what`` says in words what it is."""

    name: Annotated[str, Field(max_length=120)]
    value: float
    sigma: Sigma
    unit: Unit
    what: Sentence
    prior: StoredPrior | None


class StoredCandidate(_Strict):
    """One order that was tried."""

    name: Annotated[str, Field(max_length=200)]
    parameters: Annotated[int, Field(ge=0)]
    criterion: float
    chosen: bool


class StoredDiagnostic(_Strict):
    """A number that describes the fit."""

    name: Annotated[str, Field(max_length=120)]
    value: float
    unit: Unit


StepDigest = Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]


class StoredOutliers(_Strict):
    """Samples left out by a rule: how many, and the first of their places."""

    rule: Annotated[str, Field(max_length=400)]
    count: Annotated[int, Field(ge=0, le=2**40)]
    places: Annotated[tuple[Annotated[str, Field(max_length=200)], ...], Field(max_length=100)]


class StoredCaptures(_Strict):
    """The captures that a fit used; ``sha256`` is of the sorted checksums of their files, one a line.

    ``steps`` has the first digits of the same digest of each step alone.
    """

    sha256: Sha256
    files: Annotated[int, Field(ge=1, le=2**32)]
    frames: Annotated[int, Field(ge=1, le=2**40)]
    gain_dB: Annotated[tuple[Decibel, Decibel], AfterValidator(_rising)]
    completed_at: tuple[Annotated[str, Field(max_length=40)], Annotated[str, Field(max_length=40)]]
    temperature_C: Annotated[tuple[Celsius, Celsius], AfterValidator(_rising)] | None
    steps: Annotated[tuple[StepDigest, ...], Field(min_length=1, max_length=20000)] | None


class StoredFit(_Strict):
    """Evidence of a term's fit. ``covariance`` is the array, or null when the fit gave no covariance.

    ``residuals`` has the columns x, y (px) and residual over sigma. Null says that something is not known.
    """

    status: Annotated[str, Field(pattern=r"^[A-Z_]{1,40}$")]
    chi2_dof: Annotated[float, Field(ge=0)]
    samples: Annotated[int, Field(ge=0)]
    estimates: Annotated[tuple[StoredEstimate, ...], Field(max_length=20000)]
    candidates: Annotated[tuple[StoredCandidate, ...], Field(max_length=1000)]
    diagnostics: Annotated[tuple[StoredDiagnostic, ...], Field(max_length=20000)]
    notes: Annotated[tuple[Sentence, ...], Field(max_length=1000)]
    covariance: Numbers | StoredArray | None
    outliers: Annotated[tuple[StoredOutliers, ...], Field(max_length=1000)] | None
    residuals: Numbers | StoredArray | None
    captures: StoredCaptures | None
    effort: Effort | None


class Section(_Strict):
    """One term: its model, its values, and the evidence for them."""

    model: Identifier
    version: Literal[1]
    parameters: Annotated[tuple[Parameter, ...], Field(max_length=2000)]
    arrays: Annotated[tuple[StoredArray, ...], Field(max_length=200)]
    fit: StoredFit


class Terms(_Strict):
    """The five terms."""

    noise: Section
    geometry: Section
    wire: Section
    psf: Section
    backscatter: Section


class Provenance(_Strict):
    """Where the numbers come from. ``command`` has file names without their folders."""

    created_at: Annotated[str, Field(max_length=40)]
    udccal: Annotated[str, Field(max_length=40)]
    python: Annotated[str, Field(max_length=40)]
    numpy: Annotated[str, Field(max_length=40)]
    jax: Annotated[str, Field(max_length=40)]
    command: Annotated[str, Field(max_length=1000)]
    session_sha256: Sha256 | None
    camera: StoredCamera | None


class Lineage(_Strict):
    """``parent`` is the SHA-256 of the ``profile.json`` that this profile was derived from, or null."""

    parent: Sha256 | None


class StoredProfile(_Strict):
    """The whole of ``profile.json``."""

    format: Literal["udccal-profile"]
    version: Literal[8]
    rig: RigDescription
    lineage: Lineage
    provenance: Provenance
    invalidated_by: Annotated[tuple[Sentence, ...], Field(max_length=100)]
    terms: Terms
    pictures: Annotated[tuple[StoredPicture, ...], Field(max_length=len(get_args(PictureName)))]
