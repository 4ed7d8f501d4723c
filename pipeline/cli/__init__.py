"""The command line: verbs that parse, call and print. No numerics.

Verbs of one task share a file; heavy rooms are imported inside the verbs, so that help is instant.
"""

from pipeline.cli.app import main
