"""Prediction-error methods: descents on streamed sensitivities, and programmes in the tangent of their optima.

Here are the criteria (`transfer_errors`, `state_errors`), the problem of one step (`criterion`), searches over starts
(`search`, `state_search`), descents and the final iteration (`tangent_descent`).
"""
