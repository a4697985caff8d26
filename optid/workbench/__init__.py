"""The workbench: a local page to fit a record, draw constraints on the model, and diagnose faults.

`request` describes a fit, `bench` fits and judges it, `views` draws it, `diagnosis` searches for faults, `script`
writes the Python that repeats the fit, `server` serves the page.
"""
