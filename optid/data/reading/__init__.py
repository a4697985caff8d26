"""Files and frames: CSV, tables, npy, columns and the checks of arrays."""
