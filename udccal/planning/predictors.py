"""The predictor of each term, loaded when it is asked for."""

from __future__ import annotations

from udccal.planning.prediction import Predictor
from udccal.planning.state import RigState
from udccal.sessions.schema import TermName


def predictor_for(term: TermName, state: RigState) -> Predictor:
    """What predicts a term of a rig."""
    match term:
        case "noise":
            from udccal.planning.noise import NoisePredictor

            return NoisePredictor(state)
        case "geometry":
            from udccal.planning.geometry import GeometryPredictor

            return GeometryPredictor(state)
        case "wire":
            from udccal.planning.wire import WirePredictor

            return WirePredictor(state)
        case "psf":
            from udccal.planning.psf import PsfPredictor

            return PsfPredictor(state)
        case "backscatter":
            from udccal.planning.backscatter import BackscatterPredictor

            return BackscatterPredictor(state)
