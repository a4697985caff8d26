"""Where records come from: files, and simulated systems with their truth."""
