"""Programmes: the problem, its structure, the point a solver returns and how it is judged."""
