"""udccal: calibrate a camera that looks through a transparent display, and restore what it sees.

    rig = udccal.load_rig("lg55-reduced")
    with udccal.simulate(rig) as bench:
        session = udccal.capture("session", bench)
    calibration = udccal.calibrate(session)
    calibration.or_raise().write("profile")
    picture = udccal.Restorer.load("profile").restore(frame, exposure_s=8e-3)

Every name is loaded when it is first used: importing udccal alone takes no time.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from udccal.benches.bench import simulate as simulate
    from udccal.benches.capture import capture as capture
    from udccal.calibration import Calibration as Calibration
    from udccal.calibration import calibrate as calibrate
    from udccal.calibration import fit as fit
    from udccal.comparison.diff import ProfileDiff as ProfileDiff
    from udccal.comparison.diff import diff as diff
    from udccal.errors import UdccalError as UdccalError
    from udccal.fitting.backscatter.fit import fit_backscatter as fit_backscatter
    from udccal.fitting.geometry.fit import fit_geometry as fit_geometry
    from udccal.fitting.noise.fit import fit_noise as fit_noise
    from udccal.fitting.psf.fit import fit_psf as fit_psf
    from udccal.fitting.wire.fit import fit_wire as fit_wire
    from udccal.profiles.profile import Profile as Profile
    from udccal.profiles.store import load_profile as load_profile
    from udccal.profiles.store import save_profile as save_profile
    from udccal.restoration.deblur import deblur as deblur
    from udccal.restoration.device.restorer import DeviceRestorer as DeviceRestorer
    from udccal.restoration.one_frame import restore as restore
    from udccal.restoration.runtime import Restorer as Restorer
    from udccal.result import FitResult as FitResult
    from udccal.result import FitStatus as FitStatus
    from udccal.rig import RigDescription as RigDescription
    from udccal.rig import load_rig as load_rig
    from udccal.sessions.store import Session as Session
    from udccal.tiers import Tier as Tier
    from udccal.validation.sessions import SessionComparison as SessionComparison
    from udccal.validation.sessions import compare_sessions as compare_sessions
    from udccal.validation.validate import Validation as Validation
    from udccal.validation.validate import validate as validate

__version__ = "0.1.0"

_HOMES = {
    "Calibration": "udccal.calibration",
    "DeviceRestorer": "udccal.restoration.device.restorer",
    "FitResult": "udccal.result",
    "FitStatus": "udccal.result",
    "Profile": "udccal.profiles.profile",
    "ProfileDiff": "udccal.comparison.diff",
    "Restorer": "udccal.restoration.runtime",
    "RigDescription": "udccal.rig",
    "Session": "udccal.sessions.store",
    "SessionComparison": "udccal.validation.sessions",
    "Tier": "udccal.tiers",
    "UdccalError": "udccal.errors",
    "Validation": "udccal.validation.validate",
    "calibrate": "udccal.calibration",
    "capture": "udccal.benches.capture",
    "compare_sessions": "udccal.validation.sessions",
    "deblur": "udccal.restoration.deblur",
    "diff": "udccal.comparison.diff",
    "fit": "udccal.calibration",
    "fit_backscatter": "udccal.fitting.backscatter.fit",
    "fit_geometry": "udccal.fitting.geometry.fit",
    "fit_noise": "udccal.fitting.noise.fit",
    "fit_psf": "udccal.fitting.psf.fit",
    "fit_wire": "udccal.fitting.wire.fit",
    "load_profile": "udccal.profiles.store",
    "load_rig": "udccal.rig",
    "restore": "udccal.restoration.one_frame",
    "save_profile": "udccal.profiles.store",
    "simulate": "udccal.benches.bench",
    "validate": "udccal.validation.validate",
}

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'udccal' has no attribute '{name}'; it has {', '.join(__all__)}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
