"""The workbench: a page on this machine in which a record is fitted, constrained by hand, and diagnosed.

`request` reads the request, `bench` fits and judges it, `views` draws it, `diagnosis` searches for faults, `script`
writes the Python that repeats it, `server` hands it to the browser.
"""
