"""From rows to a verdict: profiles, averages, ranks, growth, agreement, and advice in words."""
