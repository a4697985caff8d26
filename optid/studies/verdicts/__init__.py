"""From rows to a verdict: tables of accuracy and time, profiles, paired intervals, and one headline."""
