"""Solve the problems beside this file without optid: python solve_problems.py clarabel|scs|highs."""
import pathlib
import sys
from importlib import import_module

import numpy as np
import scipy.sparse as sp

solver = import_module({"highs": "highspy"}.get(sys.argv[1], sys.argv[1]))
for path in sorted(pathlib.Path(__file__).parent.glob("*.npz")):
    d = np.load(path)
    q, b, zero, nonneg, soc, psd = (d[key].tolist() if d[key].ndim == 0 or key in ("soc", "psd") else d[key]
                                    for key in ("q", "b", "zero", "nonneg", "soc", "psd"))
    P, A = (sp.csc_matrix((d[f"{k}_data"], d[f"{k}_indices"], d[f"{k}_indptr"]), (r, len(q)))
            for k, r in (("P", len(q)), ("A", len(b))))
    if sys.argv[1] == "clarabel":
        cones = [solver.ZeroConeT(zero), solver.NonnegativeConeT(nonneg), *map(solver.SecondOrderConeT, soc)]
        settings = solver.DefaultSettings()
        settings.verbose, settings.tol_gap_abs, settings.tol_gap_rel, settings.tol_feas = False, 1e-10, 1e-10, 1e-10
        cones = [cone for cone in [*cones, *map(solver.PSDTriangleConeT, psd)] if cone.dim]
        x = solver.DefaultSolver(P, q, A, b, cones, settings).solve().x
    elif sys.argv[1] == "scs":
        order = [*range(len(b) - sum(k * (k + 1) // 2 for k in psd))]  # SCS takes lower triangles by columns
        for k in psd:
            order += [len(order) + i * (i + 1) // 2 + j for j in range(k) for i in range(j, k)]
        data = {"P": P, "A": A[order].tocsc(), "b": b[order], "c": q}
        cones = {"z": zero, "l": nonneg, "q": soc, "s": psd}
        x = solver.SCS(data, cones, eps_abs=1e-10, eps_rel=1e-10, max_iters=10**6, verbose=False).solve()["x"]
    elif path.with_suffix(".mps").exists():
        highs = solver.Highs()
        highs.silent()
        x = [highs.readModel(str(path.with_suffix(".mps"))), highs.run(), highs.getSolution().col_value][-1]
    else:
        continue
    x = np.array(x)
    found, known = x @ (P + sp.triu(P, 1).T) @ x / 2 + q @ x + d["offset"], float(d["objective"])
    print(path.stem, found, known, abs(found - known) / max(abs(known), 1e-12))
