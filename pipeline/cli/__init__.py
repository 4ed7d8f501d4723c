"""The command line: verbs that parse, call and print. No numerics.

Verbs of one task share a file; heavy rooms are imported inside the verbs, so that help is instant. Here are
the program, its verbs by task, and what errors become.
"""

import gc
import importlib
import json
import os
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, get_args, get_origin

from cyclopts import (
    App,
    CycloptsError,
    CycloptsPanel,
    Group,
    MissingArgumentError,
    Parameter,
    UnknownCommandError,
    UnknownOptionError,
    UnusedCliTokensError,
)

from pipeline.cli.conventions import (
    CLEAN,
    FAILED,
    USAGE,
    Answer,
    is_json,
    print_error,
    print_lines,
    summarize_error,
)
from pipeline.core import (
    SlipError,
    guess_names,
    keep_current_folder_out,
    limit_memory,
    read_version,
    silence_warnings,
)

HELP = """How far was the motion from the ideal model, and why?

Reads MCAP logs of field robots, computes slip per time step, and writes tables, a summary and a report.
Write names that begin with a dash after --, behind all options.
The handbook is the folder docs/pages of the source, which begins with index.md.
"""
_GROUPS = {
    "Analyze a run": {
        "analyze": "verbs_log",
        "diagnose": "verbs_effects",
        "watch": "verbs_log",
        "inspect": "verbs_log",
        "export": "verbs_effects",
    },
    "Change the model": {"model": "verb_model", "effects": "verbs_effects", "serve": "verbs_machine"},
    "Plan and simulate drives": {"plan": "verbs_drives", "simulate": "verbs_drives"},
    "Compare several runs": {"check": "verbs_fleet", "compare": "verbs_datasets", "fleet": "verbs_fleet"},
    "Batches and results": {"batch": "verbs_batch", "results": "verbs_results"},
    "The installation": {"doctor": "verbs_machine"},
}
"""Files of the commands, by task."""

_YOUNG = 20_000
"""Threshold of the garbage collector [new objects]: nearly all are freed without it, and it takes time."""


def build_app(verb: str = "") -> App:
    """The program with every command: the function of its name, or what `build_` and its name makes.

    Args:
        verb: the one that is asked for; the others are not imported then. Any other word stands for all.
    """
    app = App(
        name="slip",
        help=HELP,
        # Plain text: a Markdown renderer takes longer to load than everything else.
        help_format="plaintext",
        version=read_version,
        version_flags=["--version"],
        # No --no-json and no --empty-logs: options with a negative form declare it themselves.
        default_parameter=Parameter(negative=()),
        result_action="return_value",
        # `main` handles Ctrl-C, and reports the state of the results.
        suppress_keyboard_interrupt=False,
        error_formatter=lambda error: CycloptsPanel(_describe_usage(error)),
    )
    known = {name for files in _GROUPS.values() for name in files}
    for index, (title, files) in enumerate(_GROUPS.items()):
        group = Group(title, sort_key=index)
        for name in files if verb not in known else [verb] if verb in files else ():
            content = vars(importlib.import_module(f"pipeline.cli.{files[name]}"))
            build = content.get(f"build_{name}")
            app.command(build() if build else content[name])
            app[name].group = group
    options = Group("Options", sort_key=len(_GROUPS))
    app.command(partial(_install_completion, app), name="--install-completion", group=options)
    for flag in ("--help", "--version"):
        app[flag].group = options
    return app


def _install_completion(app: App, /, *, shell: Literal["bash", "zsh", "fish"] | None = None) -> int:
    """Install completion of commands and options.

    Args:
        app: the program.
        shell: the shell (default: the one that this is called from).
    """
    from cyclopts.completion.detect import ShellDetectionError  # noqa: PLC0415 - only here

    try:
        path = app.install_completion(shell=shell)
    except (ShellDetectionError, OSError) as error:
        hint = "Name your shell with --shell bash, zsh or fish; your home folder must be writable"
        raise SlipError("no_completion", f"completion is not installed: {error}", hint=hint) from error
    print_lines([f"{path}: a new shell completes the commands of slip"])
    return CLEAN


