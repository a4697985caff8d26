"""The search on a stream, sample by sample."""
