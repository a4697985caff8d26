"""``python -m optid`` is the command line."""

from optid.cli import app

app(prog_name="optid")
