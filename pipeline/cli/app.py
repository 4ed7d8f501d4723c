"""The `slip` program: its verbs, and what errors become."""

import importlib
import os
import pkgutil
import sys
from collections.abc import Sequence
from typing import Literal, get_args, get_origin

from cyclopts import App, CycloptsError, CycloptsPanel, MissingArgumentError

import pipeline.cli
from pipeline.cli.output import FAILED, USAGE, print_error
from pipeline.core.errors import SlipError
from pipeline.core.interpreter import keep_current_folder_out
from pipeline.core.quiet import silence_warnings
from pipeline.core.version import read_version

HELP = """How far was the motion from the ideal model, and why?

Reads MCAP logs of field robots, computes slip per time step, and writes tables, a summary and a report.
A name that begins with a dash goes behind --, after all options.
"""


def build_app(verb: str = "") -> App:
    """The program with every verb of the folder: the function of the module's name, or what `build` makes.

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
    modules = sorted(module.name for module in pkgutil.iter_modules(pipeline.cli.__path__))
    verbs = [name.removeprefix("verb_") for name in modules if name.startswith("verb_")]
    for name in [verb] if verb in verbs else verbs:
        content = vars(importlib.import_module(f"pipeline.cli.verb_{name}"))
        app.command(content["build"]() if "build" in content else content[name])
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
