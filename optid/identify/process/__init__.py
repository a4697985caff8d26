"""Processes with dead time in continuous time: errors, search, proof of global optimality, order and intervals."""
