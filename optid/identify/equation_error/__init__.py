"""Equation-error least squares ``A(q) y = sum_c B_c(q) f_c(u_c) + d + e``: the compressed record, robust losses."""

from optid.identify.equation_error.compression import EquationError, EquationStructure, compress
from optid.identify.equation_error.reweighting import pose_with_loss

__all__ = ["EquationError", "EquationStructure", "compress", "pose_with_loss"]
