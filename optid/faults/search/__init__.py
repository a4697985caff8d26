"""The search for faults over all candidates and onsets of a window, exact or by a sparse programme."""
