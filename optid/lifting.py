"""temporary"""
def certify_rank_one(program, values, duals): return None, None
def certify_nuclear(problem, program, values, duals): return None, None
