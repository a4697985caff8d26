"""A problem as data: unknowns, terms of the objective, and constraints as rows; CVXPY is one way to express them."""
