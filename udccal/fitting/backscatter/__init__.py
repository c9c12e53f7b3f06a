"""The panel's light scattered back into the lens, from pictures shown on it under blackout."""

from udccal.fitting.backscatter.data import BackscatterData, read_backscatter
from udccal.fitting.backscatter.fit import fit_backscatter
from udccal.fitting.backscatter.rules import BackscatterRules

__all__ = ["BackscatterData", "BackscatterRules", "fit_backscatter", "read_backscatter"]
