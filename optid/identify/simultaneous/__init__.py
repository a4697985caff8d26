"""Fits with the courses of a run as unknowns: what a model makes of them, and what the answer of a solver is worth."""

from optid.identify.simultaneous.courses import Courses
from optid.identify.simultaneous.equation_courses import fit_equations
from optid.identify.simultaneous.state_courses import check_states, shoot
from optid.identify.simultaneous.transfer_courses import TransferCourses

__all__ = ["Courses", "TransferCourses", "check_states", "fit_equations", "shoot"]
