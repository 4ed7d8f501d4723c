"""`slip serve`: the workbench, a page on this machine."""

import atexit
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from cyclopts.types import PositiveFloat

from pipeline.cli.choices import KeyFile, use_key
from pipeline.cli.output import CLEAN, print_json, say


def serve(  # noqa: D417 - the hidden spelling of the folder documents itself
    results: Annotated[Path | None, Parameter(help="results folder (default: results)")] = None,
    /,
    *,
    out: Annotated[Path, Parameter(show=False)] = Path("results"),
    key: KeyFile = None,
    port: int = 8321,
    host: str = "127.0.0.1",
    diagnosis: Annotated[bool, Parameter(negative="--no-diagnosis")] = True,
    timeout: PositiveFloat = 1800.0,
    memory: str | None = None,
    open_browser: Annotated[bool, Parameter(name="--open", negative="")] = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Serve the workbench: see where the model fails, add an effect, watch the error fall.

    Only who has the token that stands in the printed address is let in; a script sends it as the header
    `Authorization: Bearer TOKEN`.

    Args:
        results: results folder (default: results).
        key: file of the key that seals the results (or SLIP_KEY_FILE).
        port: port to listen on; 0 takes any that is free.
        host: address to listen on; anything but this machine's own opens it to the network.
        diagnosis: diagnose logs that are dropped on the page.
        timeout: longest time for an analysis or a diagnosis [s].
        memory: most memory for one, for example 2GB (default: half of the machine's).
        open_browser: open the page in the browser.
        json: print address and token as one JSON object.
        quiet: print nothing.
    """
    from pipeline.batch import measure_memory, parse_size  # noqa: PLC0415 - heavy
    from pipeline.web import Limits, is_loopback  # noqa: PLC0415 - heavy
    from pipeline.web import serve as serve_workbench  # noqa: PLC0415 - heavy

    def tell(address: str, token: str) -> None:
        whole = f"{address}?token={token}"
        if json:
            print_json({"address": address, "token": token})
        elif not quiet:
            print(f"workbench  {whole}    (Ctrl-C ends it)")
        sys.stdout.flush()
        if open_browser:
            _open_browser(whole)

    use_key(key)
    if not is_loopback(host):
        say(
            f"slip: {host} can be reached from the network: whoever has the token, or reads it on its way, "
            "can read these results and change models. Leave --host out to serve this machine only."
        )
    limits = Limits(
        timeout_s=timeout, memory_bytes=measure_memory() // 2 if memory is None else parse_size(memory)
    )
    serve_workbench(results or out, host=host, port=port, tell=tell, limits=limits, diagnosis=diagnosis)
    return CLEAN


def _open_browser(address: str) -> None:
    """Open an address that others must not see: the words of a command can be read by all users."""
    import tempfile  # noqa: PLC0415 - only where asked
    import webbrowser  # noqa: PLC0415 - likewise

    with tempfile.NamedTemporaryFile("w", prefix="slip-", suffix=".html", delete=False) as file:
        file.write(f'<meta http-equiv="refresh" content="0; url={address}">')
    atexit.register(Path(file.name).unlink, missing_ok=True)
    webbrowser.open(Path(file.name).as_uri())
