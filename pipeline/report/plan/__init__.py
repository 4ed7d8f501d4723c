"""The page of `slip plan`: where it leads, what it asks, and what it promises."""

from __future__ import annotations

from pipeline.report.plan.page import preview_plan, render_plan, show_planned

__all__ = ["preview_plan", "render_plan", "show_planned"]
