"""What to drive next: commands that decide what the logs so far could not.

`learn` says what is known, `ask_*` what is asked, `make_plan` chooses manoeuvres for it and promises what
they will answer, `write_plan` writes what a robot plays.
"""
