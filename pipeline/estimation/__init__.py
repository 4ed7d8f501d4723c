"""Estimation: one body of evidence for a model and everything that could be added to it."""
