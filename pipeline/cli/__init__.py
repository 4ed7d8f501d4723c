"""The command line: verbs that parse, call and print. No numerics.

Each verb is one file of this folder; heavy rooms are imported inside the verbs, so that help is instant.
"""

from pipeline.cli.app import main
