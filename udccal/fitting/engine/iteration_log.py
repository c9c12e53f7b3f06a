"""The logger to which every solver writes its iterations at level DEBUG: `udccal fit --log` shows them."""

from __future__ import annotations

import logging

LOG = logging.getLogger("udccal.fitting")
