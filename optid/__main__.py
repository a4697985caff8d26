"""``python -m optid`` is the command line."""

from optid.cli.app import app

app(prog_name="optid")
