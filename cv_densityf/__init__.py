"""Fundamental matrices from the density of matches: a drop-in for ``cv2.findFundamentalMat``."""

from __future__ import annotations

__version__ = "0.1.0"
