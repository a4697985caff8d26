"""What a third party adds to optid: one file for a solver, one for a formulation."""
