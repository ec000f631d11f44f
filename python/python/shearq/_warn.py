"""Warnings that point to the line of the user that called."""

from __future__ import annotations

import os
import sys
import warnings

_PACKAGE = os.path.dirname(os.path.abspath(__file__)) + os.sep


class DataWarning(UserWarning):
    """Stamps or PSFs that are measured, although they bias shears or are likely a mistake."""


def warn(message: str, category: type[Warning]) -> None:
    """Warns at the first frame outside this package; the category replaces the prefix ``warning:``."""
    level, frame = 1, sys._getframe(0)
    while frame.f_back is not None and os.path.abspath(frame.f_code.co_filename).startswith(_PACKAGE):
        level, frame = level + 1, frame.f_back
    warnings.warn(message.removeprefix("warning: "), category, stacklevel=level)
