"""Foundations of all packages: errors, rigid motions, time grids, segments.

Pure functions over numpy arrays and one base class for errors, independent of logs, tables and files.
"""
