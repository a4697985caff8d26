"""Named constraints: one word, one function."""
