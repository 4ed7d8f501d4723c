"""What to drive next: commands that decide what the logs so far leave open.

`learn` returns what is known, `ask_*` the open questions, `make_plan` chooses manoeuvres for them and states
the expected gain, `write_plan` writes the files that a robot plays.
"""