def _describe_usage(error: CycloptsError) -> str:
    """What is wrong with the words of a command; for a missing argument its name and meaning."""
    verb = f"slip {' '.join(error.command_chain or ())}".rstrip()
    rest = " ".join(error.unused_tokens or ())
    if (
        isinstance(error, UnknownCommandError)
        and error.unused_tokens
        and Path(error.unused_tokens[0]).exists()
    ):
        return f"slip has no command {error.unused_tokens[0]}. A log is analyzed by: slip analyze {rest}"
    if isinstance(error, UnusedCliTokensError):
        return f"{verb} takes no further argument: {rest}. See {verb} --help."
    if isinstance(error, UnknownCommandError) and rest.split()[:1] in _VERSION_WORDS:
        return f"slip has no command {rest.split()[0]}. The version is shown by slip --version."
    if isinstance(error, UnknownOptionError):
        option = error.token.keyword or error.token.value
        known = [name.lstrip("-") for one in error.argument_collection for name in one.names]
        near = guess_names(option.lstrip("-"), dict.fromkeys(known)).replace("mean ", "mean --")
        return f"{verb} has no option {option}. {near.replace(' or ', ' or --')}See {verb} --help."
    lacking = error.argument
    if not isinstance(error, MissingArgumentError) or lacking is None or lacking.tokens or error.keyword:
        return str(error)
    choices = get_args(lacking.hint) if get_origin(lacking.hint) is Literal else ()
    # The parser reads docstrings for the help alone.
    documented = error.app.assemble_argument_collection(parse_docstring=True) if error.app else ()
    meanings = (one.parameter.help for one in documented if one.name == lacking.name)
    about = " ".join((next(meanings, "") or " or ".join(map(str, choices))).split()).removesuffix(".")
    return f"{verb} needs {lacking.name}{f': {about}' if about else ''}."


_VERSION_WORDS = (["version"], ["-v"], ["-V"])


def _build_launcher(app: App, words: Sequence[str]) -> App:
    """The program as it is started: any verb within the memory limit that is an option of them all."""

    @app.meta.default
    def launch(
        *tokens: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
        memory: Annotated[
            str | None,
            Parameter(
                group=Group("Options", sort_key=len(_GROUPS)),
                help="memory limit of a process, for example 2GB, also of a worker; the machine's by default",
            ),
        ] = None,
    ) -> object:
        answer = Answer(memory, is_json(words))
        command, bound, injected = app.parse_args(tokens, exit_on_error=False)
        with limit_memory(answer.limit_bytes, answer.end):
            return command(*bound.args, **bound.kwargs, **dict.fromkeys(injected, answer))

    return app.meta


def _refuse_json(words: Sequence[str], error: SlipError) -> None:
    """Print an error that a verb did not answer itself as its JSON object, if JSON was asked for."""
    if is_json(words):
        content = {"runs": [], "errors": [summarize_error(error.where, error)]}
        # One line: those who read `watch` read line by line.
        sys.stdout.write(json.dumps(content) + "\n")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb and exit: 0 clean, 1 failed, 2 usage, 3 done with losses."""
    # Results must not depend on the number of threads of a library, and short jobs are slower with more.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    # The pool that Arrow has of its own keeps 30 MB of what it freed.
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    keep_current_folder_out()
    silence_warnings()
    gc.set_threshold(_YOUNG)
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        verb = next(iter(words), "")
        if verb == "help":
            words, verb = [*words[1:], "--help"], next(iter(words[1:]), "")
        elif words[1:] == ["help"] and not Path("help").exists():
            words = [verb, "--help"]
        code = _build_launcher(build_app(verb), words)(
            words, exit_on_error=False, result_action="return_value"
        )
    except CycloptsError as error:
        chain = " ".join(("slip", *(error.command_chain or ())))
        _refuse_json(
            words, SlipError("usage", _describe_usage(error).rstrip("."), hint=f"See {chain} --help")
        )
        sys.exit(USAGE)
    except SlipError as error:
        print_error(error)
        _refuse_json(words, error)
        sys.exit(FAILED)
    except BrokenPipeError:
        # The reader of the pipe has exited (`slip ... | head`): no output is possible.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(FAILED)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; nothing was left half-written\n")
        sys.exit(130)
    sys.exit(code if isinstance(code, int) else 0)
