"""Prediction-error methods: descents on streamed sensitivities, and programmes in the tangent of their optima.

A formulation states the programme of one step (`tangent_fit.TangentFit`); everything else is here, once for
transfer-function and state-space models: criteria (`transfer_errors`, `state_errors`), searches over starts
(`search`, `state_search`), descents (`descent`) and the iteration that a back end confirms (`tangent_fit.refine`).
"""
