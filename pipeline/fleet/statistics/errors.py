"""The error of this room."""

from __future__ import annotations

from pipeline.core.errors import SlipError


class StatisticsError(SlipError):
    """Numbers that no statistic can be made of."""
