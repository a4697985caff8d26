"""What a study compares: entries, the TOML file with the place of everything that is wrong, and back."""
