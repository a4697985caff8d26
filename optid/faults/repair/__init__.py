"""The damaged system as a new problem: refit, virtual sensor, re-allocation."""
