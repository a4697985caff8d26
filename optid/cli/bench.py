"""The command that opens the workbench."""

from pathlib import Path
from typing import Any

from optid.cli.options import File, Paths
from optid.cli.terminal import capture_warnings, print_text


def workbench(data: Paths = None, example: str | None = None, *, how: dict[str, Any], model: File = None,
              port: int = 0, browser: bool = True, seed: int = 0) -> None:
    """Open a local web page to fit a record, constrain the model by hand and diagnose faults.

    Example: optid workbench data.csv --inputs u --outputs y --dt 0.1

    The record:
        model (--model -m MODEL): State-space model (.json) for the diagnosis. [dim]the fitted one[/]
    The page:
        port: Port of the local server; 0 takes any free port.
        browser (--browser/--no-browser): Open the page in a browser.
    """
    from optid.cli import arguments as words

    with capture_warnings():
        record: Any
        record, suggestion = words.record(data, how, example, seed)
        plant = None if model is None else words.state_space_model(model)
    from optid.lazy import import_cvxpy

    import_cvxpy()
    from optid.workbench.bench import BenchSource
    from optid.workbench.request import suggest_state
    from optid.workbench.script import reading
    from optid.workbench.server import serve

    expression = f"optid.examples.example({example!r}, seed={seed}).data" if example else reading(
        [str(Path(name).resolve()) for name in data or ()], words.reading(how))

    def ready(address: str, redirect: Path) -> None:
        print_text(f"The workbench is at {address}\nIt ends with Ctrl-C; nothing leaves this machine.")
        if browser:
            import webbrowser

            webbrowser.open(redirect.as_uri())

    serve(BenchSource(record, expression, suggest_state(record, suggestion), plant), port, ready)
