"""Takes the place of a module that builds grammars for two seconds wherever altair is imported.

Only the tool of `make audit` brings it: no user's environment has it.
"""

message = "left out of tests, as of every user's environment"
raise ImportError(message)
