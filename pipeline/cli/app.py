"""The `slip` program: its verbs, and what errors become."""

import importlib
import os
import sys
from collections.abc import Sequence
from typing import Literal, get_args, get_origin

from cyclopts import App, CycloptsError, CycloptsPanel, MissingArgumentError

from pipeline.cli.conventions import FAILED, USAGE, print_error
from pipeline.core.program import SlipError, keep_current_folder_out, read_version, silence_warnings

HELP = """How far was the motion from the ideal model, and why?

Reads MCAP logs of field robots, computes slip per time step, and writes tables, a summary and a report.
A name that begins with a dash goes behind --, after all options.
"""
_FILES = {
    "analyze": "verbs_log",
    "batch": "verbs_batch",
    "compare": "verbs_datasets",
    "diagnose": "verbs_effects",
    "effects": "verbs_effects",
    "explain": "verbs_results",
    "export": "verbs_effects",
    "fleet": "verbs_fleet",
    "inspect": "verbs_log",
    "map": "verbs_datasets",
    "model": "verb_model",
    "plan": "verb_plan",
    "predict": "verbs_fleet",
    "query": "verbs_results",
    "schedule": "verbs_batch",
    "serve": "verbs_batch",
    "share": "verbs_batch",
    "simulate": "verbs_log",
    "stage": "verbs_log",
    "status": "verbs_results",
    "trend": "verbs_fleet",
    "verify": "verbs_results",
}


def build_app(verb: str = "") -> App:
    """The program with every verb: the function of its name, or what `build_` and its name makes.

    Args:
        verb: the one that is asked for; the others are not imported then. Any other word stands for all.
    """
    app = App(
        name="slip",
        help=HELP,
        # Plain text: a Markdown renderer takes longer to load than all the rest.
        help_format="plaintext",
        version=read_version,
        version_flags=["--version"],
        result_action="return_value",
        # Ctrl-C comes back to `main`, which says what became of the results.
        suppress_keyboard_interrupt=False,
        error_formatter=_describe_usage,
    )
    for name in [verb] if verb in _FILES else _FILES:
        content = vars(importlib.import_module(f"pipeline.cli.{_FILES[name]}"))
        build = content.get(f"build_{name}")
        app.command(build() if build else content[name])
    return app


def _describe_usage(error: CycloptsError) -> object:
    """The panel of a usage error; what was not given at all is said to be needed, with what it is."""
    lacking = error.argument
    if not isinstance(error, MissingArgumentError) or lacking is None or lacking.tokens or error.keyword:
        return CycloptsPanel(error)
    choices = get_args(lacking.hint) if get_origin(lacking.hint) is Literal else ()
    about = lacking.parameter.help or " or ".join(map(str, choices))
    verb = f"slip {' '.join(error.command_chain or ())}"
    return CycloptsPanel(f"{verb} needs {lacking.name}{f': {about}' if about else ''}.")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb and exit: 0 clean, 1 failed, 2 usage, 3 done with losses."""
    # Results must not depend on how many threads a library takes, and short jobs lose time with more.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    keep_current_folder_out()
    silence_warnings()
    try:
        words = sys.argv[1:] if arguments is None else arguments
        code = build_app(next(iter(words), ""))(words, exit_on_error=False)
    except CycloptsError:
        sys.exit(USAGE)
    except SlipError as error:
        print_error(error)
        sys.exit(FAILED)
    except BrokenPipeError:
        # The reader of a pipe has gone (`slip ... | head`): nobody is left to tell.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(FAILED)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; nothing was left half-written\n")
        sys.exit(130)
    sys.exit(code if isinstance(code, int) else 0)
