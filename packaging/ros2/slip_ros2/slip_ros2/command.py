"""`ros2 slip VERB ...`: what `slip VERB ...` does."""

from __future__ import annotations

import argparse

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
        from pipeline.cli import main  # noqa: PLC0415 - `ros2` imports this file with every command

        try:
            main(args.words or ["help"])
        except SystemExit as done:
            return done.code if isinstance(done.code, int) else 0
        return 0
