"""Compiled functions are explicit scalar loops: a single assignment of an array to a slice costs seconds to compile."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import optid

ROOT = Path(optid.__file__).parent


def jitted(tree):
    """Functions that numba compiles: decorated, or passed by name to njit."""
    passed = {argument.id for node in ast.walk(tree) if isinstance(node, ast.Call)
              for argument in node.args if isinstance(argument, ast.Name) and "njit" in ast.dump(node.func)}
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)
            and (node.name in passed or any("njit" in ast.dump(one) for one in node.decorator_list))]


def is_slice(index):
    parts = index.elts if isinstance(index, ast.Tuple) else [index]
    return any(isinstance(part, ast.Slice) for part in parts)


def array_names(function):
    """Parameters annotated as arrays, and names bound to new arrays or to slices."""
    arrays = {a.arg for a in function.args.args if a.annotation is not None and "rray" in ast.unparse(a.annotation)}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and len(node.targets) == 1:
            pairs = zip(node.targets[0].elts, node.value.elts) if (
                isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)) else [
                (node.targets[0], node.value)]
            for target, value in pairs:
                made = isinstance(value, ast.Call) and ast.unparse(value.func) in (
                    "np.zeros", "np.empty", "np.full", "np.ones", "np.zeros_like", "np.empty_like")
                cut = isinstance(value, ast.Subscript) and is_slice(value.slice)
                if isinstance(target, ast.Name) and (made or cut):
                    arrays.add(target.id)
    return arrays


def slow_to_compile(function):
    arrays = array_names(function)
    for node in ast.walk(function):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        for target in targets:
            if isinstance(node, ast.Assign | ast.AugAssign) and isinstance(target, ast.Subscript) and (
                    is_slice(target.slice) and not isinstance(node.value, ast.Constant | ast.Attribute)
                    or isinstance(node.value, ast.Name) and node.value.id in arrays):
                yield node, "assigns an array to a part of another"
        if isinstance(node, ast.Attribute) and node.attr in ("reshape", "T", "ravel", "flatten", "dot", "sum"):
            yield node, f"uses .{node.attr}"
        if isinstance(node, ast.BinOp):
            for side in (node.left, node.right):
                if isinstance(node.op, ast.MatMult) or isinstance(side, ast.Name) and side.id in arrays or (
                        isinstance(side, ast.Subscript) and is_slice(side.slice)):
                    yield node, "is an array expression"
                    break


@pytest.mark.parametrize("path", sorted(p for p in ROOT.rglob("*.py") if "njit" in p.read_text()),
                         ids=lambda p: str(p.relative_to(ROOT)))
def test_compiled_functions_are_scalar_loops(path):
    found = [f"{function.name}, line {node.lineno}: {what}" for function in jitted(ast.parse(path.read_text()))
             for node, what in slow_to_compile(function)]
    assert not found, "\n".join(found)


def test_kernels_are_compiled_for_one_form_of_arrays():
    """Arrays that are read-only, or not contiguous, would be compiled for once more, which costs seconds each."""
    program = """
import warnings, numpy as np, optid
from optid.models import state_kernels as kernels
warnings.simplefilter("ignore")
rng = np.random.default_rng(0)
u, y = rng.uniform(-1, 1, (200, 1)), np.zeros((200, 1))
for k in range(1, 200):
    y[k] = 0.5 * y[k - 1] + np.tanh(u[k - 1]) - 0.1 * y[k - 1] ** 2 + 0.01 * rng.standard_normal()
for criterion in ("simulation", "prediction"):
    fit = optid.fit(optid.Data(u, y), "hammerstein_ss.exact", nx=1, basis="polynomial:3", criterion=criterion,
                    feedback_basis="polynomial:2")
    fit.verdict, fit.model.noise, fit.predict(optid.Data(u, y), horizon=3), fit.simulate(u)
print(*(len(kernel.signatures) for kernel in (kernels.march, kernels.sensitivities)))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.split() == ["1", "1"], done.stdout + done.stderr[-2000:]


@pytest.mark.slow
def test_kernels_stay_within_their_arrays(tmp_path):
    """Every kernel is called by one of these tests, with every index checked."""
    tests = Path(__file__).parents[1]
    names = ["recursion", "recursions", "tracking", "latent_signals", "hammerstein_ss", "sensitivities",
             "group_sparse", "fault_pairs", "fault_injection", "monitor", "plants", "regressors", "process",
             "process_responses", "continuous"]
    files = [path for name in names for path in tests.glob(f"*/test_{name}.py")]
    assert len(files) == len(names)
    done = subprocess.run([sys.executable, tests / "helpers/kernels_within_bounds.py", *files], cwd=tmp_path,
                          capture_output=True, text=True,
                          env={**os.environ, "NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path / "cache")})
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
