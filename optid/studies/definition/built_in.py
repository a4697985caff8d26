"""The study that ships with the package, so that the command runs on nothing."""

from importlib.resources import files

from optid.studies.definition.description import Study


def example_study() -> Study:
    """Return the built-in study."""
    text = files("optid.studies.definition").joinpath("example.toml").read_text(encoding="utf-8")
    return Study.from_text(text, label="the built-in study")
