"""Brackets of exposures merged into one rate per sample."""

from udccal.fitting.hdr.merge import HdrMerge, HdrRules, merge_bracket

__all__ = ["HdrMerge", "HdrRules", "merge_bracket"]
