"""The panel's light scattered back into the lens, from pictures shown on it under blackout."""

from udccal.fitting.backscatter.fit import fit_backscatter

__all__ = ["fit_backscatter"]
