"""Where every solver logs its iterations, at level DEBUG: `udccal fit --log`, or logging's own settings."""

from __future__ import annotations

import logging

LOG = logging.getLogger("udccal.fitting")
