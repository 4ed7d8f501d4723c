"""`ros2 slip VERB ...`: what `slip VERB ...` does.

The program is the `slip` of the path, a process of its own: it brings a newer numpy, and may need a newer
Python, than the `ros2` that this file runs in (Python 3.10 in Humble).
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys

from ros2cli.command import CommandExtension


class SlipCommand(CommandExtension):
    """Slip of ground vehicles from recordings, and its causes."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str, *, argv: object = None) -> None:
        """Take all words behind `ros2 slip`; the program parses them itself."""
        del argv
        parser.epilog = f"`{cli_name} help` lists the verbs, `{cli_name} VERB --help` the options of one."
        parser.add_argument(
            "words", nargs=argparse.REMAINDER, metavar="VERB ...", help="verb and its options"
        )

    def main(self, *, parser: argparse.ArgumentParser, args: argparse.Namespace) -> int:
        """Run the verb; its exit code."""
        del parser
        program = shutil.which("slip")
        if program is None:
            print("ros2 slip: there is no `slip` on the path: pipx install slip-pipeline", file=sys.stderr)
            return 1
        command = [program, *(args.words or ["help"])]
        return subprocess.run(command, check=False).returncode  # noqa: S603 - the user's words
