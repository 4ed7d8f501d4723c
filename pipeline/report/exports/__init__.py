"""What a run knows, for the viewers people use: a derived MCAP, CSV, layouts for Foxglove and PlotJuggler.

Tables are read and written in batches, so that a day of driving needs no more memory than a minute.
"""
