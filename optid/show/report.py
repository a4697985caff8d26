"""The pages of results: one HTML file each, which carries its figures and its style with it and opens offline."""

from pathlib import Path
from typing import TYPE_CHECKING

from optid.data.record import Data
from optid.lazy import public_names
from optid.show import documents, page

if TYPE_CHECKING:
    from optid.identify.fitting import Fit
    from optid.identify.order.study import OrderStudy
    from optid.identify.search import Identification
    from optid.identify.validation import Comparison, Validation


def write(fit: "Fit", path: str | Path, test: Data | None = None, *, command: str = "") -> Path:
    """Write the page of a fit.

    Args:
        fit: the fit.
        path: the file, replaced when it exists.
        test: record the fit has not seen; adds its validation.
        command: the command line behind the fit, for the section that says how to reproduce it.

    Returns:
        The path.

    Raises:
        DataError: the fit has no model to report.
        OSError: the file cannot be written.
    """
    return page.write(documents.fit_document(fit, test, command=command), path)


def render(fit: "Fit", test: Data | None = None, *, command: str = "") -> str:
    """Return the page that `write` writes."""
    return page.render(documents.fit_document(fit, test, command=command))


def write_record(data: Data, path: str | Path, *, command: str = "") -> Path:
    """Write the page of a record; arguments as in `write`."""
    return page.write(documents.record_document(data, command=command), path)


def write_search(found: "Identification", path: str | Path, test: Data | None = None, *, command: str = "") -> Path:
    """Write the page of a search for a structure and of the fit it ended with; arguments as in `write`."""
    return page.write(documents.search_document(found, test, command=command), path)


def write_validation(checked: "Validation", path: str | Path) -> Path:
    """Write the page of a validation to a file, which is replaced when it exists."""
    return page.write(documents.validation_document(checked), path)


def write_comparison(found: "Comparison", path: str | Path, *, command: str = "") -> Path:
    """Write several models on one page; arguments as in `write`."""
    return page.write(documents.comparison_document(found, command=command), path)


def write_order(study: "OrderStudy", path: str | Path) -> Path:
    """Write the page of a study of the order to a file, which is replaced when it exists."""
    return page.write(documents.order_document(study), path)


__dir__ = public_names(__name__)
