"""Prediction-error methods: descents on streamed sensitivities, and programmes in the tangent of their optima.

A formulation states the programme of one step (`tangent_problem`). Here are the criteria (`transfer_errors`,
`state_errors`), searches over starts (`search`, `state_search`), descents and the final iteration (`tangent_descent`).
"""
