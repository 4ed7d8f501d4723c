"""The game of hidden effects: logs whose physics is drawn, players who name it, a scorer.

One generator (`draw`), one scorer (`score`), three rings of tasks for everybody (`rings`), and drawn riddles
for the versions of one program (`play`, `freeze`). Players are `slip` (`player`) and peers that
need nothing of it (`baselines`). What draws shares no code with what estimates.
"""
