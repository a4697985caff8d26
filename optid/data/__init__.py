"""Records of inputs and outputs: in memory, from files, in chunks."""
