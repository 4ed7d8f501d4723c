"""Deployments compared by cause, on one offline page: budgets as bars, and what differences are made of."""

from pipeline.report.causes.page import draw_causes, render_causes

__all__ = ["draw_causes", "render_causes"]
