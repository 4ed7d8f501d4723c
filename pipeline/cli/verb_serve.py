"""`slip serve`: the workbench, a page on this machine."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from pipeline.cli.output import CLEAN, print_json


def register(app: App) -> None:
    """Add the verb."""
    app.command(serve)


def serve(  # noqa: D417 - the hidden spelling of the folder documents itself
    results: Annotated[Path | None, Parameter(help="results folder (default: results)")] = None,
    /,
    *,
    out: Annotated[Path, Parameter(show=False)] = Path("results"),
    port: int = 8321,
    host: str = "127.0.0.1",
    diagnosis: Annotated[bool, Parameter(negative="--no-diagnosis")] = True,
    open_browser: Annotated[bool, Parameter(name="--open", negative="")] = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Serve the workbench: see where the model fails, add an effect, watch the error fall.

    Args:
        results: results folder (default: results).
        port: port to listen on; 0 takes any that is free.
        host: address to listen on; anything but this machine's own opens it to the network.
        diagnosis: diagnose logs that are dropped on the page.
        open_browser: open the page in the browser.
        json: print the address as one JSON object.
        quiet: print nothing.
    """
    from pipeline.workbench import serve as serve_workbench  # noqa: PLC0415 - heavy

    def tell(address: str) -> None:
        if json:
            print_json({"address": address})
        elif not quiet:
            print(f"workbench  {address}    (Ctrl-C ends it)")
        sys.stdout.flush()
        if open_browser:
            import webbrowser  # noqa: PLC0415 - only where asked

            webbrowser.open(address)

    serve_workbench(results or out, host=host, port=port, tell=tell, diagnosis=diagnosis)
    return CLEAN
