"""What every room stands on: errors, rigid motions, time grids, segments.

Pure functions over numpy arrays and one base class for errors. Nothing here knows of logs, tables or files.
"""
